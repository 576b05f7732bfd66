"""The random numbers of an update as a value, so that a second implementation can use the same."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class UpdateNoise:
    """The random numbers of one update.

    Attributes:
        shifts: crop offsets of o_t by image key, int64 (B, 2); empty if images are shifted already.
        next_shifts: crop offsets of o_{t+n}, in the same form.
        next_noise: epsilon of the target's action, (B, A): scaled and clipped; in SAC standard
            normal.
        actor_noise: epsilon of the actor's action, in the same form.
    """

    shifts: dict[str, Tensor]
    next_shifts: dict[str, Tensor]
    next_noise: Tensor
    actor_noise: Tensor
