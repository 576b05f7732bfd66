"""Types that the packages of merl share: observation, transition, batch, agent.

An *observation* is a dict of modalities. A *transition* holds a `discount`: 0 if the episode
terminated, else 1 (after a time limit the value is bootstrapped). A *batch* is the input of one
update.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, runtime_checkable

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
LOCK_FILE = "lock"
"""File in a run folder that the process that trains the run locks."""
EVALUATION_FILE = "evaluation.json"
"""File in a run folder that holds the evaluation at the end, if a sweep trained the run."""
HARMLESS = (
    "steps",
    "minutes",
    "worker_restarts",
    "worker_timeout",
    "save_every",
    "log",
    "keep",
    "device",
    "threads",
    "env.render_size",
    "eval.every",
    "eval.episodes",
    "eval.max_episode_steps",
    "eval.video",
    "eval.references",
    "demos",
    "actors.listen",
    "actors.token",
    "actors.weights_every",
    "agent.precision",
    "agent.torch_compile",
)
"""Fields of a run's config that affect its length, speed and monitoring, but not what it learns.
They may change on resume, and runs that differ in them alone are compared as seeds."""


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
        shown: for the first N samples, which come from demonstrations, the actions as intended,
            without the noise that was added to them, float32 (N, A); None without demonstrations.
    """

    observation: dict[str, Tensor]
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_observation: dict[str, Tensor]
    shown: Tensor | None = None

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
            None if self.shown is None else self.shown.to(device),
        )


@dataclass(frozen=True)
class UpdateNoise:
    """The random numbers of one update, as a value that a second implementation can use too.

    Attributes:
        shifts: crop offsets of o_t by key, int64 (B, 2); empty if frames are shifted already.
        next_shifts: crop offsets of o_{t+n}, in the same form.
        next_noise: epsilon of the target's action, (B, A): scaled and clipped; in SAC standard
            normal.
        actor_noise: epsilon of the actor's action, in the same form.
        pair: the two Q-functions of the target, int64 (2,); None if there are no others.
    """

    shifts: dict[str, Tensor]
    next_shifts: dict[str, Tensor]
    next_noise: Tensor
    actor_noise: Tensor
    pair: Tensor | None = None


class UpdatePlan(NamedTuple):
    """Values of an update that change with the step.

    They are scalar tensors on the device where the update is recorded once and then repeated.
    """

    noise_std: float | Tensor
    """Standard deviation of the action noise in the update."""
    step_size: float | Tensor
    """Step size of the optimizers."""
    clone_weight: float | Tensor = 0.0
    """Weight of the term that clones demonstrations, in the actor's loss."""


@runtime_checkable
class Agent(Protocol):
    """Interface of an agent: everything that acting, training, evaluation and saving use.

    docs/howto/agent.md shows how to add one.
    """

    @property
    def senses(self) -> tuple[str, ...]:
        """Return the observation keys that the policy uses."""
        ...

    def act(self, observation: Mapping[str, Tensor], *, explore: bool, step: int) -> Tensor:
        """Return actions (B, A) in [-1, 1] for stacked observations.

        Args:
            observation: as in `Batch`, on the device.
            explore: whether to add exploration noise.
            step: environment steps so far, on which the noise may depend.
        """
        ...

    def update(self, batch: Batch, noise: Any = None, *, step: int) -> dict[str, Tensor]:
        """Learn from a batch; return metrics as scalars on the device.

        Args:
            batch: the samples; may be on another device.
            noise: random numbers of the update, in the agent's own form; None (as in training): the
                agent draws them. For comparison with a second implementation.
            step: environment steps so far, on which schedules may depend.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all state that updates depend on: weights, optimizers, random generators.

        Dicts of tensors by name, e.g. `network.state_dict()`, are saved as weights; the rest may
        hold tensors and plain values.
        """
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`."""
        ...

    def load_policy(self, weights: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Restore what `act` needs, for deployment, from the dicts of tensors in `state_dict()`."""
        ...


@runtime_checkable
class Accelerable(Agent, Protocol):
    """An agent whose `update` is plan, draw and learn, which training can make faster.

    On a CPU, images are shifted while they are copied from the replay. On a GPU, draw and learn are
    recorded as a CUDA graph: their operations are the same in every update.

    Attributes:
        device: device of the agent.
        learning: random generator of `draw`.
    """

    device: torch.device
    learning: torch.Generator

    def plan(self, step: int) -> UpdatePlan:
        """Return the values of an update that depend on the step."""
        ...

    def draw(self, size: int, plan: UpdatePlan) -> UpdateNoise:
        """Draw the random numbers of an update with a batch of `size` samples."""
        ...

    def frame_transforms(self, noise: UpdateNoise) -> tuple[FrameTransforms, FrameTransforms]:
        """Return the shifts of o_t and of o_{t+n} as transforms that the replay applies."""
        ...

    def learn(self, batch: Batch, noise: UpdateNoise, plan: UpdatePlan) -> dict[str, Tensor]:
        """Make the update, with a batch on the device; return metrics as scalars there."""
        ...
