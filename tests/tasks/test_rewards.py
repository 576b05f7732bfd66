"""Eqs. 3 to 5 at points computed by hand, on both sides of every gate, and within their bounds."""

import itertools
from typing import get_args

import numpy as np
import pytest

from merl.core.choices import RewardForm
from merl.tasks import rewards

NEAR, FAR = 0.0499, 0.0501  # on either side of epsilon_reaching


@pytest.mark.parametrize(
    ("distance", "expected"),
    [
        (0.0, 1.0),
        (0.05, 1.0),  # the bound counts as reached
        (0.0500001, 1.0),
        (0.075, 0.1**0.25),  # a Gaussian: 0.1 to the power of (fraction of the margin)^2
        (0.1, 0.1),  # the end of the margin
        (0.15, 0.1**4),
        (1.0, 0.0),
    ],
)
def test_reach(distance: float, expected: float) -> None:
    terms = rewards.reach(distance)
    assert list(terms) == ["reaching"]
    assert terms["reaching"] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("hand", "goal", "reaching", "pushing"),
    [
        (0.0, 0.0, 0.5, 0.5),
        (NEAR, 0.05, 0.5, 0.5),  # the bound is epsilon_pushing
        (NEAR, 0.0500001, 0.5, 0.5),
        (NEAR, 0.1, 0.5, 0.05),  # the end of the margin
        (NEAR, 0.075, 0.5, 0.5 / (1 + 9 * 0.25)),  # a long tail: 1 / (1 + 9 fraction^2)
        (NEAR, 0.25, 0.5, 0.5 / (1 + 9 * 16)),
        (0.05, 0.0, 0.5, 0.0),  # the gate is open strictly below epsilon_reaching
        (FAR, 0.0, 0.5, 0.0),
        (0.1, 0.0, 0.05, 0.0),  # a thrown box at its target gets no reward
    ],
)
def test_move(hand: float, goal: float, reaching: float, pushing: float) -> None:
    terms = rewards.move(hand, goal)
    assert list(terms) == ["reaching", "pushing"]
    assert terms["reaching"] == pytest.approx(reaching, abs=1e-4)
    assert terms["pushing"] == pytest.approx(pushing, abs=1e-6)


@pytest.mark.parametrize(
    ("hand", "goal", "expected"),
    [
        # reaching, pushing, success; each a third
        (0.0, 0.0, (1.0, 1.0, 1.0)),
        (NEAR, 0.01, (1.0, 1.0, 1.0)),
        (NEAR, 0.015, (1.0, 1.0, 1 / (1 + 9 * 0.25))),  # half of the success margin
        (NEAR, 0.02, (1.0, 1.0, 0.1)),  # the end of the success margin
        (NEAR, 0.05, (1.0, 1.0, 1 / (1 + 9 * 16))),
        (NEAR, 0.1, (1.0, 0.1, 1 / (1 + 9 * 81))),  # the end of the pushing margin
        (0.05, 0.0, (1.0, 0.0, 0.0)),  # the gate is open strictly below epsilon_reaching
        (0.1, 0.0, (0.1, 0.0, 0.0)),
    ],
)
def test_staged_move(hand: float, goal: float, expected: tuple[float, ...]) -> None:
    terms = rewards.move(hand, goal, form="staged")
    assert list(terms) == ["reaching", "pushing", "success"]
    assert np.array(list(terms.values())) == pytest.approx(np.array(expected) / 3, abs=1e-4)


@pytest.mark.parametrize(
    ("hand", "height", "goal", "expected"),
    [
        # reaching, vertical, floating, lifting, success; each a fifth, the target at 0.18:
        # floating = 2 (height - 0.03) / 0.14
        (0.0, 0.18, 0.0, (1.0, 1.0, 1.0, 1.0, 1.0)),
        (NEAR, 0.1, 0.08, (1.0, 1.0, 1.0, 1 / (1 + 9 * 0.36), 1 / (1 + 9 * 49))),  # full at 0.1
        (NEAR, 0.065, 0.115, (1.0, 1.0, 0.5, 1 / (1 + 9 * 1.69), 1 / (1 + 9 * 110.25))),
        (NEAR, 0.0351, 0.01, (1.0, 1.0, 2 * 0.0051 / 0.14, 1.0, 1.0)),
        (NEAR, 0.035, 0.01, (1.0, 1.0, 0.0, 0.0, 0.0)),  # not above the bound: on the floor
        (FAR, 0.18, 0.0, (1.0, 1.0, 0.0, 0.0, 0.0)),  # the hand is not at the box
        (NEAR, 0.3, 0.12, (1.0, 1.0, 1.0, 1 / (1 + 9 * 1.96), 1 / (1 + 9 * 121))),  # too high
    ],
)
def test_staged_lift(hand: float, height: float, goal: float, expected: tuple[float, ...]) -> None:
    terms = rewards.lift(hand, 1.0, height, 0.18, goal, form="staged")
    assert list(terms) == ["reaching", "vertical", "floating", "lifting", "success"]
    assert np.array(list(terms.values())) == pytest.approx(np.array(expected) / 5, abs=1e-4)


def test_staged_floating_depends_on_the_height_of_the_target() -> None:
    lifted = rewards.lift(NEAR, 1.0, 0.075, 0.22, 0.145, form="staged")
    assert lifted["floating"] == pytest.approx(2 * 0.045 / 0.18 / 5)


@pytest.mark.parametrize(
    ("hand", "cosine", "height", "goal", "expected"),
    [
        # reaching, vertical, floating, lifting; each a quarter, the target at 0.18
        (0.0, 1.0, 0.18, 0.0, (1.0, 1.0, 1.0, 1.0)),
        (NEAR, 0.99, 0.0351, 0.05, (1.0, 1.0, 0.195, 1.0)),
        (NEAR, 0.99, 0.035, 0.0, (1.0, 1.0, 0.0350 / 0.18, 0.0)),  # not off the floor
        (NEAR, 1.0, 0.025, 0.155, (1.0, 1.0, 0.025 / 0.18, 0.0)),  # hand at the box on the floor
        (FAR, 1.0, 0.18, 0.0, (1.0, 1.0, 0.0, 0.0)),  # the hand is not at the box
        (0.3, 0.0, 0.025, 0.2, (0.0, 0.1, 0.0, 0.0)),  # one margin below: 0.1
        (0.3, 0.495, 0.025, 0.2, (0.0, 0.1**0.25, 0.0, 0.0)),
        (0.3, -1.0, 0.025, 0.2, (0.0, 0.1 ** (1.99 / 0.99) ** 2, 0.0, 0.0)),
        (NEAR, 1.0, 0.36, 0.18, (1.0, 1.0, 1.0, 1 / (1 + 9 * (0.13 / 0.05) ** 2))),  # too high
        (NEAR, 1.0, -0.01, 0.2, (1.0, 1.0, 0.0, 0.0)),
    ],
)
def test_lift(
    hand: float, cosine: float, height: float, goal: float, expected: tuple[float, ...]
) -> None:
    terms = rewards.lift(hand, cosine, height, 0.18, goal)
    assert list(terms) == ["reaching", "vertical", "floating", "lifting"]
    assert np.array(list(terms.values())) == pytest.approx(np.array(expected) / 4, abs=1e-4)


@pytest.mark.parametrize(
    ("cosine", "expected"),
    [(1.0, 1.0), (0.4, 1.0), (0.39, 0.1 ** (0.01 / 0.4) ** 2), (0.2, 0.1**0.25), (0.0, 0.1)],
)
def test_vertical_bound_of_the_occluded_task_is_also_its_margin(
    cosine: float, expected: float
) -> None:
    vertical = rewards.lift(0.3, cosine, 0.025, 0.22, 0.2, vertical_cosine=0.4)["vertical"]
    assert vertical == pytest.approx(expected / 4, abs=1e-9)
    if cosine < 0.99:
        assert rewards.lift(0.3, cosine, 0.025, 0.18, 0.2)["vertical"] < 0.25


def test_every_term_and_their_sum_stay_within_bounds() -> None:
    draw = np.random.default_rng(0)
    combinations: dict[tuple[bool, bool, bool], int] = {}
    gates = list(itertools.product((False, True), repeat=3))
    for at_object, off_floor, at_goal in gates:
        for _ in range(1000):
            hand = draw.uniform(0, 0.05) if at_object else draw.uniform(0.05, 0.15)
            height = draw.uniform(0.0351, 0.3) if off_floor else draw.uniform(-0.001, 0.035)
            goal = draw.uniform(0, 0.05) if at_goal else draw.uniform(0.05, 0.15)
            cosine = np.cos(np.radians(draw.uniform(0, 180)))
            for form in get_args(RewardForm):
                lifted = rewards.lift(hand, cosine, height, 0.18, goal, form=form)
                moved = rewards.move(hand, goal, form=form)
                for terms in (rewards.reach(hand), moved, lifted):
                    assert all(0 <= term <= 1 / len(terms) + 1e-12 for term in terms.values())
                    assert 0 <= sum(terms.values()) <= 1 + 1e-12
                floats = off_floor if form == "staged" else height > 0
                assert (lifted["floating"] > 0) == (at_object and floats)
                assert (lifted["lifting"] > 0) == (at_object and off_floor)
                assert (moved["pushing"] > 0) == at_object
            reached = (at_object, off_floor, at_goal)
            combinations[reached] = combinations.get(reached, 0) + 1
    assert min(combinations[gate] for gate in gates) == 1000
