"""Guards: reject NaN and infinity before they reach replay, update or checkpoint."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from merl.core import NotFinite, Observation

_NEVER = torch.iinfo(torch.int64).max


def check_finite(observation: Observation, reward: float, step: int, where: str = "") -> None:
    """What an environment gave, before it enters the replay.

    Args:
        observation: images need no look, bytes are always numbers.
        reward: what led there paid.
        step: environment steps so far.
        where: what these are the steps of, where not of the run.

    Raises:
        NotFinite: naming the value and the step.
    """
    at = f"at step {step:,} {where}".rstrip()
    if not abs(reward) <= float(
        np.finfo(np.float32).max
    ):  # beyond it, the replay would keep infinity
        beyond = ", which is beyond float32," if math.isfinite(reward) else ""
        raise NotFinite(f"the environment's reward is {reward}{beyond} {at}")
    for key, value in observation.items():
        value = np.asarray(value)
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            index = np.flatnonzero(~np.isfinite(value))[0]
            place = f"in place {index} {at}"
            raise NotFinite(f"the environment's observation {key!r} is {value.flat[index]} {place}")


def check_weights(groups: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Weights, before they are saved.

    Raises:
        NotFinite: naming the tensor.
    """
    for group, tensors in groups.items():
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                raise NotFinite(f"the weights {group}.{name} are no longer finite")


class LossGuard:
    """Watches what the learner tells of its updates for a NaN or an infinity.

    On the CPU it raises at once. On a GPU nothing waits for the card: the first bad step's number
    stays there until `check` asks for it.
    """

    def __init__(self) -> None:
        # The first bad step of each metric, for each set of metrics that updates have.
        self._first: dict[tuple[str, ...], Tensor] = {}

    def watch(self, metrics: Mapping[str, Tensor], step: int) -> None:
        """Take in the metrics of an update at `step`; nothing, if there was none.

        Raises:
            NotFinite: on the CPU, naming the metric and the step.
        """
        if not metrics:
            return
        values = torch.stack([value.float() for value in metrics.values()])
        bad = torch.where(values.isfinite(), _NEVER, step)
        names = tuple(metrics)
        before = self._first.get(names)
        self._first[names] = bad if before is None else torch.minimum(before, bad)
        if not values.is_cuda:
            self.check()

    def check(self) -> None:
        """Look at what was watched.

        Raises:
            NotFinite: naming the metric that was bad first, and the step.
        """
        first = [
            pair
            for names, steps in self._first.items()
            for pair in zip(names, steps.tolist(), strict=True)
        ]
        step = min((step for _, step in first), default=_NEVER)
        if step != _NEVER:
            names = dict.fromkeys(name for name, bad in first if bad == step)
            raise NotFinite(f"the learner's {', '.join(names)} is not finite at step {step:,}")
