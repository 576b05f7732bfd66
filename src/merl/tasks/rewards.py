"""Rewards of the paper (appendix B.2, Eqs. 3 to 5) as pure functions that return named terms.

Each term is in [0, 1/N], where N is the number of stages (terms). Their sum is the reward, in
[0, 1]. Distances and heights are in metres.
"""

from __future__ import annotations

from dm_control.utils.rewards import tolerance

from merl.core.choices import RewardForm

REACHING_DISTANCE = 0.05
"""epsilon_reaching, m: the hand is at the object if its tool centre point is closer than this."""
REACHING_MARGIN = 0.05
"""Beyond epsilon_reaching the reward falls as a Gaussian, to 0.1 after this margin, m."""
GOAL_DISTANCE = 0.05
"""epsilon_pushing and epsilon_lifting, m: the goal term has its maximum if the object is at most
this far from its target (the authors' later code)."""
GOAL_MARGIN = 0.05
"""Beyond `GOAL_DISTANCE` the goal term falls with a long tail, to 0.1 after this margin, m."""
SUCCESS_DISTANCE = 0.01
"""The task is solved if the object is at most this far from its target, m (MERL B.1)."""
SUCCESS_MARGIN = 0.01
"""Margin of the long tail of the `success` term of `staged`, m (the authors' later code)."""
VERTICAL_COSINE = 0.99
"""1 - epsilon_vertical: the hand points down if the cosine of its tilt is at least this. Below, the
reward falls as a Gaussian whose margin has the same value."""
FLOATING_HEIGHT = 0.035
"""epsilon_floating, m: the object is off the floor if its centre is higher than this."""

FLOATING_FROM = 0.03
"""Height of the object's centre at which the `floating` term of `staged` starts to rise, m."""
FLOATING_BELOW_TARGET = 0.01
"""The `floating` term of `staged` is scaled to a height this far below the target, m."""
FLOATING_SLOPE = 2.0
"""Factor of the `floating` term of `staged`, which therefore has its maximum half-way up."""

Terms = dict[str, float]


def reach(hand_distance: float) -> Terms:
    """Return the terms of Eq. 3, N = 1: bring the hand to the object.

    Args:
        hand_distance: distance from the tool centre point to the object, m.

    Returns:
        `reaching`, in [0, 1].
    """
    return {"reaching": _near(hand_distance)}


def move(hand_distance: float, goal_distance: float, *, form: RewardForm = "paper") -> Terms:
    """Return the terms of Eq. 4: bring the object to a target on the floor, hand at the object.

    Args:
        hand_distance: distance from the tool centre point to the object, m.
        goal_distance: distance from the object to its target, m.
        form: form of the reward.

    Returns:
        `reaching` and `pushing`, each in [0, 1/2]. With `staged` also `success`, and each in
        [0, 1/3].
    """
    at_object = hand_distance < REACHING_DISTANCE
    terms = {
        "reaching": _near(hand_distance),
        "pushing": _at_goal(goal_distance) if at_object else 0.0,
    }
    if form == "staged":
        terms["success"] = _solved(goal_distance) if at_object else 0.0
    return _shares(terms)


def lift(
    hand_distance: float,
    tilt_cosine: float,
    height: float,
    target_height: float,
    goal_distance: float,
    *,
    vertical_cosine: float = VERTICAL_COSINE,
    form: RewardForm = "paper",
) -> Terms:
    """Return the terms of Eq. 5: raise the object to a target in the air, hand pointing down.

    The last row of Eq. 5 depends only on the object's height. Here the hand must also be at the
    object, as in the authors' later code (docs/explanation/paper.md): a thrown box is not lifted.

    Args:
        hand_distance: distance from the tool centre point to the object, m.
        tilt_cosine: cosine between the hand's axis and straight down, in [-1, 1].
        height: height of the object's centre above the floor, m.
        target_height: height of the target above the floor, m, above 0.
        goal_distance: distance from the object to its target, m.
        vertical_cosine: 1 - epsilon_vertical: bound and margin of the vertical term.
        form: form of the reward.

    Returns:
        `reaching`, `vertical`, `floating` and `lifting`, each in [0, 1/4]. With `staged` also
        `success`, and each in [0, 1/5].
    """
    at_object = hand_distance < REACHING_DISTANCE
    off_floor = at_object and height > FLOATING_HEIGHT
    if form == "staged":
        top = target_height - FLOATING_BELOW_TARGET
        raised = FLOATING_SLOPE * (height - FLOATING_FROM) / (top - FLOATING_FROM)
        floats = off_floor
    else:
        raised, floats = height / target_height, at_object
    terms = {
        "reaching": _near(hand_distance),
        "vertical": _upright(tilt_cosine, vertical_cosine),
        "floating": min(max(raised, 0.0), 1.0) if floats else 0.0,
        "lifting": _at_goal(goal_distance) if off_floor else 0.0,
    }
    if form == "staged":
        terms["success"] = _solved(goal_distance) if off_floor else 0.0
    return _shares(terms)


def _shares(terms: Terms) -> Terms:
    """Divide terms in [0, 1] by their number, so that they sum to the reward."""
    return {name: value / len(terms) for name, value in terms.items()}


def _near(distance: float) -> float:
    bounds = (0.0, REACHING_DISTANCE)
    return float(tolerance(distance, bounds, margin=REACHING_MARGIN, sigmoid="gaussian"))


def _at_goal(distance: float) -> float:
    bounds = (0.0, GOAL_DISTANCE)
    return float(tolerance(distance, bounds, margin=GOAL_MARGIN, sigmoid="long_tail"))


def _solved(distance: float) -> float:
    bounds = (0.0, SUCCESS_DISTANCE)
    return float(tolerance(distance, bounds, margin=SUCCESS_MARGIN, sigmoid="long_tail"))


def _upright(cosine: float, enough: float) -> float:
    bounds = (enough, float("inf"))  # a cosine may exceed 1 by a rounding error
    return float(tolerance(cosine, bounds, margin=enough, sigmoid="gaussian"))
