"""Lift: raise a box into the air and hold it there."""

from __future__ import annotations

from dm_control import mjcf

from merl.tasks import rewards
from merl.tasks.box import BOX_HALF_SIZE, add_disc, make_box
from merl.tasks.jaco import ABOVE, HandStart, JacoTask

TARGET = (0.0, 0.0, 0.18)
"""Where the centre of the box is to be, m. It is not marked."""
TARGET_OVER_DISC = (0.0, 0.0, 0.22)
"""The same when `occluded`, m: at 0.18 the box would rest on the disc."""
DISC_RADIUS = 0.075
"""Of the disc that hides the box when `occluded`, m."""
VERTICAL_COSINE_AROUND_DISC = 0.40
"""From which on the hand counts as vertical when `occluded`: it has to tilt to get under."""


class LiftBox(JacoTask):
    """Bring a cube to within 1 cm of a place in the air (MERL B.1, Eq. 5).

    Args:
        occluded: put a disc between camera and box.
        starts: where the hand starts; under the disc there is no room for it around the box.
        goal: how far the reward for the box's place reaches.

    Attributes:
        goal: how far the reward for the box's place reaches.
        vertical_cosine: from this `tilt_cosine` on the hand counts as vertical.
    """

    term_names = ("reaching", "vertical", "floating", "lifting")
    success_distance = rewards.GOAL_DISTANCE

    def __init__(
        self,
        occluded: bool = False,
        starts: tuple[HandStart, ...] = ABOVE,
        goal: rewards.GoalReward = "near",
    ) -> None:
        super().__init__(
            make_box(), BOX_HALF_SIZE, TARGET_OVER_DISC if occluded else TARGET, starts
        )
        self.goal, self.vertical_cosine = goal, rewards.VERTICAL_COSINE
        if occluded:
            self.vertical_cosine = VERTICAL_COSINE_AROUND_DISC
            add_disc(self._arena, DISC_RADIUS)

    def distance(self, physics: mjcf.Physics) -> float:
        """From the box to its target, m."""
        return self.goal_distance(physics)

    def reward_terms(self, physics: mjcf.Physics) -> rewards.Terms:
        """Eq. 5: `reaching`, `vertical`, `floating` and `lifting`, each in [0, 1/4]."""
        assert self.target is not None
        return rewards.lift(
            self.hand_distance(physics),
            self.tilt_cosine(physics),
            height=float(self.prop_position(physics)[2]),
            target_height=float(self.target[2]),
            goal_distance=self.goal_distance(physics),
            vertical_cosine=self.vertical_cosine,
            goal=self.goal,
        )
