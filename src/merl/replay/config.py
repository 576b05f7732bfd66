"""Config of the replay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from merl.core import MerlError, counted
from merl.core.fields import Range, check_fields


@dataclass(frozen=True)
class ReplayConfig:
    """Contents of the replay and how it is sampled."""

    capacity: Annotated[int, Range(1)] = 1_000_000
    """Maximum number of steps in the replay; a shorter run reserves only its own length."""
    batch_size: Annotated[int, Range(1)] = 256
    """Samples per update."""
    n_step: Annotated[int, Range(1, 1000)] = 3
    """Number of rewards that are summed before the critic's estimate (n-step return)."""
    frame_stack: Annotated[int, Range(1, 100)] = 3
    """Number of consecutive images in one observation."""
    discount: Annotated[float, Range(0, 1)] = 0.99
    """Discount factor per step (gamma), from 0 to 1."""
    compress: bool = False
    """Compress images without loss to about a quarter of the space; sampling takes longer. Noisy
    images of a real camera need more space, so that the replay holds fewer steps."""

    def __post_init__(self) -> None:
        check_fields(self, "replay.")
        if self.batch_size > self.capacity:
            raise MerlError(
                f"replay.batch-size {self.batch_size} is larger than a replay of "
                f"{counted(self.capacity, 'step')}: give at most {self.capacity}, or raise "
                "replay.capacity"
            )
