"""Scripted experts: they read the simulator's state and solve every task.

An expert for a box looks for a grasp that the arm can reach without touching anything, goes there,
closes its fingers, carries the box, and in the end corrects for where it really is. When it loses
the box it begins again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from dm_control import mjcf

from merl.tasks.grasping import OPEN, TILTS, find_approach, find_carry
from merl.tasks.jaco import JacoTask
from merl.tasks.kinematics import Array, Kinematics, Path, Pose
from merl.tasks.lift_box import LiftBox
from merl.tasks.move_box import MoveBox
from merl.tasks.reach_duplo import ReachDuplo

Actions = Iterator[Array]
"""Velocities, (9,), rad/s, for one step after another."""

CLOSED = 1.1
"""About where a box stops the fingers, rad: they slow down towards it."""
CLOSING_VELOCITY = 0.6
"""At least this is asked of the fingers until they are stopped, rad/s."""
STOPPED = 0.1
"""A finger slower than this is stopped, rad/s."""
GRIP = np.array([0.2, 0.1, 0.1])
"""Velocities asked of the fingers while they hold, rad/s: the one presses as much as the two."""
FINGER_GAIN = 8.0
"""Of a finger towards an angle, 1/s."""
TRACKING_GAIN = 6.0
"""Of a joint towards its path, 1/s."""
SERVO_GAIN = 4.0
"""Of the hand towards a pose, 1/s."""
ARRIVED = 0.015
"""A joint this near the end of its path is there, rad."""
SETTLING_STEPS = 12
"""At most so many to get there, after the path's time is over."""
CLOSING_STEPS = range(8, 30)
"""So many, at least and at most, for the fingers to close."""
SLIP = 0.03
"""A box that moved this far in the hand is lost, m."""
BACK_OFF = 0.1
"""How far the hand draws back from a box that it lost, m."""
ABOVE = np.array([0.0, 0.0, 0.04])
"""From where a box is set down, m above its place."""
ABOVE_BRICK = np.array([0.0, 0.0, 0.03])
"""Where the hand stays, m above the brick's origin, which is on its lower face."""
OVER_PLACE = 0.015
"""A box this near the vertical through its place can be set down, m."""


class BoxLostError(Exception):
    """The box is not where the fingers should hold it."""


class Expert:
    """Solves a task from the simulator's state, without randomness.

    Call `reset()` when an episode has begun, then `act()` before each of its steps.

    Args:
        task: what is to be solved.
        physics: its simulation, which is only read.
    """

    def __init__(self, task: JacoTask, physics: mjcf.Physics) -> None:
        self.task, self.physics = task, physics
        self.arm = Kinematics(task, physics)
        self._low, self._high = physics.model.actuator_ctrlrange.T.copy()
        self._joints, self._fingers = physics.bind(task.arm.joints), physics.bind(task.hand.joints)
        self._actions: Actions = iter(())

    def reset(self) -> None:
        """An episode has begun."""
        self._actions = PLANS[type(self.task)](self)

    def act(self) -> Array:
        """The velocities to ask of the joints now, (9,), rad/s."""
        velocities: Array = np.clip(next(self._actions), self._low, self._high)
        return velocities

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
        """Of the pinch site."""
        return self.arm.pose(self.q)

    @property
    def box(self) -> Pose:
        """Of the object."""
        task, physics = self.task, self.physics
        return Pose(task.prop_position(physics), task.prop_rotation(physics))

    def reach(self) -> Actions:
        """Go to the object."""
        rotation = self.hand.rotation
        while True:
            yield self.towards(Pose(self.box.position + ABOVE_BRICK, rotation), np.zeros(3))

    def lift(self) -> Actions:
        """Take hold of the box and hold it at its target."""
        assert isinstance(self.task, LiftBox)
        assert self.task.target is not None
        tilts = [tilt for tilt in TILTS if np.cos(tilt) >= self.task.vertical_cosine]
        while True:
            try:
                yield from self._carry(self.task.target, tilts, upright=True)
                yield from self._hold_at(self.task.target)
            except BoxLostError:
                yield from self._back_off()

    def move(self) -> Actions:
        """Take hold of the box, set it down at its target, and stay there."""
        assert self.task.target is not None
        while True:
            try:
                yield from self._carry(self.task.target + ABOVE, TILTS, upright=False)
                yield from self._hold_at(self.task.target, from_above=True)
            except BoxLostError:
                yield from self._back_off()

    def _carry(self, goal: Array, tilts: Sequence[float], upright: bool) -> Actions:
        """Grasp the box and bring its middle near (3,), m."""
        self.arm.load(self.physics, OPEN)
        approach = find_approach(self.arm, self.q, self.box, goal, tilts, upright)
        if approach is None:
            raise BoxLostError
        yield from self._follow(approach, lambda: self._bend(OPEN))
        yield from self._close(approach[-1])
        held = self.hand.relative(self.box)
        self.arm.load(self.physics, self.fingers)
        path = find_carry(self.arm, self.q, held, goal, upright)
        if path is None:
            raise BoxLostError
        for velocities in self._follow(path, lambda: GRIP):
            slip = self.hand.relative(self.box).position - held.position
            if np.linalg.norm(slip) > SLIP:
                raise BoxLostError
            yield velocities

    def _hold_at(self, place: Array, from_above: bool = False) -> Actions:
        """Keep the box in the grip and its middle at (3,), m."""
        rotation, held = self.hand.rotation, self.hand.relative(self.box).position
        while True:
            hand, box = self.hand, self.box
            if np.linalg.norm(hand.relative(box).position - held) > SLIP:
                raise BoxLostError
            error = place - box.position
            if from_above and np.linalg.norm(error[:2]) > OVER_PLACE:
                error = error + ABOVE
            yield self.towards(Pose(hand.position + error, rotation), GRIP)

    def _back_off(self) -> Actions:
        """Open the fingers and draw the hand back."""
        q = self.q
        back = self.arm.solve(q, self.hand.shifted(-BACK_OFF * self.hand.rotation[:, 2]))
        yield from self._follow([q], lambda: self._bend(OPEN))
        yield from self._follow([q, q if back is None else back], lambda: self._bend(OPEN))

    def _close(self, q: Array) -> Actions:
        """Close the fingers until something stops them, with the arm at `q`."""
        for step in range(CLOSING_STEPS.stop):
            velocities = np.array(self._fingers.qvel)
            if step in CLOSING_STEPS and np.abs(velocities).max() < STOPPED:
                break
            fingers = np.maximum(self._bend(np.full(3, CLOSED)), CLOSING_VELOCITY)
            yield self._limited(TRACKING_GAIN * (q - self.q), fingers)

    def _follow(self, path: Path, fingers: Callable[[], Array]) -> Actions:
        """Move the arm along a path and let it come to rest."""
        reference = self.arm.timed(path)
        forward = np.diff(reference, axis=0, append=reference[-1:]) / self.task.control_timestep
        for q, velocity in zip(reference, forward, strict=True):
            yield self._limited(velocity + TRACKING_GAIN * (q - self.q), fingers())
        for _ in range(SETTLING_STEPS):
            error = path[-1] - self.q
            if np.abs(error).max() < ARRIVED:
                break
            yield self._limited(TRACKING_GAIN * error, fingers())

    def towards(self, pose: Pose, fingers: Array) -> Array:
        """Velocities that bring the hand nearer to a pose."""
        twist = self.hand.twist_to(pose)
        return self._limited(self.arm.turn(self.q, SERVO_GAIN * twist), fingers)

    def _limited(self, arm: Array, fingers: Array) -> Array:
        """Velocities of arm and fingers; the arm's keep their direction within the limits."""
        excess = np.abs(arm / self.arm.max_velocity).max()
        return np.concatenate([arm / max(1.0, excess), fingers])

    def _bend(self, angles: Array) -> Array:
        """Velocities of the fingers towards angles."""
        return FINGER_GAIN * (angles - self.fingers)


PLANS: dict[type[JacoTask], Callable[[Expert], Actions]] = {
    ReachDuplo: Expert.reach,
    MoveBox: Expert.move,
    LiftBox: Expert.lift,
}
"""What an expert does in which task."""
