"""Base of the experts: what they read of the simulation, and how they move the arm."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from dm_control import mjcf
from dm_control.entities.manipulators.kinova import JacoHand

from merl.core import MerlError
from merl.tasks.arm_task import ArmTask
from merl.tasks.kinematics import Array, Kinematics, Pose

FINGER_GAIN = 8.0
"""Gain from the error of a finger's angle to its velocity, 1/s."""


class Controller(ABC):
    """A deterministic policy that reads the simulator's state.

    Call `reset()` after the start of an episode, then `act()` before each of its steps.

    Args:
        task: the task to solve.
        physics: the simulation of the task; the controller only reads it.

    Raises:
        MerlError: the task's robot has another hand than the Jaco hand.
    """

    def __init__(self, task: ArmTask, physics: mjcf.Physics) -> None:
        if not isinstance(task.robot.hand, JacoHand):
            raise MerlError(f"task {type(task).__name__} has no scripted expert for its robot")
        self.task, self.physics = task, physics
        self.arm = Kinematics(task, physics)
        self._low, self._high = physics.model.actuator_ctrlrange.T.copy()
        self._joints = physics.bind(task.robot.arm.joints)
        self._fingers = physics.bind(task.robot.hand.joints)

    def reset(self) -> None:  # noqa: B027 (most controllers remember nothing)
        """Start a new episode."""

    def act(self) -> Array:
        """Return the joint velocities for the next step, (9,), rad/s."""
        velocities: Array = np.clip(self._act(), self._low, self._high)
        return velocities

    @abstractmethod
    def _act(self) -> Array:
        """Return the joint velocities, which `act` clips to their limits."""

    @property
    def q(self) -> Array:
        """Angles of the arm's joints, (6,), rad."""
        return np.array(self._joints.qpos)

    @property
    def fingers(self) -> Array:
        """Angles of the fingers, (3,), rad."""
        return np.array(self._fingers.qpos)

    @property
    def hand(self) -> Pose:
        """Pose of the pinch site."""
        return self.arm.pose(self.q)

    @property
    def box(self) -> Pose:
        """Pose of the object."""
        task, physics = self.task, self.physics
        return Pose(task.prop_position(physics), task.prop_rotation(physics))

    def towards(self, pose: Pose, gain: float, fingers: Array) -> Array:
        """Return velocities that move the hand towards a pose.

        Args:
            pose: where the hand shall be.
            gain: from the error of the hand's pose to its velocity, 1/s.
            fingers: velocities of the fingers, (3,), rad/s.
        """
        twist = self.hand.twist_to(pose)
        return self.limited(self.arm.turn(self.q, gain * twist), fingers)

    def limited(self, arm: Array, fingers: Array) -> Array:
        """Join velocities of arm and fingers; scale those of the arm down to their limits."""
        excess = np.abs(arm / self.arm.max_velocity).max()
        return np.concatenate([arm / max(1.0, excess), fingers])

    def bend(self, angles: Array) -> Array:
        """Return velocities that move the fingers towards `angles`, (3,), rad."""
        return FINGER_GAIN * (angles - self.fingers)
