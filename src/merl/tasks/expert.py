"""Scripted experts that read the simulator's state and solve every task.

They remember nothing: each velocity is a function of the state alone, so they recover from noise,
from a push and from a lost box, and what they do can be imitated. Only the occluded tasks need an
expert that plans (`merl.tasks.planner`).
"""

from __future__ import annotations

import mujoco
import numpy as np
from dm_control import mjcf

from merl.core import MerlError
from merl.tasks.arm_task import ArmTask
from merl.tasks.box import BOX_HALF_SIZE, BoxTask
from merl.tasks.controller import Controller
from merl.tasks.grasping import FINGERS_MIDDLE, OPEN, hand_rotation
from merl.tasks.kinematics import Array, Pose
from merl.tasks.lift_box import LiftBox
from merl.tasks.move_box import MoveBox
from merl.tasks.planner import Planner
from merl.tasks.reach_duplo import ReachDuplo

ABOVE_BRICK = np.array([0.0, 0.0, 0.04])
"""Goal of the hand, relative to the brick's origin, which is on the brick's lower face, m."""
NEAR_BRICK = 0.03
"""Beyond this distance from its goal the hand moves as fast as the joints can, m."""
PULL = 60.0
"""Gain of that motion, from the error along a joint's motion to its velocity, rad/(s m^2)."""
REACH_GAIN = 8.0
"""Gain from the error of the hand's position to its velocity, near the brick, 1/s."""

SERVO_GAIN = 18.0
"""Gain from the error of the hand's pose to its velocity, 1/s. The joints take some steps to
follow: with more the hand swings, with less it drifts under noise."""
GRASP = np.array([0.0, FINGERS_MIDDLE, 0.0])
"""Position of the box's centre between the fingers, in the frame of the hand, m."""
RAISED = np.array([0.0, 0.0, 0.006])
"""Height of the grasp above that position, m: the fingers stay off the floor."""
IN_REACH = 0.012
"""The fingers close if the box is this close to its place between them, m: along and across."""
GIVE = 0.018
"""With closing fingers the box may be further away by up to this, m: they move it."""
ALIGNED = 0.25
"""They close if the hand is turned to the box's faces with at most this error, rad."""
CLOSED = 0.9
"""Angle of the fingers from which they count as closed, rad."""
CONE_TOP, CONE_SLOPE = 0.09, 4.0
"""The hand descends to the box in a cone: the height of the goal above the grasp is the slope times
the horizontal distance, at most the top, m."""
CENTRED = 0.006
"""Horizontal distance at which the hand is over the box, m."""
TURN_LENGTH = 0.03
"""Weight of one radian of turn, as metres of that distance."""
FIRM = 2.0
"""Force of the fingers, on either side of the box, from which it is held, N."""
LOST = 0.03
"""A box that is further than this from its place between the fingers is not held, m."""
CLOSING = np.full(3, 3.0)
"""Velocities commanded to the fingers that close, rad/s."""
GRIP = np.array([3.0, 1.5, 1.5])
"""Velocities commanded to the fingers that hold the box, rad/s. The first finger presses as hard as
the other two together."""
BALANCE = 2.0
"""Gain that keeps both sides of the grip at equal angles, 1/s."""
CARRIED = 0.03
"""Height above its target at which a box is carried to it over the floor, m."""
SET_DOWN = 0.02
"""A box this close to its target, horizontally, is set down, m."""
OFF_FLOOR = 0.01
"""A box moves sideways at full speed once it is raised by this, m."""
RELEASED, KEPT = 0.004, 0.008
"""A held box this close to its target on the floor is released, and then left there while it is
closer than the second distance, m."""
HOVER = np.array([0.0, 0.0, 0.03])
"""Height of the hand above the grasp of a box that is in its place, m."""


def make_expert(task: ArmTask, physics: mjcf.Physics) -> Controller:
    """Return the expert of a task.

    Args:
        task: the task to solve.
        physics: the simulation of the task; the expert only reads it.

    Raises:
        MerlError: the task has no expert.
    """
    if isinstance(task, ReachDuplo):
        return Reacher(task, physics)
    if isinstance(task, MoveBox | LiftBox):
        return Planner(task, physics) if task.occluded else Carrier(task, physics)
    raise MerlError(f"task {type(task).__name__} has no scripted expert for its robot")


class Reacher(Controller):
    """Moves the hand to the object: fast, with any rotation, and then with the hand upright."""

    def _act(self) -> Array:
        hand, goal = self.hand, self.box.position + ABOVE_BRICK
        error = goal - hand.position
        if np.linalg.norm(error) > NEAR_BRICK:
            to_velocities = self.arm.jacobian(self.q)[:3].T
            return np.concatenate([PULL * (to_velocities @ error), np.zeros(3)])
        return self.towards(Pose(goal, upright(hand, hand)[0]), REACH_GAIN, np.zeros(3))


class Carrier(Controller):
    """Grasps a box from above and brings it to its target: it holds it there, or sets it down."""

    def __init__(self, task: BoxTask, physics: mjcf.Physics) -> None:
        super().__init__(task, physics)
        assert task.target is not None
        self._target, self._in_air = task.target, isinstance(task, LiftBox)
        hand, model = task.robot.hand.mjcf_model, physics.model
        self._finger_of = np.full(model.nbody, -1)
        for finger in range(3):
            for part in ("finger", "finger_tip"):
                body = hand.find("body", f"b_{part}_{finger + 1}")
                self._finger_of[physics.bind(body).element_id] = finger
        self._box_body = int(physics.bind(task.prop.mjcf_model.find_all("geom")[0]).bodyid)

    def _act(self) -> Array:
        hand, box, forces = self.hand, self.box, self._forces()
        rotation, turn = upright(hand, box)
        grasp = Pose(box.position - rotation @ GRASP + RAISED, rotation)
        off = hand.relative(box).position - GRASP
        is_held = min(forces[0], forces[1:].sum()) > FIRM and np.linalg.norm(off) < LOST
        if not self._in_air and self._distance(box) < (RELEASED if is_held else KEPT):
            place = hand.position if forces.any() else grasp.position + HOVER
            return self.towards(Pose(place, rotation), SERVO_GAIN, self.bend(OPEN))
        if is_held:
            return self._carry(hand, box)
        reach = IN_REACH + GIVE * self._closure()
        if np.linalg.norm(off[:2]) < reach and abs(off[2]) < reach and abs(turn) < ALIGNED:
            return self.towards(grasp, SERVO_GAIN, CLOSING)
        away = np.linalg.norm((hand.position - grasp.position)[:2]) + TURN_LENGTH * abs(turn)
        height = np.clip(CONE_SLOPE * (away - CENTRED), 0.0, CONE_TOP)
        above = grasp.shifted(np.array([0.0, 0.0, height]))
        return self.towards(above, SERVO_GAIN, self.bend(OPEN))

    def _carry(self, hand: Pose, box: Pose) -> Array:
        """Move the held box towards its target."""
        error = self._target - box.position
        if not self._in_air:
            level = float(np.linalg.norm(error[:2]))
            error[2] += CARRIED * min(1.0, level / SET_DOWN)
            if level > SET_DOWN:  # it is lifted before it is carried
                error[:2] *= np.clip((box.position[2] - BOX_HALF_SIZE) / OFF_FLOOR, 0.0, 1.0)
        angles = self.fingers
        sides = np.array([angles[0], angles[1:].mean()])
        balance = BALANCE * (sides.mean() - sides)
        pose = Pose(hand.position + error, upright(hand, hand)[0])
        return self.towards(pose, SERVO_GAIN, GRIP + balance[[0, 1, 1]])

    def _closure(self) -> float:
        """Return by how much the fingers are closed, from 0 (open) to 1."""
        share = (self.fingers.mean() - OPEN[0]) / (CLOSED - OPEN[0])
        return float(np.clip(share, 0.0, 1.0))

    def _distance(self, box: Pose) -> float:
        return float(np.linalg.norm(self._target - box.position))

    def _forces(self) -> Array:
        """Return the normal force of each finger on the box, (3,), N."""
        forces, wrench = np.zeros(3), np.zeros(6)
        model, data = self.physics.model, self.physics.data
        for index, contact in enumerate(data.contact):
            bodies = model.geom_bodyid[[contact.geom1, contact.geom2]]
            if self._box_body not in bodies:
                continue
            finger = self._finger_of[bodies].max()
            if finger >= 0:
                mujoco.mj_contactForce(model.ptr, data.ptr, index, wrench)
                forces[finger] += wrench[0]
        return forces


def upright(hand: Pose, box: Pose) -> tuple[Array, float]:
    """Return the nearest rotation of a hand that points down, aligned to a box, and the turn.

    Returns:
        The rotation, (3, 3), and the angle from the hand's to it, rad, at most pi / 4.
    """
    opening, face = hand.rotation[:, 0], box.rotation[:, np.abs(box.rotation[2]).argmin()]
    now, aligned = (float(np.arctan2(axis[1], axis[0])) for axis in (opening, face))
    turn = (aligned - now + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return hand_rotation(now + turn - np.pi / 2, 0.0), turn
