"""Types that the packages of merl share: observation, transition, batch, agent.

An *observation* is a dict of modalities. A *transition* holds a `discount`: 0 if the episode
terminated, else 1 (after a time limit the value is bootstrapped). A *batch* is the input of one
update.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Observation = Mapping[str, NDArray[Any]]
"""The observation of one timestep: `merl.modalities` has the types and shapes. It holds single
frames; acting and replay stack them."""

Kind = Literal["image", "depth", "vector", "sequence"]
"""Kinds of observations; `merl.modalities` has a class for each."""

FrameTransform = Callable[[int, NDArray[np.uint8], NDArray[np.uint8]], None]
"""A function that copies a stack of frames from the replay into a batch, e.g. with a random shift.
Arguments: the index of the sample in the batch, the frames (K, H, W, C), and the output array."""
FrameTransforms = Mapping[str, FrameTransform]
"""A frame transform for each image key."""

CONFIG_FILE = "config.json"
"""File in a run folder that holds the config of the run."""
METRICS_FILE = "metrics.csv"
"""File in a run folder that holds the metrics of the run."""


@dataclass(frozen=True)
class Transition:
    """One environment transition.

    Attributes:
        action: the action taken, float32 (A,), in [-1, 1].
        reward: the reward of the step.
        discount: 0.0 if the episode terminated, else 1.0 (also if a time limit truncated it).
        observation: the observation after the step.
        last: the episode is over, by termination or truncation.
    """

    action: NDArray[np.float32]
    reward: float
    discount: float
    observation: Observation
    last: bool


@dataclass(frozen=True)
class Batch:
    """The input of one update: B samples of (o_t, a_t, r_{t:t+n-1}, o_{t+n}).

    Attributes:
        observation: o_t, as stored (`merl.modalities`): stacked frames (B, K, H, W, C) with the
            oldest of the K first, images uint8 and depth int16; vectors float32 (B, n), histories
            float32 (B, T, n).
        action: a_t, float32 (B, A), in [-1, 1].
        reward: sum of gamma^i r_{t+i} for i < m, float32 (B,); m = n, or less if the episode ends
            earlier.
        discount: gamma^m, or 0 if the episode terminated; float32 (B,).
        next_observation: o_{t+m}, with the same keys, shapes and types as `observation`.
    """

    observation: dict[str, Tensor]
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_observation: dict[str, Tensor]

    def to(self, device: torch.device) -> Batch:
        """Return the batch on `device`; return `self` if it is already there."""
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
    """Interface of an agent: everything that acting, training, evaluation and saving use.

    Attributes:
        step: environment steps so far; the training loop sets it, and exploration may depend on it.
    """

    step: int

    @property
    def senses(self) -> tuple[str, ...]:
        """Return the observation keys that the policy uses."""
        ...

    def act(self, observation: Mapping[str, Tensor], *, explore: bool) -> Tensor:
        """Return actions (B, A) in [-1, 1] for stacked observations.

        Args:
            observation: images uint8 (B, K, H, W, C), vectors float32 (B, n).
            explore: whether to add exploration noise.
        """
        ...

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """Make one gradient step on every network; return metrics as scalars on the device."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all state that updates depend on: weights, optimizers, random generators."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`."""
        ...
