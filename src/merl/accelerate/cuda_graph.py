"""Updates that run on a GPU alone, recorded as a CUDA graph."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from merl.accelerate.device_replay import DeviceReplay
from merl.core import Accelerable, Batch, UpdatePlan


class Recorded:
    """An update that runs on the device alone; on a GPU it is recorded as a CUDA graph.

    A recorded update needs a single launch.

    Args:
        agent: the learner.
        batch: returns a batch on the agent's device, by the same operations in every call.
        generators: random generators on the device from which `batch` draws.
    """

    WARM_UP = 3
    """Number of updates before one is recorded."""

    def __init__(
        self,
        agent: Accelerable,
        batch: Callable[[], Batch],
        generators: Sequence[torch.Generator] = (),
    ) -> None:
        self._agent, self._batch = agent, batch
        self._generators = (*generators, agent.learning)
        self._on_gpu = agent.device.type == "cuda"
        self._side = torch.cuda.Stream() if self._on_gpu else None  # type: ignore[no-untyped-call]
        # A graph reads the numbers of its plan from these tensors, which change between updates.
        self._plan = UpdatePlan(*(torch.zeros((), device=agent.device) for _ in UpdatePlan._fields))
        self._graph: torch.cuda.CUDAGraph | None = None
        self._names: tuple[str, ...] = ()  # of the metrics
        self._values: Tensor  # the metrics that the graph writes
        self._made = 0

    def __call__(self, step: int) -> dict[str, Tensor]:
        """Make one update at `step` and return its metrics, scalars on the device."""
        plan = self._agent.plan(step)
        if not self._on_gpu:
            return self._learn(plan)
        for kept, value in zip(self._plan, plan, strict=True):
            assert isinstance(kept, Tensor)
            kept.fill_(value)
        plan = self._plan
        self._made += 1
        if self._made <= self.WARM_UP:
            values = self._learn_on_stream(plan)
        else:
            if self._graph is None:
                self._graph = self._record(plan)
            self._graph.replay()
            values = self._values.clone()
        return dict(zip(self._names, values.unbind(), strict=True))

    def _learn(self, plan: UpdatePlan) -> dict[str, Tensor]:
        batch = self._batch()
        return self._agent.learn(batch, self._agent.draw(len(batch.action), plan), plan)

    def _learn_on_device(self, plan: UpdatePlan) -> Tensor:
        """Make an update; return its metrics as one tensor, whose names are kept."""
        metrics = self._learn(plan)
        self._names = tuple(metrics)
        return torch.stack([value.float() for value in metrics.values()])

    def _learn_on_stream(self, plan: UpdatePlan) -> Tensor:
        """Make an update on a separate stream, which CUDA graphs require for the warm-up."""
        assert self._side is not None
        self._side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._side):
            values = self._learn_on_device(plan)
        torch.cuda.current_stream().wait_stream(self._side)
        return values

    def _record(self, plan: UpdatePlan) -> torch.cuda.CUDAGraph:
        """Record an update on the same stream, whose cuBLAS workspace it uses."""
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            graph.register_generator_state(generator)
        gc.collect()  # freeing objects during the recording could make it fail
        current = torch.cuda.stream(torch.cuda.current_stream())  # restored after a failure
        failure: Exception | None = None
        try:
            with current, torch.cuda.graph(graph, stream=self._side):
                try:
                    self._values = self._learn_on_device(plan)
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

    def __init__(self, agent: Accelerable, copy: DeviceReplay, batch_size: int, seed: int) -> None:
        generator = torch.Generator(agent.device).manual_seed(seed)
        self._copy = copy
        self._recorded = Recorded(agent, lambda: copy.sample(batch_size, generator), [generator])

    def __call__(self, step: int) -> dict[str, Tensor]:
        """Make one update at `step` and return its metrics, scalars on the device."""
        self._copy.follow()
        return self._recorded(step)


class UpdateFromHost:
    """An update with a batch from the replay on the host, which is copied to the agent's GPU.

    Args:
        agent: the learner, on a GPU.
        draw: returns a batch on the host. The update is recorded anew where the sizes differ from
            those of the last batch, which happens where the share of demonstrations changes.
    """

    def __init__(self, agent: Accelerable, draw: Callable[[], Batch]) -> None:
        self._draw, self._agent = draw, agent
        self._on_device: Batch | None = None  # the graph reads this batch
        self._recorded = Recorded(agent, self._batch)

    def __call__(self, step: int) -> dict[str, Tensor]:
        """Make one update at `step` and return its metrics, scalars on the device."""
        batch = self._draw()
        if self._on_device is None or _sizes(batch) != _sizes(self._on_device):
            self._on_device = batch.to(self._agent.device)
            self._recorded = Recorded(self._agent, self._batch)
        else:
            _overwrite(self._on_device, batch)
        return self._recorded(step)

    def _batch(self) -> Batch:
        assert self._on_device is not None
        return self._on_device


def _overwrite(target: Batch, batch: Batch) -> None:
    """Copy a batch into the tensors of another one, without waiting for a GPU."""
    for old, new in zip(_tensors(target), _tensors(batch), strict=True):
        old.copy_(new.pin_memory() if old.is_cuda else new, non_blocking=True)


def _sizes(batch: Batch) -> list[torch.Size]:
    return [tensor.shape for tensor in _tensors(batch)]


def _tensors(batch: Batch) -> list[Tensor]:
    observations = (batch.observation, batch.next_observation)
    observed = [value for observation in observations for value in observation.values()]
    shown = [] if batch.shown is None else [batch.shown]
    return [*observed, batch.action, batch.reward, batch.discount, *shown]
