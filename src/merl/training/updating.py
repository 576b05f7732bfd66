"""Updates of the agent, with batches from the replay on the host or from its copy on a GPU."""

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
"""Maximum share of a GPU's free memory for a copy of the replay."""


def update_from_host(
    agent: DDPG, replay: ReplayBuffer, randomness: Randomness, config: TrainConfig
) -> Update:
    """Return an update with batches from the replay on the host, for an agent on the CPU.

    The random shift is applied while images are copied out of the replay.
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
    """Return the update that is fastest on the agent's device.

    The environments may share this process and change torch's settings; sampling and updates use
    merl's settings.

    Args:
        agent: the learner.
        replay: the replay, with all steps of the run so far.
        randomness: the run's random streams.
        config: the config of the run.
        warn: receives the reason if the replay is not copied to the GPU.
        updates: number of updates so far.
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
        torch.cuda.empty_cache()  # return the cached memory of the timed agents
        if config.replay.compress:
            warn("the compressed replay stays on the host: each update copies its batch to the GPU")
        elif bytes_on_device(replay) > ROOM * torch.cuda.mem_get_info()[0]:
            warn("the replay does not fit on the GPU: each update copies its batch to the GPU")
        else:
            copy = OnDevice(replay, agent.device)
            seed = randomness.on_device(updates)
            return UpdateOnDevice(agent, copy, config.replay.batch_size, seed)
        size = config.replay.batch_size
        return UpdateFromHost(agent, lambda: replay.sample(size, randomness.batches))
    return update_from_host(agent, replay, randomness, config)


class Recorded:
    """An update that runs on the device alone; on a GPU it is recorded as a CUDA graph.

    A recorded update needs a single launch. There are two kinds of update, with and without the
    actor's step, and each kind has its own graph.

    Args:
        agent: the learner.
        batch: returns a batch on the agent's device, by the same operations in every call.
        generators: random generators on the device from which `batch` draws.
    """

    WARM_UP = 3
    """Number of updates of each kind before this kind is recorded."""

    def __init__(
        self, agent: DDPG, batch: Callable[[], Batch], generators: Sequence[torch.Generator] = ()
    ) -> None:
        self._agent, self._batch = agent, batch
        self._generators = (*generators, agent.learning)
        self._sigma = agent.sigma = torch.zeros((), device=agent.device)
        self._on_gpu = agent.device.type == "cuda"
        self._side = torch.cuda.Stream() if self._on_gpu else None  # type: ignore[no-untyped-call]
        # The key is the kind of update: whether it includes the actor's step.
        self._graphs: dict[bool, torch.cuda.CUDAGraph] = {}
        self._names: dict[bool, tuple[str, ...]] = {}
        self._values: dict[bool, Tensor] = {}  # the metrics that the graph writes
        self._made: Counter[bool] = Counter()

    def __call__(self) -> dict[str, Tensor]:
        """Make one update and return its metrics, scalars on the device."""
        self._sigma.fill_(self._agent.config.noise(self._agent.step))
        self._agent.set_step_size()
        kind, updates = self._agent.actor_is_due, self._agent.updates
        self._made[kind] += 1
        if not self._on_gpu:
            values = self._learn()
        elif self._made[kind] <= self.WARM_UP:
            values = self._learn_on_stream()
        else:
            if kind not in self._graphs:
                self._graphs[kind] = self._record()
            self._graphs[kind].replay()
            values = self._values[kind].clone()
        self._agent.updates = updates + 1  # replaying a graph does not count it
        return dict(zip(self._names[kind], values.unbind(), strict=True))

    def _learn(self) -> Tensor:
        batch, kind = self._batch(), self._agent.actor_is_due
        metrics = self._agent.learn(batch, self._agent.draw(len(batch.action)))
        self._names[kind] = tuple(metrics)
        return torch.stack([value.float() for value in metrics.values()])

    def _learn_on_stream(self) -> Tensor:
        """Make an update on a separate stream, which CUDA graphs require for the warm-up."""
        assert self._side is not None
        self._side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._side):
            values = self._learn()
        torch.cuda.current_stream().wait_stream(self._side)
        return values

    def _record(self) -> torch.cuda.CUDAGraph:
        """Record an update on the same stream: graphs of one stream share the cuBLAS workspace."""
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            graph.register_generator_state(generator)
        gc.collect()  # freeing objects during the recording could make it fail
        current = torch.cuda.stream(torch.cuda.current_stream())  # restored after a failure
        failure: Exception | None = None
        kind = self._agent.actor_is_due
        try:
            with current, torch.cuda.graph(graph, stream=self._side):
                try:
                    self._values[kind] = self._learn()
                except Exception as error:
                    failure = error
                    raise
        except Exception as error:  # after a failure, ending the recording fails as well
            raise failure or error from None
        return graph


class UpdateOnDevice:
    """An update with a batch from a copy of the replay on the device, without waiting for the host.

    Args:
        agent: the learner.
        copy: the copy of the replay, on the agent's device.
        batch_size: B.
        seed: seed of the sampling.
    """

    def __init__(self, agent: DDPG, copy: OnDevice, batch_size: int, seed: int) -> None:
        generator = torch.Generator(agent.device).manual_seed(seed)
        self._copy = copy
        self._recorded = Recorded(agent, lambda: copy.sample(batch_size, generator), [generator])

    def __call__(self) -> dict[str, Tensor]:
        """Make one update and return its metrics, scalars on the device."""
        self._copy.follow()
        return self._recorded()


class UpdateFromHost:
    """An update with a batch from the replay on the host, which is copied to the agent's GPU.

    Args:
        agent: the learner, on a GPU.
        draw: returns a batch on the host, always of the same shape.
    """

    def __init__(self, agent: DDPG, draw: Callable[[], Batch]) -> None:
        self._draw, self._device = draw, agent.device
        self._on_device: Batch | None = None  # the graph reads this batch
        self._recorded = Recorded(agent, self._batch)

    def __call__(self) -> dict[str, Tensor]:
        """Make one update and return its metrics, scalars on the device."""
        batch = self._draw()
        if self._on_device is None:
            self._on_device = batch.to(self._device)
        else:
            _overwrite(self._on_device, batch)
        return self._recorded()

    def _batch(self) -> Batch:
        assert self._on_device is not None
        return self._on_device


def _overwrite(target: Batch, batch: Batch) -> None:
    """Copy a batch into the tensors of another one, without waiting for a GPU."""
    for old, new in zip(_tensors(target), _tensors(batch), strict=True):
        old.copy_(new.pin_memory() if old.is_cuda else new, non_blocking=True)


def _tensors(batch: Batch) -> list[Tensor]:
    observations = (batch.observation, batch.next_observation)
    observed = [value for observation in observations for value in observation.values()]
    return [*observed, batch.action, batch.reward, batch.discount]
