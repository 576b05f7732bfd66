"""Config of the replay."""

from __future__ import annotations

from dataclasses import dataclass

from merl.core import MerlError, counted

MOST_N_STEP, MOST_FRAME_STACK = 1000, 100
"""Upper bounds for sampling in reasonable time and memory."""


@dataclass(frozen=True)
class ReplayConfig:
    """Contents of the replay and how it is sampled."""

    capacity: int = 1_000_000
    """Maximum number of steps in the replay; a shorter run reserves only its own length."""
    batch_size: int = 256
    """Samples per update."""
    n_step: int = 3
    """Number of rewards that are summed before the critic's estimate (n-step return)."""
    frame_stack: int = 3
    """Number of consecutive images in one observation."""
    discount: float = 0.99
    """Discount factor per step (gamma), from 0 to 1."""
    compress: bool = False
    """Compress images without loss to about a quarter of the space; sampling takes longer. Noisy
    images of a real camera need more space, so that the replay holds fewer steps."""

    def __post_init__(self) -> None:
        for name in ("capacity", "batch_size", "n_step", "frame_stack"):
            value = getattr(self, name)
            if value < 1:
                raise MerlError(
                    f"replay.{name.replace('_', '-')} is {value}: give a whole number of at least 1"
                )
        for name, most in (("n_step", MOST_N_STEP), ("frame_stack", MOST_FRAME_STACK)):
            if getattr(self, name) > most:
                flag = name.replace("_", "-")
                raise MerlError(f"replay.{flag} is {getattr(self, name)}: give at most {most}")
        if not 0 <= self.discount <= 1:
            raise MerlError(f"replay.discount is {self.discount}: give a number from 0 to 1")
        if self.batch_size > self.capacity:
            raise MerlError(
                f"replay.batch-size {self.batch_size} is larger than a replay of "
                f"{counted(self.capacity, 'step')}: give at most {self.capacity}, or raise "
                "replay.capacity"
            )
