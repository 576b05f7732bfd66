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
    """Check the output of an environment step before it enters the replay.

    Args:
        observation: only float arrays are checked; integers are always finite.
        reward: the reward of the step.
        step: environment steps so far, for the message.
        where: appended to the step in the message, e.g. "of an evaluation".

    Raises:
        NotFinite: a value is NaN or infinite, or the reward does not fit into float32; the message
            names the value and the step.
    """
    at = f"at step {step:,} {where}".rstrip()
    if not abs(reward) <= float(
        np.finfo(np.float32).max
    ):  # the replay stores float32, in which a larger reward is infinite
        beyond = ", which is beyond float32," if math.isfinite(reward) else ""
        raise NotFinite(f"the environment's reward is {reward}{beyond} {at}")
    for key, value in observation.items():
        value = np.asarray(value)
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            index = np.flatnonzero(~np.isfinite(value))[0]
            place = f"at index {index} {at}"
            raise NotFinite(f"the environment's observation {key!r} is {value.flat[index]} {place}")


def check_weights(groups: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Check weights before they are saved.

    Args:
        groups: tensors by name, for each group of networks.

    Raises:
        NotFinite: a weight is NaN or infinite; the message names its tensor.
    """
    for group, tensors in groups.items():
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                raise NotFinite(f"the weights {group}.{name} are no longer finite")


class LossGuard:
    """A check of the metrics of each update for NaN and infinity.

    On the CPU, `watch` raises immediately. On a GPU it does not synchronize: the number of the
    first bad step stays on the device until `check` reads it.
    """

    def __init__(self) -> None:
        # The first bad step of each metric; updates with different metrics have separate entries.
        self._first: dict[tuple[str, ...], Tensor] = {}

    def watch(self, metrics: Mapping[str, Tensor], step: int) -> None:
        """Record the metrics of an update at `step`; do nothing if there are no metrics.

        Raises:
            NotFinite: a metric is NaN or infinite (raised here on the CPU only); the message names
                the metric and the step.
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
        """Check all recorded metrics.

        Raises:
            NotFinite: a metric was NaN or infinite; the message names the first bad step and the
                metrics that were bad at that step.
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
