"""Robots: an arm and a hand, what their joints and touch sensors measure, and a camera on the hand.

A scene (`ArmTask`) takes any `Robot`. Lengths are in metres, times in seconds, angles in radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from dm_control import mjcf
from dm_control.composer import initializers
from dm_control.composer.variation import distributions
from dm_control.entities.manipulators import base, kinova
from dm_control.manipulation.shared import workspaces
from numpy.typing import NDArray

from merl.core.choices import ProprioSet
from merl.tasks.simulator import quiet_inverse_kinematics

Float32 = NDArray[np.float32]
Position = tuple[float, float, float]
"""x, y, z, m."""

WRIST_CAMERA: Position = (0.0, -0.09, -0.16)
"""Position of the camera at the wrist, in the frame of the tool centre point, m."""
WRIST_CAMERA_TILT = 0.3
"""Angle between its line of sight and the direction in which the hand points, rad."""
WRIST_CAMERA_ANGLE = 75.0
"""Vertical field of view, degrees."""


class Robot:
    """An arm with a hand at its end, whose joints are controlled in velocity.

    Args:
        arm: the arm; a torque sensor at each joint, in the joint's frame.
        hand: the hand, attached to the arm or part of its model.
        position: position of the arm's base in the scene, m.
        palm: the largest geom of the hand. The hand's axis leads from its centre to the tool centre
            point.
        touch_bodies: names of the hand's bodies that feel touch.

    Attributes:
        arm, hand, position: the arguments.
    """

    def __init__(
        self,
        arm: base.RobotArm,
        hand: base.RobotHand,
        position: Position,
        palm: mjcf.Element,
        touch_bodies: Sequence[str],
    ) -> None:
        self.arm, self.hand, self.position = arm, hand, position
        self._palm_geom, self._touch_bodies = palm, touch_bodies
        self._touch_sensors: list[mjcf.Element] = []

    def add_touch_sensors(self) -> None:
        """Add MuJoCo's touch sensors to the hand, for `touch`; call this before `compile`."""
        model = self.hand.mjcf_model
        for name in self._touch_bodies:
            # A sensor adds the forces on its site's body within the site, an invisible sphere.
            site = model.find("body", name).add("site", size=[0.2], group=4, rgba=[0, 0, 0, 0])
            self._touch_sensors.append(model.sensor.add("touch", site=site, name=f"touch_{name}"))

    def add_wrist_camera(self) -> str:
        """Add a camera that looks along the hand and sees its fingers, and return its name.

        Call this before `compile`.
        """
        site = self.hand.tool_center_point  # it points along z, and the fingers open along x
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, np.array([1, 0, 0, 0] if site.quat is None else site.quat))
        to_body = rotation.reshape(3, 3)
        up = (0.0, np.cos(WRIST_CAMERA_TILT), -np.sin(WRIST_CAMERA_TILT))
        camera = site.parent.add(
            "camera",
            name="wrist",
            pos=site.pos + to_body @ WRIST_CAMERA,
            xyaxes=[*(to_body @ (-1.0, 0.0, 0.0)), *(to_body @ up)],
            fovy=WRIST_CAMERA_ANGLE,
        )
        return str(camera.full_identifier)

    def after_compile(self, physics: mjcf.Physics) -> None:
        """Store the indices of the values in MuJoCo's arrays that every step reads."""
        arm, fingers = physics.bind(self.arm.joints), physics.bind(self.hand.joints)
        self._arm_qpos, self._arm_qvel = _addresses(physics, arm.element_id)
        self._finger_qpos, self._finger_qvel = _addresses(physics, fingers.element_id)
        self._arm_axes = np.array(arm.axis)
        self._torques = sensor_slice(physics, self.arm.joint_torque_sensors)
        self._tcp = int(physics.bind(self.hand.tool_center_point).element_id)
        self._palm = int(physics.bind(self._palm_geom).element_id)
        self._touch = sensor_slice(physics, self._touch_sensors)

    def place_hand(
        self,
        physics: mjcf.Physics,
        random_state: np.random.RandomState,
        lower: NDArray[np.float64] | Position,
        upper: NDArray[np.float64] | Position,
    ) -> None:
        """Point the hand down, with the tool centre point at a random position in a box.

        Args:
            physics: the simulation; the arm's joints change.
            random_state: draws the position.
            lower: minimum x, y, z, m.
            upper: maximum x, y, z, m.

        Raises:
            dm_control.composer.EpisodeInitializationError: no position without collision was found.
        """
        place = initializers.ToolCenterPointInitializer(
            self.hand,
            self.arm,
            position=distributions.Uniform(lower, upper),
            quaternion=workspaces.DOWN_QUATERNION,
        )
        with quiet_inverse_kinematics():
            place(physics, random_state)

    def tool_center_point(self, physics: mjcf.Physics) -> NDArray[np.float64]:
        """Return the point where the fingers meet, (3,), m."""
        return np.array(physics.data.site_xpos[self._tcp])

    def tilt_cosine(self, physics: mjcf.Physics) -> float:
        """Return the cosine between the hand's axis and straight down, in [-1, 1].

        For the Jaco hand it is 0.9927 at the start of an episode.
        """
        axis = self.tool_center_point(physics) - physics.data.geom_xpos[self._palm]
        return float(-axis[2] / np.linalg.norm(axis))

    def proprio(self, physics: mjcf.Physics, which: ProprioSet = "paper") -> Float32:
        """Return the proprioception.

        Args:
            physics: the simulation.
            which: `paper`: sine and cosine of each arm joint's angle, the arm's joint velocities in
                rad/s, the fingers' joint angles in rad and velocities in rad/s. `full`: also the
                arm's joint torques, sign(x) log(1 + abs(x)) of N m, and the tool centre point's
                position in m (3) and rotation matrix (9).

        Returns:
            float32; for the Jaco arm (12 + 6 + 3 + 3,) = (24,) or (24 + 6 + 3 + 9,) = (42,), with
            the values of dm_control's observables.
        """
        data = physics.data
        angles = data.qpos[self._arm_qpos]
        parts = [
            np.stack([np.sin(angles), np.cos(angles)], axis=1).ravel(),
            data.qvel[self._arm_qvel],
            data.qpos[self._finger_qpos],
            data.qvel[self._finger_qvel],
        ]
        if which == "full":
            torques = data.sensordata[self._torques].reshape(-1, 3)
            along_axis = np.einsum("ij,ij->i", torques, self._arm_axes)
            parts += [
                np.sign(along_axis) * np.log1p(np.abs(along_axis)),
                data.site_xpos[self._tcp],
                data.site_xmat[self._tcp],
            ]
        return np.concatenate(parts, dtype=np.float32, casting="same_kind")

    def touch(self, physics: mjcf.Physics) -> Float32:
        """Return the contact forces on the hand.

        Returns:
            float32 (n,): log(1 + F) of the normal force F in N on each of the n touch bodies; for
            the Jaco hand (7,): the palm, and for each of the three fingers its first link and its
            tip. Empty without `add_touch_sensors`.
        """
        forces: Float32 = np.log1p(physics.data.sensordata[self._touch]).astype(np.float32)
        return forces


def jaco() -> Robot:
    """Return the Kinova Jaco arm, six joints, with its hand of three fingers.

    Its base is where dm_control has it (`manipulation.shared.robots`).
    """
    arm, hand = kinova.JacoArm(), kinova.JacoHand(use_pinch_site_as_tcp=True)
    arm.attach(hand)
    fingers = [f"b_finger{part}_{n}" for n in (1, 2, 3) for part in ("", "_tip")]
    position = (0.0, 0.4, 0.0)
    return Robot(arm, hand, position, hand.hand_geom[0], ["hand", *fingers])


def sensor_slice(physics: mjcf.Physics, sensors: Sequence[Any]) -> NDArray[np.intp]:
    """Return the indices of the sensors' readings in sensordata, concatenated."""
    ids = [int(physics.bind(sensor).element_id) for sensor in sensors]
    starts, sizes = physics.model.sensor_adr[ids], physics.model.sensor_dim[ids]
    parts = [np.arange(a, a + n) for a, n in zip(starts, sizes, strict=True)]
    return np.concatenate([np.zeros(0, np.intp), *parts])


def _addresses(physics: mjcf.Physics, joints: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the indices of hinges or slides in qpos (positions) and in qvel (velocities)."""
    model = physics.model
    return model.jnt_qposadr[joints].copy(), model.jnt_dofadr[joints].copy()
