"""The rewards of the paper (appendix B.1, Eq. 3) as pure functions that return their named terms.

Each term lies in [0, 1/N] with N the number of stages, so that their sum, the reward, lies in
[0, 1]. Distances are in metres.
"""

from __future__ import annotations

from dm_control.utils.rewards import tolerance

REACHING_DISTANCE = 0.05
"""epsilon_reaching: the hand is at the object when its tool centre point is this near, m."""
REACHING_MARGIN = 0.05
"""Beyond epsilon_reaching the reward falls off as a gaussian of this width, to 0.1 there, m."""


def reach(distance: float) -> dict[str, float]:
    """Eq. 3, N = 1: bring the hand to the object.

    Args:
        distance: from the tool centre point to the object, m.

    Returns:
        `reaching`, in [0, 1].
    """
    return {"reaching": _reaching(distance)}


def _reaching(distance: float) -> float:
    return float(
        tolerance(
            distance, bounds=(0.0, REACHING_DISTANCE), margin=REACHING_MARGIN, sigmoid="gaussian"
        )
    )
