"""Batches of which a part comes from demonstrations (RLPD, Ball et al. 2023)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from merl.core import Batch, FrameTransform, FrameTransforms
from merl.replay.buffer import ReplayBuffer

INTENDED = "intended action"
"""Observation key under which a replay of demonstrations holds the intended action."""


class MixedReplay:
    """A source of batches: first samples of demonstrations, then samples of the run's own replay.

    Args:
        own: the replay of the run.
        demos: the demonstrations, with the intended actions as observation `INTENDED`.
        ratio: share of the demonstrations in a batch, in (0, 1].
    """

    def __init__(self, own: ReplayBuffer, demos: ReplayBuffer, ratio: float) -> None:
        self.own, self.demos, self.ratio = own, demos, ratio

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        now: FrameTransforms | None = None,
        then: FrameTransforms | None = None,
    ) -> Batch:
        """Draw a batch; see `ReplayBuffer.sample`."""
        count = max(1, round(self.ratio * batch_size))
        shown = _with_intended(self.demos.sample(count, rng, now, then))
        if count == batch_size:
            return shown
        own = self.own.sample(
            batch_size - count, rng, _moved(now or {}, count), _moved(then or {}, count)
        )
        return Batch(
            {
                key: torch.cat([shown.observation[key], own.observation[key]])
                for key in own.observation
            },
            torch.cat([shown.action, own.action]),
            torch.cat([shown.reward, own.reward]),
            torch.cat([shown.discount, own.discount]),
            {
                key: torch.cat([shown.next_observation[key], own.next_observation[key]])
                for key in own.next_observation
            },
            shown.shown,
        )


def _with_intended(batch: Batch) -> Batch:
    """Move the intended actions from the observations to `shown`."""
    batch.next_observation.pop(INTENDED)
    return replace(batch, shown=batch.observation.pop(INTENDED))


def _moved(transforms: FrameTransforms, count: int) -> FrameTransforms:
    """Return frame transforms for samples that follow `count` others in the batch."""
    return {key: _Moved(transform, count) for key, transform in transforms.items()}


class _Moved:
    def __init__(self, transform: FrameTransform, count: int) -> None:
        self._transform, self._count = transform, count

    def __call__(self, index: int, frames: NDArray[Any], output: NDArray[Any]) -> None:
        self._transform(index + self._count, frames, output)
