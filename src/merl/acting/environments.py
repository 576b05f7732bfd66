"""Environments for acting: the interface of all, and the one that runs in this process.

`send` actions, then `receive` the results. Between these calls, environments in worker processes
(`workers.py`) step while the learner updates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from merl.acting.generators import (
    environment_state,
    seed_global_generators,
    set_environment_state,
)
from merl.core import Observation


class Step(NamedTuple):
    """The result of one environment step; see `gymnasium.Env.step`."""

    observation: Observation
    reward: float
    terminated: bool
    truncated: bool
    info: Mapping[str, Any]


class WorkerDied(Exception):  # noqa: N818 (the run restarts the workers)
    """A worker process died or does not answer: the episodes in progress are lost."""


class Environments(ABC):
    """One or several environments that step together.

    Where there is nothing to send, restore, restart or close, these methods stay as they are here.

    Attributes:
        count: number of environments.
        action_shape: shape of one action, (A,).
    """

    count: int
    action_shape: tuple[int, ...]

    @abstractmethod
    def reset(self, seeds: Mapping[int, int | None]) -> dict[int, Observation]:
        """Start an episode in each of the given environments.

        Args:
            seeds: environment index -> seed, or None for no seed. A seed also seeds the global
                random generators of the environment's process.

        Returns:
            The first observation of each of these environments.

        Raises:
            WorkerDied: a process died or did not answer.
        """

    def send(self, actions: NDArray[np.float32]) -> None:  # noqa: B027
        """Start a step in every environment with its action, (count, A) in [-1, 1].

        Raises:
            WorkerDied: a process died.
        """

    @abstractmethod
    def receive(self) -> list[Step]:
        """Wait for all environments and return the results of their steps.

        Raises:
            WorkerDied: a process died or did not answer in time.
        """

    @abstractmethod
    def states(self) -> list[dict[str, Any]]:
        """Return the `environment_state()` of each environment."""

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:  # noqa: B027
        """Restore from `states()`."""

    def restart(self) -> None:  # noqa: B027
        """Start all environments again after one was lost.

        Raises:
            WorkerDied: they cannot be started.
        """

    def close(self) -> None:  # noqa: B027
        """Close all environments that this object has made."""


class InProcessEnvs(Environments):
    """One environment in this process; it steps inside `receive`.

    Args:
        env: the environment; the caller closes it.
    """

    count = 1

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        self.action_shape = env.action_space.shape or ()
        self._action: NDArray[np.float32] | None = None

    def reset(self, seeds: Mapping[int, int | None]) -> dict[int, Observation]:
        """See `Environments`."""
        observations = {}
        for index, seed in seeds.items():
            if seed is not None:
                seed_global_generators(seed)
            observations[index] = self._env.reset(seed=seed)[0]
        return observations

    def send(self, actions: NDArray[np.float32]) -> None:
        """See `Environments`."""
        self._action = actions[0]

    def receive(self) -> list[Step]:
        """See `Environments`."""
        observation, reward, terminated, truncated, info = self._env.step(self._action)
        return [Step(observation, float(reward), terminated, truncated, info)]

    def states(self) -> list[dict[str, Any]]:
        """See `Environments`."""
        return [environment_state(self._env)]

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        """See `Environments`."""
        set_environment_state(self._env, states[0])
