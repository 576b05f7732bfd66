"""Move: push a box to a mark on the floor."""

from __future__ import annotations

from dm_control import mjcf

from merl.tasks import rewards
from merl.tasks.box import BOX_HALF_SIZE, BoxTask

TARGET = (0.0, -0.2, BOX_HALF_SIZE)
"""Where the centre of the box is to be, m: on the floor, nearer to the camera than it starts."""
MARK_RADIUS = 0.05
"""Of the green patch around the target, m: wider than the box, which stands on it in the end."""
MARK_HEIGHT = 0.001
"""Of its upper face, m above the floor."""
DISC_RADIUS = 0.085
"""Of the disc that hides the box when `occluded`, m."""
_GREEN = (0.0, 0.8, 0.0, 1.0)


class MoveBox(BoxTask):
    """Bring a cube to within 1 cm of a place on the floor (MERL B.1, Eq. 4)."""

    term_names = ("reaching", "pushing")
    place = place_over_disc = TARGET
    disc_radius = DISC_RADIUS

    def _furnish(self) -> None:
        # An opaque patch that touches nothing: the ray tracer draws neither sites nor transparency.
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
        """Eq. 4: `reaching` and `pushing`; the reward `staged` also has `success`."""
        return rewards.move(
            self.hand_distance(physics), self.goal_distance(physics), form=self.reward
        )
