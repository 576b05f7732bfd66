"""Kinematic model of the arm: inverse kinematics, collisions and timing.

The model uses a copy of the simulation. Lengths are in metres, angles in radians, times in seconds.
`q` stands for the angles of the six arm joints, (6,). The pose of the hand is the pose of its pinch
site: z is the direction in which the hand points, x the axis along which the fingers open.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import mujoco
import numpy as np
from dm_control import mjcf
from numpy.typing import NDArray

from merl.tasks.arm_task import CONTROL_TIMESTEP, ArmTask

Array = NDArray[np.float64]
Path = list[Array]
"""A sequence of joint angles `q`, connected by straight lines in joint space."""

CLEARANCE = 0.004
"""Geoms closer than this count as touching, m: the arm deviates a little from its plan."""
SCENE_CLEARANCE = 0.006
"""Minimum distance between the robot and fixed geoms other than the floor, m."""
HELD_CLEARANCE = 0.015
"""Minimum distance between a held object and fixed geoms other than the floor, m: the object moves
in the grip, and lags behind the plan together with the hand."""
SUNK = 5e-4
"""A resting object sinks into the floor by less than this, m."""
FLOOR_CLEARANCE = 1e-3
"""Minimum distance between the robot and the floor, m: a finger that scrapes the floor does not
close."""
DAMPING = 0.02
"""Damping of the least squares, m; it bounds the step near singular poses."""
LEVER = 0.15
"""Weight of one radian of orientation error, as metres of position error."""
MAX_TURN = 0.5
"""Maximum turn of a joint in one iteration, rad."""
ITERATIONS = 25
"""Maximum number of iterations; a pose that is not reached by then is out of reach."""
TOLERANCE = 1e-3
"""Maximum error of a reached pose: position in m, orientation in rad times `LEVER`."""
LINE_STEP = 0.04
"""Distance between two poses on a straight line of the hand, m."""
CHECK_STEP = 0.1
"""Maximum turn of a joint between two collision checks, rad."""
SPEED = 0.95
"""Velocity of the fastest joint along a path, as a fraction of its maximum velocity."""
SMOOTHING = 9
"""Steps over which a reference is averaged: the wrist needs eight to reach its velocity."""


class Pose(NamedTuple):
    """Pose of the hand or of the object."""

    position: Array
    """(3,), m."""
    rotation: Array
    """(3, 3), its axes as columns."""

    def of(self, other: Pose) -> Pose:
        """Return the world pose of a body whose pose in this frame is `other`."""
        return Pose(self.position + self.rotation @ other.position, self.rotation @ other.rotation)

    def relative(self, other: Pose) -> Pose:
        """Return the pose in this frame of a body whose world pose is `other`."""
        return Pose(
            self.rotation.T @ (other.position - self.position), self.rotation.T @ other.rotation
        )

    def shifted(self, offset: Array) -> Pose:
        """Return the pose moved by `offset`, (3,), m, along the world's axes."""
        return Pose(self.position + offset, self.rotation)

    def twist_to(self, other: Pose) -> Array:
        """Return the motion to another pose: (6,), translation in m, rotation vector in rad."""
        quaternion, rotation = np.zeros(4), np.zeros(3)
        mujoco.mju_mat2Quat(quaternion, (other.rotation @ self.rotation.T).ravel())
        mujoco.mju_quat2Vel(rotation, quaternion, 1.0)
        return np.concatenate([other.position - self.position, rotation])


class Kinematics:
    """Kinematic model of a task's arm; it only reads the simulation.

    Args:
        task: the task that has the arm.
        physics: the simulation of the task.

    Attributes:
        max_velocity: maximum velocities of the arm's joints, (6,), rad/s.
    """

    def __init__(self, task: ArmTask, physics: mjcf.Physics) -> None:
        model: Any = copy.copy(physics.model.ptr)
        model.geom_margin[:] = CLEARANCE
        model.geom_margin[model.geom_bodyid == 0] = HELD_CLEARANCE
        self._model, self._data = model, mujoco.MjData(model)
        joints = physics.bind(task.robot.arm.joints).element_id
        fingers = physics.bind(task.robot.hand.joints).element_id
        self._qpos, self._dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._finger_qpos = model.jnt_qposadr[fingers]
        self._prop_qpos = slice(model.nq - 7, None)  # the object's free joint is the last
        self._resting: Array = model.qpos0[self._prop_qpos].copy()  # pose of the object, see `load`
        self._site = int(physics.bind(task.robot.hand.tool_center_point).element_id)
        self._turns_freely = ~model.jnt_limited[joints].astype(bool)
        unlimited = [[-np.inf], [np.inf]]
        self._low, self._high = np.where(self._turns_freely, unlimited, model.jnt_range[joints].T)
        self.max_velocity: Array = model.actuator_ctrlrange[: len(joints), 1].copy()
        self._is_floor = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._is_scene = (model.geom_bodyid == 0) & ~self._is_floor
        self._is_robot, self._is_prop = np.zeros((2, model.ngeom), dtype=bool)
        self._is_robot[physics.bind(task.robot.arm.mjcf_model.find_all("geom")).element_id] = True
        self._is_prop[physics.bind(task.prop.mjcf_model.find_all("geom")).element_id] = True

    def load(self, physics: mjcf.Physics, fingers: Array) -> None:
        """Copy the state of the simulation, but with other finger angles, (3,), rad."""
        self._data.qpos[:] = physics.data.qpos
        self.bend(fingers)
        self._resting = self._data.qpos[self._prop_qpos].copy()

    def bend(self, fingers: Array) -> None:
        """Set the angles of the fingers in the copy, (3,), rad."""
        self._data.qpos[self._finger_qpos] = fingers

    def pose(self, q: Array) -> Pose:
        """Return the pose of the hand at joint angles `q`."""
        self._data.qpos[self._qpos] = q
        mujoco.mj_kinematics(self._model, self._data)
        rotation = self._data.site_xmat[self._site].reshape(3, 3)
        return Pose(self._data.site_xpos[self._site].copy(), rotation.copy())

    def turn(self, q: Array, twist: Array) -> Array:
        """Return the turn of the joints that moves the hand a little, by damped least squares.

        Args:
            q: current angles of the joints.
            twist: motion of the hand, (6,), in m and rad; or its velocity, in m/s and rad/s.

        Returns:
            The turn of the joints, (6,), in rad; or their velocity, in rad/s.
        """
        self.pose(q)
        return self._turn(twist * (1.0, 1.0, 1.0, LEVER, LEVER, LEVER))

    def jacobian(self, q: Array) -> Array:
        """Return the Jacobian of the hand's position and rotation at joint angles `q`, (6, 6)."""
        self.pose(q)
        return self._jacobian()

    def _jacobian(self) -> Array:
        """Return the Jacobian at the pose of the copy."""
        mujoco.mj_comPos(self._model, self._data)
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site)
        return jacobian[:, self._dofs]

    def _turn(self, twist: Array) -> Array:
        """Turn from the pose of the copy; the orientation in `twist` is already times `LEVER`."""
        jacobian = self._jacobian()
        jacobian[3:] *= LEVER
        square = jacobian @ jacobian.T + DAMPING**2 * np.eye(6)
        result: Array = jacobian.T @ np.linalg.solve(square, twist)
        return result

    def solve(self, q: Array, pose: Pose) -> Array | None:
        """Return the q near the given one for a pose of the hand; None if it is out of reach."""
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
        """Move the hand along a straight line without turning it, until the way is blocked.

        Args:
            q: current angles of the joints.
            offset: motion of the hand, (3,), m.
            held: see `is_free`.

        Returns:
            A path that starts at `q`, with one q for every `LINE_STEP` that is reachable and free.
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
        """Return whether the arm touches nothing along a path, except at its start.

        Args:
            path: at least one q; a single q is itself checked.
            held: pose of a held object in the hand's frame; the object moves with the hand and may
                touch it. None: the object stays in its place.
            lifted: a held object must also keep its distance from the floor.
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
        """Return the duration of a path at full speed, s."""
        return float(self.durations(np.diff(np.array(path), axis=0)).sum())

    def durations(self, turns: Array) -> Array:
        """Return the durations (...), s, of turns of the joints (..., 6), rad, at full speed."""
        durations: Array = (np.abs(turns) / (SPEED * self.max_velocity)).max(axis=-1)
        return durations

    def timed(self, path: Path) -> Array:
        """Return the target angles after each step of a path, (steps, 6), rad, corners rounded."""
        times = np.concatenate([[0.0], np.cumsum(self.durations(np.diff(path, axis=0)))])
        at = np.arange(0.0, times[-1] + CONTROL_TIMESTEP, CONTROL_TIMESTEP)
        joints = [np.interp(at, times, angles) for angles in np.array(path).T]
        kernel = np.ones(SMOOTHING) / SMOOTHING
        padded = [np.pad(angles, SMOOTHING - 1, mode="edge") for angles in joints]
        return np.stack([np.convolve(angles, kernel, mode="valid") for angles in padded], axis=1)
