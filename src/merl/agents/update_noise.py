"""The random numbers of an update, as a value: a second implementation can be given the same."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class UpdateNoise:
    """The random numbers of one update.

    Attributes:
        shifts: crops of o_t, per image key int64 (B, 2); none where the batch is shifted already.
        next_shifts: crops of o_{t+n}, likewise.
        next_noise: epsilon of the target's action, (B, A): clipped here, standard normal in SAC.
        actor_noise: epsilon of the actor's action, likewise.
    """

    shifts: dict[str, Tensor]
    next_shifts: dict[str, Tensor]
    next_noise: Tensor
    actor_noise: Tensor
