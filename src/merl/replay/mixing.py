"""Batches of which a part comes from demonstrations (RLPD, Ball et al. 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from merl.core import Batch, FrameTransform, FrameTransforms
from merl.replay.buffer import ReplayBuffer

INTENDED = "intended action"
"""Observation key under which a replay of demonstrations holds the intended action."""


class MixedReplay:
    """A source of batches: first samples of demonstrations, then samples of the run's own replay.

    Args:
        own: the replay of the run.
        demos: the demonstrations, the first of which are not empty, with the intended actions as
            observation `INTENDED`; each step of any of them has the same probability.
        ratio: share of the demonstrations in a batch; at least one sample is of them.

    Attributes:
        ratio: the share in the next batch, which may change during a run.
    """

    def __init__(self, own: ReplayBuffer, demos: Sequence[ReplayBuffer], ratio: float) -> None:
        self.own, self.demos, self.ratio = own, demos, ratio

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        now: FrameTransforms | None = None,
        then: FrameTransforms | None = None,
    ) -> Batch:
        """Draw a batch; see `ReplayBuffer.sample`."""
        shown = max(1, round(self.ratio * batch_size))
        counts, parts, drawn = [shown], list[Batch](), 0
        if len(self.demos) > 1:
            lengths = np.array([len(each) for each in self.demos])
            counts = rng.multinomial(shown, lengths / lengths.sum()).tolist()
        sources = [*zip(self.demos, counts, strict=True), (self.own, batch_size - shown)]
        for source, count in sources:
            if not count:
                continue
            moved = (_moved(each or {}, drawn) for each in (now, then))
            part = source.sample(count, rng, *moved)
            parts.append(part if source is self.own else _with_intended(part))
            drawn += count
        return parts[0] if len(parts) == 1 else _joined(parts)


def _joined(parts: Sequence[Batch]) -> Batch:
    """Return one batch with the samples of several, in order."""
    shown = [part.shown for part in parts if part.shown is not None]
    return Batch(
        _joined_values([part.observation for part in parts]),
        torch.cat([part.action for part in parts]),
        torch.cat([part.reward for part in parts]),
        torch.cat([part.discount for part in parts]),
        _joined_values([part.next_observation for part in parts]),
        torch.cat(shown),
    )


def _joined_values(each: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    return {key: torch.cat([values[key] for values in each]) for key in each[-1]}


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
