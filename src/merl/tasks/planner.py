"""Expert for the occluded tasks: it follows a collision-free path under the disc.

It finds a grasp that the arm can reach without a collision, moves there, closes the fingers,
carries the box, and finally corrects the error of the box's position. If it loses the box, it
starts again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from merl.tasks.controller import Controller
from merl.tasks.grasping import OPEN, TILTS, find_approach, find_carry
from merl.tasks.kinematics import Array, Path, Pose
from merl.tasks.lift_box import LiftBox

Actions = Iterator[Array]
"""Joint velocities, (9,), rad/s, one array for each step."""

CLOSED = 1.1
"""Angle at which a box stops the fingers, approximately, rad. They slow down towards it."""
CLOSING_VELOCITY = 0.6
"""Minimum velocity commanded to the closing fingers until they stop, rad/s."""
STOPPED = 0.1
"""A finger slower than this counts as stopped, rad/s."""
GRIP = np.array([0.2, 0.1, 0.1])
"""Velocities commanded to the fingers while they hold the box, rad/s. The first finger presses as
hard as the other two together."""
TRACKING_GAIN = 6.0
"""Gain from the error of a joint on its path to its velocity, 1/s."""
SERVO_GAIN = 4.0
"""Gain from the error of the hand's pose to its velocity, 1/s."""
ARRIVED = 0.015
"""A joint this close to the end of its path has arrived, rad."""
SETTLING_STEPS = 12
"""Maximum number of steps to arrive after the duration of the path."""
CLOSING_STEPS = range(8, 30)
"""Minimum and maximum number of steps for the fingers to close."""
SLIP = 0.03
"""A box that has moved further than this in the hand is lost, m."""
BACK_OFF = 0.1
"""Distance by which the hand retreats from a lost box, m."""
ABOVE = np.array([0.0, 0.0, 0.04])
"""Offset above its target from which a box is set down, m."""
OVER_PLACE = 0.015
"""A box this close to the vertical line through its target can be set down, m."""


class BoxLostError(Exception):
    """The fingers do not hold the box, or no free path to it or with it is found."""


class Planner(Controller):
    """An expert for a box that follows a path to it, and with it."""

    def reset(self) -> None:
        """Start a new plan, for a new episode."""
        self._actions = self._lift() if isinstance(self.task, LiftBox) else self._move()

    def _act(self) -> Array:
        return next(self._actions)

    def _lift(self) -> Actions:
        """Grasp the box and hold it at its target."""
        assert isinstance(self.task, LiftBox)
        assert self.task.target is not None
        tilts = [tilt for tilt in TILTS if np.cos(tilt) >= self.task.vertical_cosine]
        while True:
            try:
                yield from self._carry(self.task.target, tilts, upright=True)
                yield from self._hold_at(self.task.target)
            except BoxLostError:
                yield from self._back_off()

    def _move(self) -> Actions:
        """Grasp the box, set it down at its target, and keep holding it there."""
        assert self.task.target is not None
        while True:
            try:
                yield from self._carry(self.task.target + ABOVE, TILTS, upright=False)
                yield from self._hold_at(self.task.target, from_above=True)
            except BoxLostError:
                yield from self._back_off()

    def _carry(self, goal: Array, tilts: Sequence[float], upright: bool) -> Actions:
        """Grasp the box and bring its centre near `goal`, (3,), m."""
        self.arm.load(self.physics, OPEN)
        approach = find_approach(self.arm, self.q, self.box, goal, tilts, upright)
        if approach is None:
            raise BoxLostError
        yield from self._follow(approach, lambda: self.bend(OPEN))
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
        """Keep the box in the grip, with its centre at `place`, (3,), m."""
        rotation, held = self.hand.rotation, self.hand.relative(self.box).position
        while True:
            hand, box = self.hand, self.box
            if np.linalg.norm(hand.relative(box).position - held) > SLIP:
                raise BoxLostError
            error = place - box.position
            if from_above and np.linalg.norm(error[:2]) > OVER_PLACE:
                error = error + ABOVE
            yield self.towards(Pose(hand.position + error, rotation), SERVO_GAIN, GRIP)

    def _back_off(self) -> Actions:
        """Open the fingers and retract the hand."""
        q = self.q
        back = self.arm.solve(q, self.hand.shifted(-BACK_OFF * self.hand.rotation[:, 2]))
        yield from self._follow([q], lambda: self.bend(OPEN))
        yield from self._follow([q, q if back is None else back], lambda: self.bend(OPEN))

    def _close(self, q: Array) -> Actions:
        """Close the fingers until an object stops them, and keep the arm at `q`."""
        for step in range(CLOSING_STEPS.stop):
            velocities = np.array(self._fingers.qvel)
            if step in CLOSING_STEPS and np.abs(velocities).max() < STOPPED:
                break
            fingers = np.maximum(self.bend(np.full(3, CLOSED)), CLOSING_VELOCITY)
            yield self.limited(TRACKING_GAIN * (q - self.q), fingers)

    def _follow(self, path: Path, fingers: Callable[[], Array]) -> Actions:
        """Move the arm along a path and let it come to rest."""
        reference = self.arm.timed(path)
        forward = np.diff(reference, axis=0, append=reference[-1:]) / self.task.control_timestep
        for q, velocity in zip(reference, forward, strict=True):
            yield self.limited(velocity + TRACKING_GAIN * (q - self.q), fingers())
        for _ in range(SETTLING_STEPS):
            error = path[-1] - self.q
            if np.abs(error).max() < ARRIVED:
                break
            yield self.limited(TRACKING_GAIN * error, fingers())
