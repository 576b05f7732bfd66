"""Another arm in merl's own tasks: a Franka Panda reaches a brick on the floor.

    pip install --no-deps gymnasium-robotics
    merl train franka_reach:from_state --preset state --updates-per-step 0.25
    merl train franka_reach:make_env --preset laptop --updates-per-step 0.25

The package contains a model of the arm; its code is not used. Copy this file for an arm of your
own: docs/howto/another_arm.md says what to change, and shows results. Lengths are in metres, angles
in radians.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from merl.core import MerlError
from merl.envs.arm_env import ArmEnv
from merl.envs.config import EnvConfig, ObservationKey
from merl.tasks import ReachDuplo
from merl.tasks.robots import Robot

# isort: split
from dm_control import mjcf
from dm_control.entities.manipulators import base

MODEL: Path | None = None
"""An MJCF file, such as `mujoco_menagerie/franka_emika_panda/panda.xml` in your clone; None for the
model in gymnasium-robotics."""
TCP = 0.245
"""Distance from the last joint to the point where the fingers meet, m; 0.21 for Menagerie's model,
whose fingers are shorter."""
TURN = (0.9238795, 0.0, 0.0, 0.3826834)
"""Quaternion from the axes of the last link to those of the hand: z away from the arm, x along the
motion of the fingers."""
POSITION = (0.0, 0.5, 0.0)
"""Position of the base, m. Hand and brick start within 10 cm of the origin, in x and y."""
FACING = (0.7071068, 0.0, 0.0, -0.7071068)
"""Quaternion of the base: the arm reaches forward along -y, to the camera."""
FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Maximum torques of the joints, N m (Franka's data sheet)."""
VELOCITY = 0.7
"""Maximum velocity of a joint, rad/s: a third of the data sheet's, and similar to the Jaco's."""
GAIN = 40.0
"""Torque of a joint for each rad/s below its target velocity, N m s."""
FINGER_FORCE, FINGER_VELOCITY, FINGER_GAIN = 30.0, 0.05, 200.0
"""The same for the fingers, N, m/s and N s/m."""


class Arm(base.RobotArm):  # type: ignore[misc]
    """The joints of a model other than the fingers', controlled in velocity."""

    mjcf_model: mjcf.RootElement = None  # set by _build, as are these lists of elements
    joints: Any = None
    actuators: Any = None
    joint_torque_sensors: Any = None
    wrist_site = None  # not used: the hand is in the same model

    def _build(self, model: mjcf.RootElement) -> None:
        self.mjcf_model = model
        self.joints = [joint for joint in model.find_all("joint") if "finger" not in joint.name]
        self.actuators, self.joint_torque_sensors = [], []
        for joint, force in zip(self.joints, FORCES, strict=True):
            joint.damping, joint.armature = 1.0, 0.1
            self.actuators.append(_actuator(joint, GAIN, VELOCITY, force))
            site = joint.parent.add("site", size=[0.001], group=4)
            sensor = model.sensor.add("torque", site=site, name=f"{joint.name}_torque")
            self.joint_torque_sensors.append(sensor)

    def set_site_to_xpos(self, physics: mjcf.Physics, *args: Any, **kwargs: Any) -> bool:
        """Solve the inverse kinematics from the middle of the joints' ranges.

        The solver ignores the ranges; its solutions from there are mostly within them.
        """
        joints = physics.bind(self.joints)
        joints.qpos = joints.range.mean(axis=1)
        return bool(super().set_site_to_xpos(physics, *args, **kwargs))


class Hand(base.RobotHand):  # type: ignore[misc]
    """Two fingers in the arm's model, moved by one actuator."""

    mjcf_model: mjcf.RootElement = None  # set by _build, as are these elements
    joints: Any = None
    actuators: Any = None
    tool_center_point: mjcf.Element = None

    def _build(self, arm: Arm) -> None:
        self.mjcf_model = model = arm.mjcf_model
        self.joints = left, right = [j for j in model.find_all("joint") if "finger" in j.name]
        for joint in self.joints:
            joint.damping, joint.armature = 10.0, 0.5
        self.actuators = [_actuator(left, FINGER_GAIN, FINGER_VELOCITY, FINGER_FORCE)]
        model.equality.add("joint", joint1=right, joint2=left)
        model.contact.add("exclude", body1=left.parent, body2=right.parent)
        self.tool_center_point = arm.joints[-1].parent.add(
            "site", name="tcp", pos=(0, 0, TCP), quat=TURN, size=[0.001], group=4
        )

    def set_grasp(self, physics: mjcf.Physics, close_factors: float) -> None:
        """Place the fingers: 0 is open, 1 is closed."""
        joints = physics.bind(self.joints)
        joints.qpos = joints.range[:, 1] * (1 - close_factors)
        physics.after_reset()


def franka() -> Robot:
    """Return the arm, which stands behind the brick and faces the camera.

    Raises:
        MerlError: its model is missing.
    """
    model = load_model()
    model.worldbody.body[0].quat = FACING
    for body in model.find_all("body"):
        body.gravcomp = 1  # as the real arm's controller does
    arm = Arm(model)
    hand = Hand(arm)
    palm = hand.joints[0].parent.parent
    touching = [palm.name, *(joint.parent.name for joint in hand.joints)]
    return Robot(arm, hand, POSITION, palm.geom[-1], touching)


def load_model() -> mjcf.RootElement:
    """Return the model without actuators.

    Raises:
        MerlError: it is missing.
    """
    if MODEL is None:
        return _packaged_model()
    if not MODEL.is_file():
        raise MerlError(f"the arm's model {MODEL} does not exist: correct MODEL in {__file__}")
    model = mjcf.from_path(str(MODEL))
    for part in (model.actuator, model.tendon, model.equality, model.keyframe, model.option):
        part.remove()
    return model


def _packaged_model() -> mjcf.RootElement:
    package = find_spec("gymnasium_robotics")  # without importing it
    if package is None or package.origin is None:
        raise MerlError(
            "the Franka's model is missing: pip install --no-deps gymnasium-robotics, or give an "
            f"MJCF file as MODEL in {__file__}"
        )
    folder = Path(package.origin).parent / "envs/assets/kitchen_franka"
    assets, chain = (
        ElementTree.parse(folder / "franka_assets" / name).getroot()
        for name in ("assets.xml", "chain.xml")
    )
    root = ElementTree.Element("mujoco", model="panda")
    root.extend(part for part in assets if part.tag not in ("option", "size"))
    ElementTree.SubElement(root, "worldbody").extend(chain)
    return mjcf.from_xml_string(ElementTree.tostring(root), model_dir=str(folder))


def _actuator(joint: mjcf.Element, gain: float, velocity: float, force: float) -> mjcf.Element:
    """Add an actuator that controls a joint's velocity, and return it."""
    return joint.root.actuator.add(
        "velocity",
        joint=joint,
        name=joint.name,
        kv=gain,
        ctrllimited=True,
        ctrlrange=(-velocity, velocity),
        forcelimited=True,
        forcerange=(-force, force),
    )


def make_env(
    render_mode: str | None = None, observations: tuple[ObservationKey, ...] = ("image", "proprio")
) -> ArmEnv:
    """Make the environment with camera and joints, and images as in preset `laptop`."""
    config = EnvConfig(image_size=24, samples=3, observations=observations, state="relative")
    return ArmEnv(ReachDuplo(robot=franka), config, render_mode)


def from_state(render_mode: str | None = None) -> ArmEnv:
    """Make the environment with the simulator's state in place of camera and joints."""
    return make_env(render_mode, ("state",))
