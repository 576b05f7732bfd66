"""Lift: raise a box into the air and hold it there."""

from __future__ import annotations

from dm_control import mjcf

from merl.tasks import rewards
from merl.tasks.box import BoxTask

TARGET = (0.0, 0.0, 0.18)
"""Target of the box's centre, m. No mark shows it."""
TARGET_OVER_DISC = (0.0, 0.0, 0.22)
"""Target of the box's centre if `occluded`, m: at 0.18 the box would rest on the disc."""
DISC_RADIUS = 0.075
"""Radius of the disc that hides the box if `occluded`, m."""
VERTICAL_COSINE_AROUND_DISC = 0.40
"""Bound and margin of the vertical term if `occluded`: the hand tilts to reach under the disc."""


class LiftBox(BoxTask):
    """Bring a cube to within 1 cm of a target in the air (MERL B.1, Eq. 5)."""

    term_names = ("reaching", "vertical", "floating", "lifting")
    place, place_over_disc = TARGET, TARGET_OVER_DISC
    disc_radius = DISC_RADIUS

    @property
    def vertical_cosine(self) -> float:
        """Minimum `tilt_cosine` at which the hand counts as vertical."""
        return VERTICAL_COSINE_AROUND_DISC if self.occluded else rewards.VERTICAL_COSINE

    def reward_terms(self, physics: mjcf.Physics) -> rewards.Terms:
        """Return `reaching`, `vertical`, `floating`, `lifting` (Eq. 5); `staged` adds `success`."""
        assert self.target is not None
        return rewards.lift(
            self.hand_distance(physics),
            self.robot.tilt_cosine(physics),
            height=float(self.prop_position(physics)[2]),
            target_height=float(self.target[2]),
            goal_distance=self.goal_distance(physics),
            vertical_cosine=self.vertical_cosine,
            form=self.reward,
        )
