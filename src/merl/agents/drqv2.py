"""DrQ-v2 (Yarats et al. 2021a): the same learner on images alone.

Its trunk (Linear, LayerNorm and tanh to 50 features; one for the critic and one for the actor) is
MERL's fusion with a single modality. docs/explanation/agents/drqv2.md has each value's source.
"""

from __future__ import annotations

from dataclasses import dataclass

from merl.agents.config import AgentConfig, Target
from merl.core import Kind


@dataclass(frozen=True)
class DrQV2Config(AgentConfig):
    """DrQ-v2: images alone, with the values of its authors."""

    modalities: tuple[Kind, ...] = ("image", "depth")
    """Kinds of observations to use if `keys` is not set: cameras alone."""
    latent_dim: int = 50
    """Length of the trunk's output."""
    target: Target = "heads_and_fusion"
    """Networks that have a target copy: the Q-heads and their trunk, or the heads alone."""
    head_norm: bool = False
    """LayerNorm in the hidden layers of actor and critic."""
    noise_std: float = 1.0
    """Standard deviation of the exploration noise at the start, also used in updates."""
    noise_std_end: float | None = 0.1
    """Final standard deviation, reached linearly over `noise_steps`; None: it is constant."""
