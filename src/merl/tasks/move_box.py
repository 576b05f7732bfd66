"""Move: push a box to a mark on the floor."""

from __future__ import annotations

from dm_control import mjcf

from merl.tasks import rewards
from merl.tasks.box import BOX_HALF_SIZE, BoxTask

TARGET = (0.0, -0.2, BOX_HALF_SIZE)
"""Target of the box's centre, m: on the floor, closer to the camera than every start."""
MARK_RADIUS = 0.05
"""Radius of the green mark around the target, m: it is wider than the box, which ends up on it."""
MARK_HEIGHT = 0.001
"""Height of the mark's upper face above the floor, m."""
DISC_RADIUS = 0.085
"""Radius of the disc that hides the box if `occluded`, m."""
_GREEN = (0.0, 0.8, 0.0, 1.0)


class MoveBox(BoxTask):
    """Bring a cube to within 1 cm of a target on the floor (MERL B.1, Eq. 4)."""

    term_names = ("reaching", "pushing")
    place = place_over_disc = TARGET
    disc_radius = DISC_RADIUS

    def _add_objects(self) -> None:
        # An opaque geom without contacts: renderer `raster` draws neither sites nor transparency.
        self._arena.mjcf_model.worldbody.add(
            "geom",
            name="mark",
            type="cylinder",
            pos=(*TARGET[:2], 0.0),
            size=(MARK_RADIUS, MARK_HEIGHT),
            rgba=_GREEN,
            contype=0,
            conaffinity=0,
        )

    def reward_terms(self, physics: mjcf.Physics) -> rewards.Terms:
        """Return `reaching` and `pushing` (Eq. 4); the reward `staged` adds `success`."""
        return rewards.move(
            self.hand_distance(physics), self.goal_distance(physics), form=self.reward
        )
