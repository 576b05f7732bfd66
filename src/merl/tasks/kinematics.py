"""The arm on paper: inverse kinematics, collisions and timing, on a copy of the simulation.

Lengths are in metres, angles in radians, times in seconds. `q` is the angles of the six arm joints,
(6,). The hand's pose is that of its pinch site: z is where the hand points, x the axis along which
the fingers open.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import mujoco
import numpy as np
from dm_control import mjcf
from numpy.typing import NDArray

from merl.tasks.jaco import CONTROL_TIMESTEP, JacoTask

Array = NDArray[np.float64]
Path = list[Array]
"""q after q, with straight lines between them."""

CLEARANCE = 0.004
"""What is nearer than this touches, m: the arm strays a little from its plan."""
SCENE_CLEARANCE = 0.006
"""The robot's distance from what is fixed, the floor excepted, m."""
HELD_CLEARANCE = 0.015
"""The same for a held object, which moves in the grip and lags behind with the hand, m."""
SUNK = 5e-4
"""The resting object sinks into the floor by less than this, m."""
FLOOR_CLEARANCE = 1e-3
"""The robot keeps this distance from the floor, m: a finger that scrapes over it does not close."""
DAMPING = 0.02
"""Of the least squares, m: bounds the step near singular poses."""
LEVER = 0.15
"""What a radian of orientation weighs against position, m."""
MAX_TURN = 0.5
"""The most that a joint turns in one iteration, rad."""
ITERATIONS = 25
"""A pose that is not reached after so many is out of reach."""
TOLERANCE = 1e-3
"""How near to a pose is there, m, and rad times `LEVER`."""
LINE_STEP = 0.04
"""Between two poses of a straight line of the hand, m."""
CHECK_STEP = 0.1
"""The most that a joint turns between two looks for collisions, rad."""
SPEED = 0.95
"""Of the fastest joint along a path, as a share of its greatest velocity."""
SMOOTHING = 9
"""Steps over which a reference is averaged: the wrist takes eight to reach its velocity."""


class Pose(NamedTuple):
    """Of the hand or of the object."""

    position: Array
    """(3,), m."""
    rotation: Array
    """(3, 3), its axes as columns."""

    def of(self, other: Pose) -> Pose:
        """The pose in the world of what has the pose `other` in this one's frame."""
        return Pose(self.position + self.rotation @ other.position, self.rotation @ other.rotation)

    def relative(self, other: Pose) -> Pose:
        """The pose in this one's frame of what has the pose `other` in the world."""
        return Pose(
            self.rotation.T @ (other.position - self.position), self.rotation.T @ other.rotation
        )

    def shifted(self, offset: Array) -> Pose:
        """The pose moved by (3,), m, of the world's axes."""
        return Pose(self.position + offset, self.rotation)

    def twist_to(self, other: Pose) -> Array:
        """What leads to another pose: (6,), translation, m, and rotation vector, rad."""
        quaternion, rotation = np.zeros(4), np.zeros(3)
        mujoco.mju_mat2Quat(quaternion, (other.rotation @ self.rotation.T).ravel())
        mujoco.mju_quat2Vel(rotation, quaternion, 1.0)
        return np.concatenate([other.position - self.position, rotation])


class Kinematics:
    """Where a task's arm can go; the simulation itself is only read.

    Args:
        task: whose arm it is.
        physics: its simulation.

    Attributes:
        max_velocity: of the arm's joints, (6,), rad/s.
    """

    def __init__(self, task: JacoTask, physics: mjcf.Physics) -> None:
        model: Any = copy.copy(physics.model.ptr)
        model.geom_margin[:] = CLEARANCE
        model.geom_margin[model.geom_bodyid == 0] = HELD_CLEARANCE
        self._model, self._data = model, mujoco.MjData(model)
        joints = physics.bind(task.arm.joints).element_id
        fingers = physics.bind(task.hand.joints).element_id
        self._qpos, self._dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._finger_qpos = model.jnt_qposadr[fingers]
        self._prop_qpos = slice(model.nq - 7, None)  # its free joint is the last
        self._resting: Array = model.qpos0[self._prop_qpos].copy()  # the object's, see `load`
        self._site = int(physics.bind(task.hand.tool_center_point).element_id)
        self._turns_freely = ~model.jnt_limited[joints].astype(bool)
        unlimited = [[-np.inf], [np.inf]]
        self._low, self._high = np.where(self._turns_freely, unlimited, model.jnt_range[joints].T)
        self.max_velocity: Array = model.actuator_ctrlrange[: len(joints), 1].copy()
        self._is_floor = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._is_scene = (model.geom_bodyid == 0) & ~self._is_floor
        self._is_robot, self._is_prop = np.zeros((2, model.ngeom), dtype=bool)
        self._is_robot[physics.bind(task.arm.mjcf_model.find_all("geom")).element_id] = True
        self._is_prop[physics.bind(task.prop.mjcf_model.find_all("geom")).element_id] = True

    def load(self, physics: mjcf.Physics, fingers: Array) -> None:
        """See the world as it is, but for the fingers' angles, (3,), rad."""
        self._data.qpos[:] = physics.data.qpos
        self.bend(fingers)
        self._resting = self._data.qpos[self._prop_qpos].copy()

    def bend(self, fingers: Array) -> None:
        """See the fingers at other angles, (3,), rad."""
        self._data.qpos[self._finger_qpos] = fingers

    def pose(self, q: Array) -> Pose:
        """Of the hand."""
        self._data.qpos[self._qpos] = q
        mujoco.mj_kinematics(self._model, self._data)
        rotation = self._data.site_xmat[self._site].reshape(3, 3)
        return Pose(self._data.site_xpos[self._site].copy(), rotation.copy())

    def turn(self, q: Array, twist: Array) -> Array:
        """How the joints turn to move the hand a little, by damped least squares.

        Args:
            q: where they are.
            twist: of the hand, (6,), m and rad; or a velocity, m/s and rad/s.

        Returns:
            (6,), rad; or rad/s.
        """
        self.pose(q)
        return self._turn(twist * (1.0, 1.0, 1.0, LEVER, LEVER, LEVER))

    def _turn(self, twist: Array) -> Array:
        """The same from where the copy is, with orientation times `LEVER`."""
        mujoco.mj_comPos(self._model, self._data)
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site)
        jacobian = jacobian[:, self._dofs]
        jacobian[3:] *= LEVER
        square = jacobian @ jacobian.T + DAMPING**2 * np.eye(6)
        result: Array = jacobian.T @ np.linalg.solve(square, twist)
        return result

    def solve(self, q: Array, pose: Pose) -> Array | None:
        """The q for a pose of the hand, near the given one; None where it is out of reach."""
        start = q
        for _ in range(ITERATIONS):
            error = self.pose(q).twist_to(pose)
            error[3:] *= LEVER
            if error @ error < TOLERANCE**2:
                nearest = start + np.mod(q - start + np.pi, 2 * np.pi) - np.pi
                return np.where(self._turns_freely, nearest, q)
            change = self._turn(error)
            change *= min(1.0, MAX_TURN / np.abs(change).max())
            q = np.clip(q + change, self._low, self._high)
        return None

    def within_limits(self, q: Array) -> Array:
        """Return joint angles (..., 6), rad, brought within the joints' limits."""
        limited: Array = np.clip(q, self._low, self._high)
        return limited

    def line(self, q: Array, offset: Array, held: Pose | None = None) -> Path:
        """Move the hand straight by (3,), m, without turning it, as far as it can and is free.

        Args:
            q: where the arm is.
            offset: by which the hand is to move.
            held: see `is_free`.

        Returns:
            From `q` on, a q for every `LINE_STEP`.
        """
        start, path = self.pose(q), [q]
        length = float(np.linalg.norm(offset))
        for moved in np.arange(LINE_STEP, length + 1e-6, LINE_STEP):
            found = self.solve(path[-1], start.shifted(offset * moved / length))
            if found is None or not self.is_free([path[-1], found], held):
                break
            path.append(found)
        return path

    def is_free(self, path: Path, held: Pose | None = None, *, lifted: bool = False) -> bool:
        """Return whether the arm touches nothing along a path, its start excepted.

        Args:
            path: at least one q; a single q is checked itself.
            held: pose of a held object in the hand's frame: it moves with the hand and may touch
                it. None: the object stays where it is.
            lifted: the held object must also keep its distance from the floor.
        """
        for a, b in zip(path, path[1:] or path, strict=False):
            count = max(int(np.ceil(np.abs(b - a).max() / CHECK_STEP)), 1)
            for i in range(1, count + 1):
                if self._touches(a + (b - a) * i / count, held, lifted):
                    return False
        return True

    def _touches(self, q: Array, held: Pose | None, lifted: bool) -> bool:
        prop = self._data.qpos[self._prop_qpos]
        prop[:] = self._resting
        hand = self.pose(q)
        if held is not None:
            prop[:3], rotation = hand.of(held)
            mujoco.mju_mat2Quat(prop[3:], rotation.ravel())
            mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        contact = self._data.contact
        pairs = contact.geom  # (contacts, 2)
        robot, moved = self._is_robot[pairs].any(axis=1), self._is_prop[pairs].any(axis=1)
        clearance = np.full(len(pairs), CLEARANCE)
        scene, floor = (fixed[pairs].any(axis=1) for fixed in (self._is_scene, self._is_floor))
        clearance[scene] = np.where(moved, HELD_CLEARANCE, SCENE_CLEARANCE)[scene]
        on_floor = SCENE_CLEARANCE if lifted else -SUNK
        clearance[floor] = np.where(moved, on_floor, FLOOR_CLEARANCE)[floor]
        close = contact.dist < clearance
        return bool((close & (robot if held is None else robot != moved)).any())

    def seconds(self, path: Path) -> float:
        """How long a path takes at full speed."""
        return float(self.durations(np.diff(np.array(path), axis=0)).sum())

    def durations(self, turns: Array) -> Array:
        """How long turns of the joints take at full speed, s: (..., 6), rad, to (...)."""
        durations: Array = (np.abs(turns) / (SPEED * self.max_velocity)).max(axis=-1)
        return durations

    def timed(self, path: Path) -> Array:
        """Where the joints should be after each step along a path, (steps, 6), corners rounded."""
        times = np.concatenate([[0.0], np.cumsum(self.durations(np.diff(path, axis=0)))])
        at = np.arange(0.0, times[-1] + CONTROL_TIMESTEP, CONTROL_TIMESTEP)
        joints = [np.interp(at, times, angles) for angles in np.array(path).T]
        kernel = np.ones(SMOOTHING) / SMOOTHING
        padded = [np.pad(angles, SMOOTHING - 1, mode="edge") for angles in joints]
        return np.stack([np.convolve(angles, kernel, mode="valid") for angles in padded], axis=1)
