"""Eq. 3 at points computed by hand."""

import pytest

from merl.tasks import rewards


@pytest.mark.parametrize(
    ("distance", "expected"),
    [
        (0.0, 1.0),
        (0.05, 1.0),  # the bound belongs to the goal
        (0.0500001, 1.0),
        (0.075, 0.1**0.25),  # a gaussian: 0.1 to the square of the share of the margin
        (0.1, 0.1),  # the margin's end
        (0.15, 0.1**4),
        (1.0, 0.0),
    ],
)
def test_reach(distance: float, expected: float) -> None:
    terms = rewards.reach(distance)
    assert list(terms) == ["reaching"]
    assert terms["reaching"] == pytest.approx(expected, abs=1e-5)
