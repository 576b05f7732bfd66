"""DrQ-v2 (Yarats et al. 2021a): the same learner on pixels alone.

Its trunk, Linear, LayerNorm and tanh to 50 numbers, one for the critic and one for the actor, is
MERL's fusion with a single modality. docs/agents/drqv2.md has every value's source.
"""

from __future__ import annotations

from dataclasses import dataclass

from merl.agents.config import AgentConfig, Target


@dataclass(frozen=True)
class DrQV2Config(AgentConfig):
    """DrQ-v2: pixels alone, with its authors' values."""

    vectors: tuple[str, ...] | None = ()
    """Vector keys to feel: none."""
    latent_dim: int = 50
    """Length of the trunk's output."""
    target: Target = "heads_and_fusion"
    """What has an averaged copy: the Q-heads and the trunk before them, or the heads alone."""
    head_norm: bool = False
    """LayerNorm in the hidden layers of actor and critic."""
    noise_std: float = 1.0
    """Standard deviation of the exploration noise at the start, also used in both updates."""
    noise_std_end: float | None = 0.1
    """What it falls to, in a straight line over `noise_steps`; None: it stays as it is."""
