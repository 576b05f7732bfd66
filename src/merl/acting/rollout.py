"""The frame stack for acting, transfers to and from the device, and sums over an episode."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from merl.core import Observation
from merl.modalities import Modality


class FrameStack:
    """The last frames of each camera and the newest other values, as stored, for acting.

    The replay stores single frames and makes the same stack when sampling. At the start of an
    episode the first frame is repeated.

    Args:
        modalities: the modality of each key.
        frames: number of frames in a stack, K.
        device: device of the stacked observations.
    """

    def __init__(
        self, modalities: Mapping[str, Modality], frames: int, device: torch.device
    ) -> None:
        self._modalities, self._length, self.device = modalities, frames, device
        self._last: dict[str, deque[NDArray[Any]]] = {
            key: deque(maxlen=frames if modality.stacked else 1)
            for key, modality in modalities.items()
        }

    def reset(self, observation: Observation) -> Observation:
        """Start an episode with its first observation; return it as stored."""
        for _ in range(self._length):
            stored = self.push(observation)
        return stored

    def push(self, observation: Observation) -> Observation:
        """Add the observation after a step; return it as stored."""
        stored = {key: m.to_stored(observation[key]) for key, m in self._modalities.items()}
        for key, modality in self._modalities.items():
            # An environment may reuse the array.
            value = stored[key].copy() if modality.stacked else stored[key]
            self._last[key].append(value)
        return stored

    def observation(self) -> dict[str, torch.Tensor]:
        """Return a batch of size one: (1, K, *shape) of stacked frames, else (1, *shape)."""
        return side_by_side([self])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the stacked observation as NumPy arrays, without a batch dimension."""
        return {
            key: np.stack(last) if self._modalities[key].stacked else last[-1]
            for key, last in self._last.items()
        }


def side_by_side(stacks: Sequence[FrameStack]) -> dict[str, torch.Tensor]:
    """Return the observations of several stacks as one batch (N, ...) on their device."""
    device = stacks[0].device
    seen = [stack.arrays() for stack in stacks]
    return {
        key: bring(torch.from_numpy(np.stack([arrays[key] for arrays in seen])), device)
        for key in seen[0]
    }


def bring(tensor: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Copy a tensor to the device without waiting for a GPU, which needs pinned memory."""
    if device.type == "cuda":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


class Fetched:
    """An asynchronous copy of a tensor to the host.

    `wait` does not wait for GPU work that is queued after this copy.

    Attributes:
        under_way: the copy from the GPU has not been waited for yet.
    """

    def __init__(self, tensor: torch.Tensor) -> None:
        self.under_way = tensor.is_cuda
        self._result = tensor
        if self.under_way:
            self._result = torch.empty(
                tensor.shape, dtype=tensor.dtype, device="cpu", pin_memory=True
            )
            self._result.copy_(tensor, non_blocking=True)
            self._done = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._done.record()

    def wait(self) -> torch.Tensor:
        """Wait for the copy and return the tensor on the host."""
        if self.under_way:
            self._done.synchronize()
            self.under_way = False
        return self._result


@dataclass
class Episode:
    """Sums over the steps of an episode.

    Attributes:
        total_reward: the undiscounted return.
        length: number of steps.
        success: whether the last step reported success; None if no step reported success or
            failure.
        reports: number of steps that reported success or failure.
        successes: number of steps that reported success.
        terms: the sum of each reward term.
    """

    total_reward: float = 0.0
    length: int = 0
    success: bool | None = None
    reports: int = 0
    successes: int = 0
    terms: dict[str, float] = field(default_factory=dict)

    def add(self, reward: float, info: Mapping[str, Any]) -> None:
        """Add one step."""
        self.total_reward += reward
        self.length += 1
        if "success" in info:
            self.success = bool(info["success"])
            self.reports += 1
            self.successes += self.success
        elif self.success is not None:
            self.success = False
        for name, value in info.get("reward_terms", {}).items():
            self.terms[name] = self.terms.get(name, 0.0) + float(value)

    @property
    def success_share(self) -> float:
        """Return the share of successes among the steps that reported success or failure."""
        return self.successes / self.reports if self.reports else 0.0

    def metrics(self, *, reports_success: bool = False) -> dict[str, float]:
        """Return the metrics of the episode by name.

        Args:
            reports_success: the environment is known to report success, so an episode without a
                report counts as a failure.
        """
        values = {"return": self.total_reward, "length": float(self.length)}
        if reports_success or self.success is not None:
            values |= {
                "success_end": float(bool(self.success)),
                "success_any": float(self.successes > 0),
                "success_share": self.success_share,
            }
        return values | {f"reward/{name}": value for name, value in self.terms.items()}


def report_success(episodes: Sequence[Episode]) -> bool:
    """Return whether any of these episodes has reported success or failure."""
    return any(episode.success is not None for episode in episodes)


def mean_metrics(episodes: Sequence[Episode], *, reports_success: bool) -> dict[str, float]:
    """Return the mean metrics of episodes that ended at the same step; see `Episode.metrics`."""
    each = [episode.metrics(reports_success=reports_success) for episode in episodes]
    return {
        name: fmean(metrics[name] for metrics in each if name in metrics)
        for name in dict.fromkeys(name for metrics in each for name in metrics)
    }
