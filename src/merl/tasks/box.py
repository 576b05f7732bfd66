"""Shared parts of the tasks with a box: the box, the occluding disc, and starts at the box."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from dm_control import composer, mjcf
from dm_control.entities import props

from merl.core.choices import HandStart, RewardForm
from merl.tasks.arm_task import ArmTask, Box
from merl.tasks.rewards import SUCCESS_DISTANCE
from merl.tasks.robots import Position, Robot, jaco

BOX_HALF_SIZE = 0.025
"""Half of the edge length, m. The centre of a box on the floor is at the same height."""
BOX_MASS = 0.1
"""Mass of the box, kg."""
DISC_CENTER = (0.0, -0.06)
"""Centre of the disc, x and y, m. It is closer to the camera than the centre of the workspace, so
that the disc hides most of the objects there from the camera (docs/explanation/tasks.md)."""
DISC_HEIGHT = (0.135, 0.150)
"""Heights of the lower and the upper face of the disc above the floor, m."""
AROUND_BOX = Box((-0.01, -0.01, 0.0), (0.01, 0.01, 0.02))
"""Start region of the tool centre point for `around`, relative to the box's centre, m."""
CLOSED_AROUND_BOX = (0.2, 0.6)
"""Minimum and maximum closed fraction of the fingers for `around`; they do not touch the box."""
ATTEMPTS = 20
"""Number of attempts to draw an `around` start in which the hand does not touch the box."""
CLOSING_VELOCITY = 1.0
"""Velocity of the fingers that close around the box before an episode, rad/s."""
CLOSING_STEPS = 20
"""Number of control steps in which the fingers close; enough for the widest start."""
ABOVE: tuple[HandStart, ...] = ("above",)
"""The start in dm_control, and the only one of a plain `ArmTask`."""
_RED = (1.0, 0.0, 0.0, 1.0)
_GREY = (0.5, 0.5, 0.5, 1.0)


class BoxTask(ArmTask):
    """A task with a red cube that can be occluded, and at which the hand can start.

    The start `above` is the start of `ArmTask`. For `around`, the hand is then moved to the box:
    to a position drawn from `AROUND_BOX`, with the fingers closed by a fraction drawn from
    `CLOSED_AROUND_BOX`, where it touches nothing. If no such position is found, which is rare, the
    hand stays above. For `holding`, the fingers then close around the box, which is on the floor.
    For `carrying`, they hold the box at a random point on the straight line from its position to
    its target, both ends included.

    Args:
        occluded: put a disc between the camera and the box.
        starts: where the hand starts; with several, each episode draws one. The disc of `occluded`
            leaves no space for the hand at the box.
        reward: form of the reward.
        robot: makes the arm with its hand.

    Attributes:
        occluded, reward: the arguments.
        place: target position of the box, m.
        place_over_disc: target position of the box if `occluded`, m.
        disc_radius: radius of the disc, m.
    """

    success_distance = SUCCESS_DISTANCE
    place: Position
    place_over_disc: Position
    disc_radius: float

    def __init__(
        self,
        occluded: bool = False,
        starts: tuple[HandStart, ...] = ABOVE,
        reward: RewardForm = "paper",
        robot: Callable[[], Robot] = jaco,
    ) -> None:
        size = [BOX_HALF_SIZE] * 3
        box = props.Primitive(geom_type="box", size=size, mass=BOX_MASS, rgba=_RED, name="box")
        target = self.place_over_disc if occluded else self.place
        super().__init__(box, BOX_HALF_SIZE, target, robot)
        self.occluded, self.reward, self._starts = occluded, reward, starts
        if reward == "staged":
            self.term_names = (*self.term_names, "success")
        self._add_objects()
        if occluded:
            _add_disc(self._arena, self.disc_radius)

    def _add_objects(self) -> None:
        """Add further objects to the scene; the default adds none."""

    def distance(self, physics: mjcf.Physics) -> float:
        """Return the distance from the box to its target, m."""
        return self.goal_distance(physics)

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        """Start as `ArmTask` does, then move the hand to the box if the start requires it."""
        super().initialize_episode(physics, random_state)
        if self._starts == ABOVE:  # draw the same random numbers as dm_control
            return
        start = self._starts[random_state.randint(len(self._starts))]
        if start == "above":
            return
        box = physics.bind(self._prop_frame.freejoint)
        pose = np.array(box.qpos)
        if start == "carrying":
            assert self.target is not None
            way = self.target - pose[:3]
            box.qpos = [*(pose[:3] + random_state.uniform() * way), *pose[3:]]
            physics.forward()
        if not self._place_hand_around_box(physics, random_state):
            box.qpos = pose
        elif start != "around":
            self._close_fingers(physics, box_is_fixed=start == "carrying")

    def _place_hand_around_box(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> bool:
        """Move the hand to the box; return whether a position without contact was found."""
        joints = physics.bind([*self.robot.arm.joints, *self.robot.hand.joints])
        above, prop = np.array(joints.qpos), np.array(physics.bind(self._prop_frame).xpos)
        lower, upper = np.array(AROUND_BOX) + prop
        for _ in range(ATTEMPTS):
            self.robot.hand.set_grasp(physics, random_state.uniform(*CLOSED_AROUND_BOX))
            with suppress(composer.EpisodeInitializationError):
                self.robot.place_hand(physics, random_state, lower, upper)
                if not self._hand_touches_box(physics):
                    return True
        joints.qpos = above
        return False

    def _close_fingers(self, physics: mjcf.Physics, *, box_is_fixed: bool) -> None:
        velocities = np.zeros(physics.model.nu)
        velocities[physics.bind(self.robot.hand.actuators).element_id] = CLOSING_VELOCITY
        physics.set_control(velocities)
        box = physics.bind(self._prop_frame.freejoint)
        pose = np.array(box.qpos)
        for _ in range(CLOSING_STEPS * self.physics_steps_per_control_step):
            physics.step()
            if box_is_fixed:  # else it falls before the fingers hold it
                box.qpos, box.qvel = pose, 0.0
        physics.set_control(np.zeros(physics.model.nu))

    def _hand_touches_box(self, physics: mjcf.Physics) -> bool:
        body, floor = physics.model.geom_bodyid, 0
        for contact in physics.data.contact:
            bodies = {int(body[contact.geom1]), int(body[contact.geom2])}
            if contact.dist <= 0 and self._prop_body in bodies and floor not in bodies:
                return True
        return False


def _add_disc(arena: composer.Arena, radius: float) -> None:
    """Add a fixed, solid disc between the camera and the centre of the workspace.

    Args:
        arena: the scene.
        radius: radius of the disc, m.
    """
    lower, upper = DISC_HEIGHT
    arena.mjcf_model.worldbody.add(
        "geom",
        name="disc",
        type="cylinder",
        pos=(*DISC_CENTER, (lower + upper) / 2),
        size=(radius, (upper - lower) / 2),
        rgba=_GREY,
    )
