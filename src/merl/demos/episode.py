"""An episode that was recorded, and the recording of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import MerlError, Observation


@dataclass(frozen=True)
class Episode:
    """A recorded episode.

    Attributes:
        observations: {key: (T + 1, ...)}, as the environment returned them.
        actions: (T, A), float32, in [-1, 1], as they were executed.
        intended: the actions without the noise that was added to them, in the same form.
        rewards: (T,), float32.
        terminated: whether it ended by termination, not by a time limit.
        success: whether it was solved at its last step; None if the environment does not say.
        successes: whether it was solved after each step, (T,); None if that is unknown.
    """

    observations: Mapping[str, NDArray[Any]]
    actions: NDArray[np.float32]
    intended: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: bool
    success: bool | None
    successes: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.actions)


def check_episode(
    where: str, episode: Episode, observation_space: spaces.Dict, action_space: spaces.Box
) -> None:
    """Check that an episode is one of an environment with these spaces.

    Args:
        where: its file or name, for messages.
        episode: the episode.
        observation_space: the environment's observations.
        action_space: its actions.

    Raises:
        MerlError: a value has another shape or type, or is out of range, NaN or infinite.
    """
    steps = len(episode)
    for key, space in observation_space.spaces.items():
        expected, values = (steps + 1, *(space.shape or ())), episode.observations[key]
        if values.shape != expected or values.dtype != space.dtype:
            raise MerlError(
                f"{where}: observation {key!r} is {values.dtype} {values.shape}, not "
                f"{space.dtype} {expected}"
            )
    if episode.rewards.shape != (steps,) or episode.rewards.dtype.kind != "f":
        raise MerlError(
            f"{where}: rewards are {episode.rewards.dtype} {episode.rewards.shape}, not one number "
            f"for each of {steps} steps"
        )
    solved = episode.successes
    if solved is not None and (solved.shape != (steps,) or solved.dtype != np.bool_):
        raise MerlError(f"{where}: success is {solved.dtype} {solved.shape}, not bool {(steps,)}")
    for each in (episode.actions, episode.intended):
        if each.shape != (steps, *action_space.shape) or each.dtype.kind != "f":
            raise MerlError(
                f"{where}: actions are {each.dtype} {each.shape}, not "
                f"{(steps, *action_space.shape)}"
            )
        if np.abs(each).max(initial=0.0) > 1.0:
            raise MerlError(f"{where}: actions are beyond [-1, 1]: rescale them")
    numbers = (episode.actions, episode.intended, episode.rewards, *episode.observations.values())
    if any(each.dtype.kind == "f" and not np.isfinite(each).all() for each in numbers):
        raise MerlError(f"{where} contains NaN or infinity: leave the episode out")


class EpisodeRecording:
    """An episode while it is recorded.

    Args:
        observation: the observation after the reset.
    """

    def __init__(self, observation: Observation) -> None:
        self._observations = [_copied(observation)]
        self._actions: list[NDArray[np.float32]] = []
        self._intended: list[NDArray[np.float32]] = []
        self._rewards: list[float] = []
        self._successes: list[bool | None] = []

    def __len__(self) -> int:
        """Return the number of steps so far."""
        return len(self._rewards)

    def add(
        self,
        action: NDArray[np.float32],
        intended: NDArray[np.float32],
        observation: Observation,
        reward: float,
        info: Mapping[str, Any],
    ) -> None:
        """Append a step.

        Args:
            action: the executed action.
            intended: the action before noise or limits.
            observation: the observation after the step.
            reward: the reward of the step.
            info: the environment's, of which `success` is kept.
        """
        self._observations.append(_copied(observation))
        self._actions.append(action)
        self._intended.append(intended)
        self._rewards.append(reward)
        self._successes.append(bool(info["success"]) if "success" in info else None)

    def finish(self, *, terminated: bool) -> Episode:
        """Return the episode, which has at least one step."""
        keys = self._observations[0]
        told = [each for each in self._successes if each is not None]
        return Episode(
            {key: np.stack([each[key] for each in self._observations]) for key in keys},
            np.stack(self._actions),
            np.stack(self._intended),
            np.array(self._rewards, np.float32),
            terminated,
            bool(self._successes[-1]) if told else None,  # no report after others is a failure
            np.array(told) if len(told) == len(self) else None,
        )


def _copied(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return a copy: an environment may write the next observation into the same arrays."""
    return {key: np.array(value) for key, value in observation.items()}
