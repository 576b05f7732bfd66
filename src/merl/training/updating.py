"""How an update comes by its batch: from the replay on the host, or on the device that learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from merl.agents.ddpg import DDPG
from merl.replay import Lanes
from merl.replay.on_device import OnDevice, bytes_on_device
from merl.training.config import TrainConfig
from merl.training.loop import Randomness, Update

ROOM = 0.8
"""Share of a GPU's free memory that a copy of the replay may take."""


def update_from_host(
    agent: DDPG, replay: Lanes, randomness: Randomness, config: TrainConfig
) -> Update:
    """Batches drawn from the replay on the host, and brought over if need be.

    On a CPU the random shift is made in the very copy that takes pictures out of the replay.
    """
    size, batches = config.replay.batch_size, randomness.batches

    def update() -> dict[str, Tensor]:
        if agent.device.type != "cpu":
            return agent.update(replay.sample(size, batches))
        draws = agent.draw(size)
        batch = replay.sample(size, batches, *agent.copies(draws))
        return agent.learn(batch, replace(draws, shifts={}, next_shifts={}))

    return update


def make_update(
    agent: DDPG,
    replay: Lanes,
    randomness: Randomness,
    config: TrainConfig,
    warn: Callable[[str], None],
) -> Update:
    """What learns fastest where the agent lives.

    Args:
        agent: the learner.
        replay: with all that was remembered so far.
        randomness: the run's random streams.
        config: of the run.
        warn: is told why a GPU does not hold the replay.
    """
    if agent.device.type == "cuda":
        if config.replay.compress:
            warn("a compressed replay stays on the host: each update's batch is brought over")
        elif bytes_on_device(replay.lanes) > ROOM * torch.cuda.mem_get_info()[0]:
            warn("the replay does not fit on the GPU: each update's batch is brought over")
        else:
            copy = OnDevice(replay.lanes, agent.device)
            return UpdateOnDevice(agent, copy, config.replay.batch_size, randomness.device)
    return update_from_host(agent, replay, randomness, config)


class UpdateOnDevice:
    """Draws a batch from a copy of the replay and learns from it, without asking the host.

    On a GPU the whole update, from the draw to the target's average, is recorded once, after
    `WARM_UP` updates, and is one CUDA graph from then on.

    Args:
        agent: the learner.
        copy: of the replay, on its device.
        batch_size: B.
        seed: of what is drawn.
    """

    WARM_UP = 3

    def __init__(self, agent: DDPG, copy: OnDevice, batch_size: int, seed: int) -> None:
        self._agent, self._copy, self._batch_size = agent, copy, batch_size
        self._generator = torch.Generator(agent.device).manual_seed(seed)
        agent.sigma = torch.zeros((), device=agent.device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._names: tuple[str, ...] = ()
        self._values: Tensor | None = None
        self._made = 0

    def __call__(self) -> dict[str, Tensor]:
        """One update; returns its metrics, scalars on the device."""
        agent = self._agent
        assert agent.sigma is not None
        self._copy.follow()
        agent.sigma.fill_(agent.config.noise(agent.step))
        self._made += 1
        if agent.device.type != "cuda":
            return self._learn()
        if self._made <= self.WARM_UP:
            return self._learn_aside()
        if self._graph is None:
            self._graph = self._record()
        self._graph.replay()
        assert self._values is not None
        return dict(zip(self._names, self._values.clone().unbind(), strict=True))

    def _learn(self) -> dict[str, Tensor]:
        batch = self._copy.sample(self._batch_size, self._generator)
        return self._agent.learn(batch, self._agent.draw(self._batch_size))

    def _learn_aside(self) -> dict[str, Tensor]:
        """On a stream of its own, as CUDA graphs want their warm-up."""
        aside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            told = self._learn()
        torch.cuda.current_stream().wait_stream(aside)
        return told

    def _record(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        for generator in (self._generator, self._agent.learning):
            graph.register_generator_state(generator)
        with torch.cuda.graph(graph):
            told = self._learn()
            self._values = torch.stack([value.float() for value in told.values()])
        self._names = tuple(told)
        return graph
