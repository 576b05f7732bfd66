"""Scene of all tasks: a robot arm with a hand above a floor, one free object, and cameras.

It uses dm_control's entities and the constants of its `manipulation` package. Lengths are in
metres, times in seconds, angles in radians. The origin is on the floor under the centre of the
workspace, z points up, and the front camera looks along +y at the arm, which stands behind the
origin.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer import initializers
from dm_control.composer.variation import distributions
from dm_control.manipulation.shared import arenas, cameras, workspaces
from numpy.typing import NDArray

from merl.core.choices import StateSet
from merl.tasks.robots import Float32, Position, Robot, jaco, sensor_slice

CONTROL_TIMESTEP = 0.04
"""Time between two actions, s (dm_control `manipulation.shared.constants`)."""
EPISODE_STEPS = 250
"""Actions per episode: 10 s (dm_control `manipulation`)."""
CAMERA = cameras.FRONT_CLOSE
"""The fixed camera in front of the arm: its name, position (m) and axes (dm_control)."""

_POSE_AND_VELOCITY = ("position", "orientation", "linear_velocity", "angular_velocity")


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


class ArmTask(composer.Task):  # type: ignore[misc]
    """A task with an arm, a hand and one free object; subclasses define the reward.

    In every episode the hand starts at a random position in `HAND_SPAWN`, points down, and has its
    fingers closed by a random amount. The object starts at a random position in `OBJECT_SPAWN`.

    Args:
        prop: the object.
        prop_height: height of the object's origin above its lower face, m.
        target: target position of the object, m; None if the object itself is the target.
        robot: makes the arm with its hand.

    Attributes:
        robot: the arm with its hand.
        prop: the object.
        target: target position of the object, (3,), m, or None.
        term_names: names of the reward's terms.
        success_distance: the task is solved if `distance` is at most this, m.
    """

    term_names: tuple[str, ...]
    success_distance: float

    def __init__(
        self,
        prop: composer.Entity,
        prop_height: float = 0.0,
        target: Position | None = None,
        robot: Callable[[], Robot] = jaco,
    ) -> None:
        self.target = None if target is None else np.array(target)
        self._arena = arenas.Standard()
        self.robot = robot()
        self._arena.attach_offset(self.robot.arm, offset=self.robot.position)
        self._arena.mjcf_model.worldbody.add("camera", **CAMERA._asdict())
        self.prop = prop
        self._prop_frame = self._arena.add_free_entity(prop)
        self.control_timestep = CONTROL_TIMESTEP
        above_floor = np.array([0.0, 0.0, prop_height])
        self._place_prop = initializers.PropPlacer(
            props=[prop],
            position=distributions.Uniform(*(np.array(OBJECT_SPAWN) + above_floor)),
            quaternion=workspaces.uniform_z_rotation,
            settle_physics=True,
        )

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
        self.robot.after_compile(physics)
        self._prop_body = int(physics.bind(self._prop_frame).element_id)
        sensors = [self.prop.mjcf_model.find("sensor", name) for name in _POSE_AND_VELOCITY]
        self._prop_sensors = sensor_slice(physics, sensors)

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        """Draw the start of fingers, hand and object, in dm_control's order."""
        self.robot.hand.set_grasp(physics, close_factors=random_state.uniform())
        self.robot.place_hand(physics, random_state, *HAND_SPAWN)
        self._place_prop(physics, random_state)

    def prop_position(self, physics: mjcf.Physics) -> NDArray[np.float64]:
        """Return the origin of the object's frame, (3,), m."""
        return np.array(physics.data.xpos[self._prop_body])

    def prop_rotation(self, physics: mjcf.Physics) -> NDArray[np.float64]:
        """Return the axes of the object's frame as columns, (3, 3)."""
        return np.array(physics.data.xmat[self._prop_body]).reshape(3, 3)

    def hand_distance(self, physics: mjcf.Physics) -> float:
        """Return the distance from the tool centre point to the object, m."""
        offset = self.robot.tool_center_point(physics) - self.prop_position(physics)
        return float(np.linalg.norm(offset))

    def goal_distance(self, physics: mjcf.Physics) -> float:
        """Return the distance from the object to its target, m; the task must have a target."""
        assert self.target is not None
        return float(np.linalg.norm(self.prop_position(physics) - self.target))

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
        parts = [self.robot.proprio(physics, "full"), physics.data.sensordata[self._prop_sensors]]
        if self.target is not None:
            parts.append(self.target)
        if which == "relative":
            prop = self.prop_position(physics)
            parts.append(prop - self.robot.tool_center_point(physics))
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
