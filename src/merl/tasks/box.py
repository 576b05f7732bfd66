"""What the tasks with a box share: the box, a disc that hides it, starts with the hand at it."""

from __future__ import annotations

from contextlib import suppress
from typing import Literal

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer import initializers
from dm_control.composer.variation import distributions
from dm_control.entities import props
from dm_control.manipulation.shared import workspaces

from merl.tasks.jaco import Box, JacoTask, Position
from merl.tasks.rewards import SUCCESS_DISTANCE, RewardForm
from merl.tasks.simulator import quiet_inverse_kinematics

BOX_HALF_SIZE = 0.025
"""Half the length of an edge, m: also the height at which the box's centre rests."""
BOX_MASS = 0.1
"""kg."""
DISC_CENTER = (0.0, -0.06)
"""Middle of the disc, x and y, m: nearer to the camera than the middle of the workspace, so that
from where the camera stands it hides most of what lies there (docs/tasks.md)."""
DISC_HEIGHT = (0.135, 0.150)
"""Lower and upper face of the disc, m above the floor."""
AROUND_BOX = Box((-0.01, -0.01, 0.0), (0.01, 0.01, 0.02))
"""Where the tool centre point starts around the box, from the box's centre, m."""
CLOSED_AROUND_BOX = (0.2, 0.6)
"""By which share the fingers are closed there, at least and at most: they do not yet touch it."""
ATTEMPTS = 20
"""To draw a start around the box in which the hand does not touch it."""
CLOSING_VELOCITY = 1.0
"""Of the fingers that close around the box before an episode begins, rad/s."""
CLOSING_STEPS = 20
"""For so many control steps: enough from the widest start."""
HandStart = Literal["above", "around", "holding", "carrying"]
"""Where the hand starts: above the workspace, open around the box, closed around it, or closed
around it on its way to the target."""
ABOVE: tuple[HandStart, ...] = ("above",)
"""dm_control's start, that of every `JacoTask`."""
_RED = (1.0, 0.0, 0.0, 1.0)
_GREY = (0.5, 0.5, 0.5, 1.0)


class BoxTask(JacoTask):
    """A task with a red cube, which may be hidden, and at which the hand may start.

    The start `above` is that of `JacoTask`. In `around` the hand is then moved to the box, to a
    place drawn from `AROUND_BOX` and with its fingers closed by a share of `CLOSED_AROUND_BOX`,
    where it touches nothing; should none be found, which is rare, it stays where it was. In
    `holding` the fingers have closed from there, and hold the box, which is on the floor. In
    `carrying` they hold it anywhere on the straight way from there to its target, ends included.

    Args:
        occluded: put a disc between camera and box.
        starts: where the hand starts; of several, one is drawn in each episode. Under the disc
            there is no room for it at the box.
        reward: which reward.

    Attributes:
        occluded, reward: as given.
        place: where the box is to be brought, m.
        place_over_disc: the same when `occluded`, m.
        disc_radius: of the disc, m.
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
    ) -> None:
        size = [BOX_HALF_SIZE] * 3
        box = props.Primitive(geom_type="box", size=size, mass=BOX_MASS, rgba=_RED, name="box")
        super().__init__(box, BOX_HALF_SIZE, self.place_over_disc if occluded else self.place)
        self.occluded, self.reward, self._starts = occluded, reward, starts
        if reward == "staged":
            self.term_names = (*self.term_names, "success")
        self._furnish()
        if occluded:
            _add_disc(self._arena, self.disc_radius)

    def _furnish(self) -> None:
        """Add what else the scene has; nothing, unless a task says so."""

    def distance(self, physics: mjcf.Physics) -> float:
        """From the box to its target, m."""
        return self.goal_distance(physics)

    def initialize_episode(
        self, physics: mjcf.Physics, random_state: np.random.RandomState
    ) -> None:
        """As every task, then the hand to the box where it starts there."""
        super().initialize_episode(physics, random_state)
        if self._starts == ABOVE:  # dm_control's draws, and no other
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
        """Bring the hand to where the box is; returns whether a place was found."""
        joints = physics.bind([*self.arm.joints, *self.hand.joints])
        above, prop = np.array(joints.qpos), np.array(physics.bind(self._prop_frame).xpos)
        place_hand = initializers.ToolCenterPointInitializer(
            self.hand,
            self.arm,
            position=distributions.Uniform(*(np.array(AROUND_BOX) + prop)),
            quaternion=workspaces.DOWN_QUATERNION,
        )
        for _ in range(ATTEMPTS):
            self.hand.set_grasp(physics, random_state.uniform(*CLOSED_AROUND_BOX))
            with suppress(composer.EpisodeInitializationError), quiet_inverse_kinematics():
                place_hand(physics, random_state)
                if not self._hand_touches_box(physics):
                    return True
        joints.qpos = above
        return False

    def _close_fingers(self, physics: mjcf.Physics, *, box_is_fixed: bool) -> None:
        velocities = np.zeros(physics.model.nu)
        velocities[-len(self.hand.joints) :] = CLOSING_VELOCITY
        physics.set_control(velocities)
        box = physics.bind(self._prop_frame.freejoint)
        pose = np.array(box.qpos)
        for _ in range(CLOSING_STEPS * self.physics_steps_per_control_step):
            physics.step()
            if box_is_fixed:  # or it would fall before they hold it
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
    """Fix a solid disc between the camera and the middle of the workspace.

    Args:
        arena: the scene.
        radius: m.
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
