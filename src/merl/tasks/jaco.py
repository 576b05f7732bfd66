"""Scene of all tasks: a Jaco arm with a three-fingered hand above a floor, and a camera.

It uses dm_control's entities and the constants of its `manipulation` package. Lengths are in
metres, times in seconds, angles in radians. The origin is on the floor under the centre of the
workspace, z points up, and the camera looks along +y at the arm, which stands behind the origin.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer import initializers
from dm_control.composer.variation import distributions
from dm_control.entities.manipulators import kinova
from dm_control.manipulation.shared import arenas, cameras, workspaces
from numpy.typing import NDArray

from merl.core.choices import ProprioSet, StateSet
from merl.tasks.simulator import quiet_inverse_kinematics

CONTROL_TIMESTEP = 0.04
"""Time between two actions, s (dm_control `manipulation.shared.constants`)."""
EPISODE_STEPS = 250
"""Actions per episode: 10 s (dm_control `manipulation`)."""
ARM_OFFSET = (0.0, 0.4, 0.0)
"""Position of the base of the arm, m (dm_control `manipulation.shared.robots`)."""
CAMERA = cameras.FRONT_CLOSE
"""The fixed camera in front of the arm: its name, position (m) and axes (dm_control)."""

TOUCH_SIZE = 7
"""Number of touch sensors: the palm, and for each finger its first link and its tip."""
PROPRIO_SIZES: dict[ProprioSet, int] = {"paper": 24, "full": 42}
"""Number of values in each set of proprioception; see `JacoTask.proprio`."""
_POSE_AND_VELOCITY = ("position", "orientation", "linear_velocity", "angular_velocity")

Float32 = NDArray[np.float32]
Position = tuple[float, float, float]
"""x, y, z, m."""


class Box(NamedTuple):
    """An axis-aligned box from which a position is drawn uniformly."""

    lower: Position
    """Minimum x, y, z, m."""
    upper: Position
    """Maximum x, y, z, m."""


HAND_SPAWN = Box((-0.1, -0.1, 0.2), (0.1, 0.1, 0.4))
"""Start region of the tool centre point (dm_control `manipulation.reach`)."""
OBJECT_SPAWN = Box((-0.1, -0.1, 0.001), (0.1, 0.1, 0.001))
"""Start region of the object's lower face, 1 mm above the floor; the object then falls and settles
(dm_control `manipulation.reach`, where the origin of an object is on its lower face)."""


class JacoTask(composer.Task):  # type: ignore[misc]
    """A task with an arm, a hand and one free object; subclasses define the reward.

    In every episode the hand starts at a random position in `HAND_SPAWN`, points down, and has its
    fingers closed by a random amount. The object starts at a random position in `OBJECT_SPAWN`.

    Args:
        prop: the object.
        prop_height: height of the object's origin above its lower face, m.
        target: target position of the object, m; None if the object itself is the target.

    Attributes:
        arm: the Jaco arm, six velocity-controlled joints.
        hand: the Jaco hand, three velocity-controlled fingers.
        prop: the object.
        target: target position of the object, (3,), m, or None.
        term_names: names of the reward's terms.
        success_distance: the task is solved if `distance` is at most this, m.
    """

    term_names: tuple[str, ...]
    success_distance: float

    def __init__(
        self, prop: composer.Entity, prop_height: float = 0.0, target: Position | None = None
    ) -> None:
        self.target = None if target is None else np.array(target)
        self._touch_sensors: list[Any] = []
        self._arena = arenas.Standard()
        self.arm = kinova.JacoArm()
        self.hand = kinova.JacoHand(use_pinch_site_as_tcp=True)
        self.arm.attach(self.hand)
        self._arena.attach_offset(self.arm, offset=ARM_OFFSET)
        self._arena.mjcf_model.worldbody.add("camera", **CAMERA._asdict())
        self.prop = prop
        self._prop_frame = self._arena.add_free_entity(prop)
        self.control_timestep = CONTROL_TIMESTEP
        self._place_hand = initializers.ToolCenterPointInitializer(
            self.hand,
            self.arm,
            position=distributions.Uniform(*HAND_SPAWN),
            quaternion=workspaces.DOWN_QUATERNION,
        )
        above_floor = np.array([0.0, 0.0, prop_height])
        self._place_prop = initializers.PropPlacer(
            props=[prop],
            position=distributions.Uniform(*(np.array(OBJECT_SPAWN) + above_floor)),
            quaternion=workspaces.uniform_z_rotation,
            settle_physics=True,
        )

    def add_touch_sensors(self) -> None:
        """Add MuJoCo's touch sensors to the hand, for `touch`; call this before `compile`."""
        model = self.hand.mjcf_model
        names = ["hand", *(f"b_finger{part}_{n}" for n in (1, 2, 3) for part in ("", "_tip"))]
        for name in names:
            # A sensor adds the forces on its site's body within the site, an invisible sphere.
            site = model.find("body", name).add("site", size=[0.2], group=4, rgba=[0, 0, 0, 0])
            self._touch_sensors.append(model.sensor.add("touch", site=site, name=f"touch_{name}"))

    @property
    def root_entity(self) -> composer.Entity:
        """The arena, to which all other entities are attached."""
        return self._arena

    def compile(self) -> mjcf.Physics:
        """Return the compiled simulation, which serves all episodes (see `start_episode`)."""
        random_state = np.random.RandomState(0)
        self._vary_model(random_state)
        physics = mjcf.Physics.from_mjcf_model(self._arena.mjcf_model)
        self.after_compile(physics, random_state)
        return physics

    def start_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Start an episode as `composer.Environment` does, but without recompiling the model.

        The model does not vary between episodes: the brick draws the size of its studs from a range
        of zero width. This method still makes that draw, so that the starts equal dm_control's.
        """
        self._vary_model(random_state)
        with physics.reset_context():
            self.initialize_episode(physics, random_state)

    def _vary_model(self, random_state: np.random.RandomState) -> None:
        for entity in self._arena.iter_entities():
            entity.initialize_episode_mjcf(random_state)

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Store the indices of the values in MuJoCo's arrays that every step reads."""
        del random_state
        arm, fingers = physics.bind(self.arm.joints), physics.bind(self.hand.joints)
        self._arm_qpos, self._arm_qvel = _addresses(physics, arm.element_id)
        self._finger_qpos, self._finger_qvel = _addresses(physics, fingers.element_id)
        self._arm_axes = np.array(arm.axis)
        self._torques = _sensor_slice(physics, self.arm.joint_torque_sensors)
        self._tcp = int(physics.bind(self.hand.tool_center_point).element_id)
        self._wrist = int(physics.bind(self.hand.hand_geom[0]).element_id)
        self._prop_body = int(physics.bind(self._prop_frame).element_id)
        sensors = [self.prop.mjcf_model.find("sensor", name) for name in _POSE_AND_VELOCITY]
        self._prop_sensors = _sensor_slice(physics, sensors)
        self._touch = _sensor_slice(physics, self._touch_sensors) if self._touch_sensors else None

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        """Draw the start of fingers, hand and object, in dm_control's order."""
        self.hand.set_grasp(physics, close_factors=random_state.uniform())
        with quiet_inverse_kinematics():
            self._place_hand(physics, random_state)
        self._place_prop(physics, random_state)

    def tool_center_point(self, physics: mjcf.Physics) -> NDArray[np.float64]:
        """Return the point where the fingers meet, (3,), m."""
        return np.array(physics.data.site_xpos[self._tcp])

    def prop_position(self, physics: mjcf.Physics) -> NDArray[np.float64]:
        """Return the origin of the object's frame, (3,), m."""
        return np.array(physics.data.xpos[self._prop_body])

    def prop_rotation(self, physics: mjcf.Physics) -> NDArray[np.float64]:
        """Return the axes of the object's frame as columns, (3, 3)."""
        return np.array(physics.data.xmat[self._prop_body]).reshape(3, 3)

    def hand_distance(self, physics: mjcf.Physics) -> float:
        """Return the distance from the tool centre point to the object, m."""
        offset = self.tool_center_point(physics) - self.prop_position(physics)
        return float(np.linalg.norm(offset))

    def goal_distance(self, physics: mjcf.Physics) -> float:
        """Return the distance from the object to its target, m; the task must have a target."""
        assert self.target is not None
        return float(np.linalg.norm(self.prop_position(physics) - self.target))

    def tilt_cosine(self, physics: mjcf.Physics) -> float:
        """Return the cosine between the hand's axis and straight down, in [-1, 1].

        The hand's axis leads from the centre of the hand's largest part to the tool centre point.
        The cosine is 0.9927 at the start of an episode.
        """
        axis = self.tool_center_point(physics) - physics.data.geom_xpos[self._wrist]
        return float(-axis[2] / np.linalg.norm(axis))

    def proprio(self, physics: mjcf.Physics, which: ProprioSet = "paper") -> Float32:
        """Return the proprioception.

        Args:
            physics: the simulation.
            which: `paper`: sine and cosine of each arm joint's angle (12), the arm's joint
                velocities in rad/s (6), the fingers' joint angles in rad (3) and velocities in
                rad/s (3). `full`: also the arm's joint torques (6), sign(x) log(1 + abs(x)) of
                N m, and the pinch site's position in m (3) and rotation matrix (9).

        Returns:
            float32 (24,) or (42,), with the values of dm_control's observables.
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
            float32 (7,): log(1 + F) of the normal force F in N on the palm, and for each of the
            three fingers on its first link and its tip. All zeros without `add_touch_sensors`.
        """
        if self._touch is None:
            return np.zeros(TOUCH_SIZE, np.float32)
        forces: Float32 = np.log1p(physics.data.sensordata[self._touch]).astype(np.float32)
        return forces

    def state(self, physics: mjcf.Physics, which: StateSet = "absolute") -> Float32:
        """Return the full state of the task, for agents without a camera.

        Args:
            physics: the simulation.
            which: `absolute`: `full` proprioception (42), the object's position in m (3),
                orientation as a unit quaternion (4), linear and angular velocity in m/s and rad/s
                (6), and the target's position in m (3) if there is a target. `relative`: also the
                vectors from the tool centre point to the object (3) and, if there is a target, from
                the object to the target (3), in m.

        Returns:
            float32, (55,) and (58,) without a target, (58,) and (64,) with one.
        """
        parts = [self.proprio(physics, "full"), physics.data.sensordata[self._prop_sensors]]
        if self.target is not None:
            parts.append(self.target)
        if which == "relative":
            prop = self.prop_position(physics)
            parts.append(prop - self.tool_center_point(physics))
            if self.target is not None:
                parts.append(self.target - prop)
        return np.concatenate(parts, dtype=np.float32, casting="same_kind")

    @abstractmethod
    def distance(self, physics: mjcf.Physics) -> float:
        """Return the distance that decides success, m."""

    def success(self, physics: mjcf.Physics) -> bool:
        """Return whether the task is solved in the current state."""
        return self.distance(physics) <= self.success_distance

    @abstractmethod
    def reward_terms(self, physics: mjcf.Physics) -> dict[str, float]:
        """Return the terms of the reward by name; their sum is the reward, in [0, 1]."""

    def get_reward(self, physics: mjcf.Physics) -> float:
        """Return the sum of `reward_terms`, in [0, 1]."""
        return sum(self.reward_terms(physics).values())


def _addresses(physics: mjcf.Physics, joints: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the indices of hinge joints in qpos (positions) and in qvel (velocities)."""
    model = physics.model
    return model.jnt_qposadr[joints].copy(), model.jnt_dofadr[joints].copy()


def _sensor_slice(physics: mjcf.Physics, sensors: list[Any]) -> NDArray[Any]:
    """Return the indices of the sensors' readings in sensordata, concatenated."""
    ids = physics.bind(sensors).element_id
    starts, sizes = physics.model.sensor_adr[ids], physics.model.sensor_dim[ids]
    return np.concatenate([np.arange(a, a + n) for a, n in zip(starts, sizes, strict=True)])
