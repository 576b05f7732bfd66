"""The contracts between the rooms: what flows from the environment to the learner.

Names follow the field: an *observation* is a dict of modalities, a *transition* holds a `discount`
(0 at a true end, else 1; a time limit bootstraps), a *batch* is what one update learns from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch
    from gymnasium import spaces
    from torch import Tensor

Observation = Mapping[str, NDArray[Any]]
"""One moment as the senses give it, a key per modality: an image is uint8 (H, W, C), a vector
float32 (n,). Frames are single; stacks are made by the actor and by replay."""

FrameTransform = Callable[[int, NDArray[np.uint8], NDArray[np.uint8]], None]
"""How a stack of frames is taken out of the replay for a batch: told are the sample's number in the
batch, the frames (K, H, W, C), and where they are to go."""
FrameTransforms = Mapping[str, FrameTransform]
"""By image key."""

CONFIG_FILE = "config.json"
"""Where a run's folder keeps what was run."""
METRICS_FILE = "metrics.csv"
"""Where a run's folder keeps its numbers."""


def is_image(space: spaces.Space[Any]) -> bool:
    """Whether a modality of this space is an image: a uint8 box of shape (H, W, C)."""
    return space.dtype == np.uint8 and space.shape is not None and len(space.shape) == 3


def is_vector(space: spaces.Space[Any]) -> bool:
    """Whether a modality of this space is a vector: a float box of shape (n,)."""
    floats = space.dtype is not None and np.issubdtype(space.dtype, np.floating)
    return bool(floats) and space.shape is not None and len(space.shape) == 1


@dataclass(frozen=True)
class Transition:
    """What one environment step brought.

    Attributes:
        action: what was done, float32 (A,), in [-1, 1].
        reward: what it paid.
        discount: 0.0 if the episode truly ended here, else 1.0 (a time limit is not an end).
        observation: what it led to.
        last: the episode is over, by a true end or a time limit.
    """

    action: NDArray[np.float32]
    reward: float
    discount: float
    observation: Observation
    last: bool


@dataclass(frozen=True)
class Batch:
    """What one update learns from: B samples of (o_t, a_t, r_{t:t+n-1}, o_{t+n}).

    Attributes:
        observation: o_t; images uint8 (B, K, H, W, C) with the oldest of the K stacked frames
            first, vectors float32 (B, n).
        action: a_t, float32 (B, A), in [-1, 1].
        reward: sum of gamma^i r_{t+i} for i < m, float32 (B,); m = n, or less where the episode
            is over sooner.
        discount: gamma^m, or 0 where the episode truly ended; float32 (B,).
        next_observation: o_{t+m}, as `observation`.
    """

    observation: dict[str, Tensor]
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_observation: dict[str, Tensor]

    def to(self, device: torch.device) -> Batch:
        """The same batch on `device`; itself if it is there already."""
        if self.action.device == device:
            return self
        return Batch(
            {key: value.to(device) for key, value in self.observation.items()},
            self.action.to(device),
            self.reward.to(device),
            self.discount.to(device),
            {key: value.to(device) for key, value in self.next_observation.items()},
        )


class Agent(Protocol):
    """What those who do not know the learner ask of it: acting, evaluating, saving.

    Attributes:
        step: environment steps so far, on which exploration may depend; set by who drives it.
    """

    step: int

    @property
    def senses(self) -> tuple[str, ...]:
        """The keys of an observation that it acts on."""
        ...

    def act(self, observation: Mapping[str, Tensor], *, explore: bool) -> Tensor:
        """Actions (B, A) in [-1, 1] for stacked observations, with exploration noise or without."""
        ...

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step on every network; the metrics come back as scalars on the device."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on: weights, optimizers, random generators."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take back what `state_dict` gave."""
        ...
