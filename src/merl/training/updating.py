"""How an update comes by its batch: from the replay on the host, or on the device that learns."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from merl.agents.ddpg import DDPG
from merl.config import TrainConfig
from merl.core import Batch
from merl.networks.settings import torch_settings
from merl.replay import ReplayBuffer
from merl.replay.on_device import OnDevice, bytes_on_device
from merl.training.loop import Randomness, Update

ROOM = 0.8
"""Share of a GPU's free memory that a copy of the replay may take."""


def update_from_host(
    agent: DDPG, replay: ReplayBuffer, randomness: Randomness, config: TrainConfig
) -> Update:
    """Batches drawn from the replay on the host, for an agent on the CPU.

    The random shift is made in the very copy that takes pictures out of the replay.
    """
    size, batches = config.replay.batch_size, randomness.batches

    def update() -> dict[str, Tensor]:
        draws = agent.draw(size)
        batch = replay.sample(size, batches, *agent.copies(draws))
        return agent.learn(batch, replace(draws, shifts={}, next_shifts={}))

    return update


def make_update(
    agent: DDPG,
    replay: ReplayBuffer,
    randomness: Randomness,
    config: TrainConfig,
    warn: Callable[[str], None],
    updates: int = 0,
) -> Update:
    """Make the update that is fastest where the agent lives.

    The environments may share this process: whatever they have set in torch, batch and update are
    made with merl's settings.

    Args:
        agent: the learner.
        replay: with all that was remembered so far.
        randomness: the run's random streams.
        config: of the run.
        warn: is told why a GPU does not hold the replay.
        updates: that were made so far.
    """
    with torch_settings(agent.device, agent.threads):
        update = _fastest_update(agent, replay, randomness, config, warn, updates)

    def update_with_settings() -> dict[str, Tensor]:
        with torch_settings(agent.device, agent.threads):
            return update()

    return update_with_settings


def _fastest_update(
    agent: DDPG,
    replay: ReplayBuffer,
    randomness: Randomness,
    config: TrainConfig,
    warn: Callable[[str], None],
    updates: int,
) -> Update:
    if agent.device.type == "cuda":
        torch.cuda.empty_cache()  # what was timed is gone, but torch keeps its memory
        if config.replay.compress:
            warn("a compressed replay stays on the host: each update's batch is brought over")
        elif bytes_on_device(replay.rings) > ROOM * torch.cuda.mem_get_info()[0]:
            warn("the replay does not fit on the GPU: each update's batch is brought over")
        else:
            copy = OnDevice(replay.rings, agent.device)
            seed = randomness.on_device(updates)
            return UpdateOnDevice(agent, copy, config.replay.batch_size, seed)
        size = config.replay.batch_size
        return UpdateFromHost(agent, lambda: replay.sample(size, randomness.batches))
    return update_from_host(agent, replay, randomness, config)


class Recorded:
    """An update without the host: on a GPU recorded as a CUDA graph, from then on a single launch.

    Updates with and without the actor's step are recorded as one graph each.

    Args:
        agent: the learner.
        batch: gives what is learnt from, on the agent's device, by the same operations every time.
        generators: the device's, that `batch` draws from.
    """

    WARM_UP = 3
    """Updates of a kind before that kind is recorded."""

    def __init__(
        self, agent: DDPG, batch: Callable[[], Batch], generators: Sequence[torch.Generator] = ()
    ) -> None:
        self._agent, self._batch = agent, batch
        self._generators = (*generators, agent.learning)
        self._sigma = agent.sigma = torch.zeros((), device=agent.device)
        self._on_gpu = agent.device.type == "cuda"
        self._aside = torch.cuda.Stream() if self._on_gpu else None  # type: ignore[no-untyped-call]
        # By kind of update: with the actor's step, or without.
        self._graphs: dict[bool, torch.cuda.CUDAGraph] = {}
        self._names: dict[bool, tuple[str, ...]] = {}
        self._values: dict[bool, Tensor] = {}  # of the metrics, where the graph leaves them
        self._made: Counter[bool] = Counter()

    def __call__(self) -> dict[str, Tensor]:
        """One update; returns its metrics, scalars on the device."""
        self._sigma.fill_(self._agent.config.noise(self._agent.step))
        kind, updates = self._agent.actor_is_due, self._agent.updates
        self._made[kind] += 1
        if not self._on_gpu:
            values = self._learn()
        elif self._made[kind] <= self.WARM_UP:
            values = self._learn_aside()
        else:
            if kind not in self._graphs:
                self._graphs[kind] = self._record()
            self._graphs[kind].replay()
            values = self._values[kind].clone()
        self._agent.updates = updates + 1  # a graph that is replayed does not count
        return dict(zip(self._names[kind], values.unbind(), strict=True))

    def _learn(self) -> Tensor:
        batch, kind = self._batch(), self._agent.actor_is_due
        metrics = self._agent.learn(batch, self._agent.draw(len(batch.action)))
        self._names[kind] = tuple(metrics)
        return torch.stack([value.float() for value in metrics.values()])

    def _learn_aside(self) -> Tensor:
        """On a stream of its own, as CUDA graphs want their warm-up."""
        assert self._aside is not None
        self._aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._aside):
            values = self._learn()
        torch.cuda.current_stream().wait_stream(self._aside)
        return values

    def _record(self) -> torch.cuda.CUDAGraph:
        """On that stream, too: graphs that share one share what cuBLAS works in, to the last."""
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            graph.register_generator_state(generator)
        gc.collect()  # what it would free during the recording could end it
        here = torch.cuda.stream(torch.cuda.current_stream())  # where a failure is to leave us
        failure: Exception | None = None
        kind = self._agent.actor_is_due
        try:
            with here, torch.cuda.graph(graph, stream=self._aside):
                try:
                    self._values[kind] = self._learn()
                except Exception as error:
                    failure = error
                    raise
        except Exception as error:  # that the recording cannot be ended is but a consequence
            raise failure or error from None
        return graph


class UpdateOnDevice:
    """Draws a batch from a copy of the replay and learns from it, without asking the host.

    Args:
        agent: the learner.
        copy: of the replay, on its device.
        batch_size: B.
        seed: of what is drawn.
    """

    def __init__(self, agent: DDPG, copy: OnDevice, batch_size: int, seed: int) -> None:
        generator = torch.Generator(agent.device).manual_seed(seed)
        self._copy = copy
        self._recorded = Recorded(agent, lambda: copy.sample(batch_size, generator), [generator])

    def __call__(self) -> dict[str, Tensor]:
        """One update; returns its metrics, scalars on the device."""
        self._copy.follow()
        return self._recorded()


class UpdateFromHost:
    """Draws a batch from the replay on the host and brings it to where the agent is.

    Args:
        agent: the learner, on a GPU.
        draw: gives a batch on the host, always of the same shape.
    """

    def __init__(self, agent: DDPG, draw: Callable[[], Batch]) -> None:
        self._draw, self._device = draw, agent.device
        self._there: Batch | None = None  # what the graph reads
        self._recorded = Recorded(agent, self._batch)

    def __call__(self) -> dict[str, Tensor]:
        """One update; returns its metrics, scalars on the device."""
        batch = self._draw()
        if self._there is None:
            self._there = batch.to(self._device)
        else:
            _overwrite(self._there, batch)
        return self._recorded()

    def _batch(self) -> Batch:
        assert self._there is not None
        return self._there


def _overwrite(there: Batch, batch: Batch) -> None:
    """Bring a batch to where another lies, without waiting for what a GPU is at."""
    for old, new in zip(_tensors(there), _tensors(batch), strict=True):
        old.copy_(new.pin_memory() if old.is_cuda else new, non_blocking=True)


def _tensors(batch: Batch) -> list[Tensor]:
    observations = (batch.observation, batch.next_observation)
    pictures = [value for each in observations for value in each.values()]
    return [*pictures, batch.action, batch.reward, batch.discount]
