"""Experts as policies: they act in an environment in the same way as a trained agent."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.arm_env import ArmEnv
from merl.tasks.expert import make_expert
from merl.tasks.hand_control import AXES, HandControl


class ExpertPolicy:
    """A policy that solves a task from the simulator's state and ignores the observation.

    Call `reset()` before every episode, then call the policy with each observation.

    Args:
        env: an `ArmEnv`, wrapped or not; wrappers must not change the actions.

    Raises:
        MerlError: the environment is not an `ArmEnv`, or its task has no expert.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        arm_env = env.unwrapped
        if not isinstance(arm_env, ArmEnv):
            raise MerlError(
                f"there is no expert for {arm_env}: experts only solve the tasks of merl.tasks"
            )
        self._env = arm_env
        self._expert = make_expert(arm_env.task, arm_env.physics)
        self._fresh = True

    def reset(self) -> None:
        """Start a new plan, for a new episode."""
        self._fresh = True

    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """Return the action to take now, float32 (9,), in [-1, 1].

        Raises:
            MerlError: the environment is closed.
        """
        if self._expert.physics is not self._env.physics:  # the environment was closed and reset
            self._expert = make_expert(self._env.task, self._env.physics)
            self._fresh = True
        if self._fresh:
            self._expert.reset()
        self._fresh = False
        return self._env.action_for(self._expert.act())


class HandMotion:
    """Actions that move the hand as a person commands it.

    Args:
        env: an `ArmEnv`, wrapped or not; wrappers must not change the actions.

    Raises:
        MerlError: the robot has another hand than the Jaco hand.
    """

    axes = AXES

    def __init__(self, env: ArmEnv) -> None:
        self._env, self._control = env, HandControl(env.task, env.physics)

    def __call__(self, command: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the action for a command, (5,), in [-1, 1], in the order of `axes`."""
        self._control.command = command
        return self._env.action_for(self._control.act())
