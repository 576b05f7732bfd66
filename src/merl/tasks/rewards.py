"""The rewards of the paper (appendix B.2, Eqs. 3 to 5) as pure functions that return named terms.

Each term lies in [0, 1/N] with N the number of a task's stages, so that their sum, the reward, lies
in [0, 1]. Distances and heights are in metres.
"""

from __future__ import annotations

from typing import Literal

from dm_control.utils.rewards import tolerance

REACHING_DISTANCE = 0.05
"""epsilon_reaching: the hand is at the object when its tool centre point is this near, m."""
REACHING_MARGIN = 0.05
"""Beyond epsilon_reaching the reward falls off as a gaussian of this width, to 0.1 there, m."""
GOAL_DISTANCE = 0.01
"""epsilon_pushing and epsilon_lifting: the object is at its target when it is this near, m."""
GOAL_MARGIN = 0.05
"""Beyond it the reward falls off with a long tail, to 0.1 at this distance more, m."""
FAR_GOAL_MARGIN = 0.3
"""In place of that, where the reward is to tell from afar which way the goal is: it falls off in a
straight line, to 0 at this distance more, m."""
VERTICAL_COSINE = 0.99
"""1 - epsilon_vertical: the hand points down when the cosine of its tilt is at least this; below it
the reward falls off as a gaussian whose margin is the same number."""
FLOATING_HEIGHT = 0.035
"""epsilon_floating: the object is off the floor when its centre is above this, m."""

GoalReward = Literal["near", "far", "both"]
"""How far the reward for the object's place reaches: `GOAL_MARGIN`, `FAR_GOAL_MARGIN`, or the mean
of the two, which tells from afar which way the goal is and still pays for the last centimetres."""
Terms = dict[str, float]


def reach(hand_distance: float) -> Terms:
    """Eq. 3, N = 1: bring the hand to the object.

    Args:
        hand_distance: from the tool centre point to the object, m.

    Returns:
        `reaching`, in [0, 1].
    """
    return {"reaching": _near(hand_distance)}


def move(hand_distance: float, goal_distance: float, *, goal: GoalReward = "near") -> Terms:
    """Eq. 4, N = 2: bring the object to a place on the floor; it counts while the hand is at it.

    Args:
        hand_distance: from the tool centre point to the object, m.
        goal_distance: from the object to its target, m.
        goal: how far the reward for the object's place reaches.

    Returns:
        `reaching` and `pushing`, each in [0, 1/2].
    """
    at_object = hand_distance < REACHING_DISTANCE
    return _stages(
        reaching=_near(hand_distance),
        pushing=_at_goal(goal_distance, goal) if at_object else 0.0,
    )


def lift(
    hand_distance: float,
    tilt_cosine: float,
    height: float,
    target_height: float,
    goal_distance: float,
    *,
    vertical_cosine: float = VERTICAL_COSINE,
    goal: GoalReward = "near",
) -> Terms:
    """Eq. 5, N = 4: raise the object to a place in the air, with the hand pointing down.

    Eq. 5 names for its last row the object's height alone; that the hand must be at the object
    there too is ours (docs/paper.md): what flies or rolls by itself is not lifted.

    Args:
        hand_distance: from the tool centre point to the object, m.
        tilt_cosine: between the hand's axis and straight down, in [-1, 1].
        height: of the object's centre above the floor, m.
        target_height: of the target above the floor, m, above 0.
        goal_distance: from the object to its target, m.
        vertical_cosine: 1 - epsilon_vertical: bound and margin of the vertical term.
        goal: how far the reward for the object's place reaches.

    Returns:
        `reaching`, `vertical`, `floating` and `lifting`, each in [0, 1/4].
    """
    at_object = hand_distance < REACHING_DISTANCE
    off_floor = at_object and height > FLOATING_HEIGHT
    return _stages(
        reaching=_near(hand_distance),
        vertical=_upright(tilt_cosine, vertical_cosine),
        floating=min(max(height / target_height, 0.0), 1.0) if at_object else 0.0,
        lifting=_at_goal(goal_distance, goal) if off_floor else 0.0,
    )


def _stages(**terms: float) -> Terms:
    """Each stage's term, from [0, 1] to its share of the reward."""
    return {name: value / len(terms) for name, value in terms.items()}


def _near(distance: float) -> float:
    bounds = (0.0, REACHING_DISTANCE)
    return float(tolerance(distance, bounds, margin=REACHING_MARGIN, sigmoid="gaussian"))


def _at_goal(distance: float, goal: GoalReward) -> float:
    bounds = (0.0, GOAL_DISTANCE)
    linear = {"sigmoid": "linear", "value_at_margin": 0.0}
    near = float(tolerance(distance, bounds, margin=GOAL_MARGIN, sigmoid="long_tail"))
    far = float(tolerance(distance, bounds, margin=FAR_GOAL_MARGIN, **linear))
    return {"near": near, "far": far, "both": (near + far) / 2}[goal]


def _upright(cosine: float, enough: float) -> float:
    bounds = (enough, float("inf"))  # a cosine may exceed 1 by a rounding error
    return float(tolerance(cosine, bounds, margin=enough, sigmoid="gaussian"))
