"""Statistics over seeds and tasks, against frozen figures of rliable 1.2.0."""

from __future__ import annotations

import numpy as np
import pytest

from merl.report.aggregates import (
    interquartile_mean,
    optimality_gap,
    paired_test,
    performance_profile,
    probability_of_improvement,
    profile_band,
    stratified_interval,
)

A = np.array(
    [
        [0.733, 0.621, 0.541],
        [0.704, 0.873, 0.48],
        [0.906, 0.827, 0.43],
        [0.664, 0.914, 0.402],
        [0.418, 0.657, 0.689],
    ]
)
B = np.array(
    [[0.33, 0.762, 0.182], [0.652, 0.732, 0.668], [0.341, 0.45, 0.533], [0.269, 0.824, 0.603]]
)
THRESHOLDS = np.array([0.0, 0.25, 0.5, 0.75, 0.9])


def test_the_figures_of_rliable() -> None:
    assert interquartile_mean(A) == pytest.approx(0.6573333333333333, abs=1e-12)
    assert interquartile_mean(B) == pytest.approx(0.5411666666666667, abs=1e-12)
    assert optimality_gap(A) == pytest.approx(0.34273333333333345, abs=1e-12)
    assert optimality_gap(B) == pytest.approx(0.4711666666666666, abs=1e-12)
    assert probability_of_improvement(A, B) == pytest.approx(0.7, abs=1e-12)
    assert performance_profile(A, THRESHOLDS) == pytest.approx([1, 1, 11 / 15, 4 / 15, 2 / 15])


def test_the_intervals_of_rliable() -> None:
    # Its bootstrap draws other resamples: 50,000 for the first two, 2000 for the last.
    assert stratified_interval(interquartile_mean, A) == pytest.approx(
        (0.65733, 0.57122, 0.74367), abs=0.01
    )
    assert stratified_interval(optimality_gap, A) == pytest.approx(
        (0.34273, 0.27893, 0.40787), abs=0.01
    )
    assert stratified_interval(probability_of_improvement, A, B) == pytest.approx(
        (0.7, 0.5, 0.8833), abs=0.02
    )
    low, high = profile_band(A, THRESHOLDS)
    assert low == pytest.approx([1, 1, 0.5333, 0.0667, 0.0], abs=0.07)
    assert high == pytest.approx([1, 1, 0.9333, 0.4667, 0.3333], abs=0.07)


def test_a_bootstrap_resamples_the_seeds_of_each_task_on_their_own() -> None:
    # If whole seeds were drawn, the mean of a row would always be 0.5.
    scores = np.array([[0.0, 1.0], [1.0, 0.0]])
    interval = stratified_interval(lambda each: float(each.mean()), scores)
    assert (interval.low, interval.high) == (0.0, 1.0)


def test_scores_above_the_target_do_not_close_the_gap() -> None:
    assert optimality_gap(np.array([[2.0, 0.5]])) == 0.25


def test_equal_scores_count_half() -> None:
    assert probability_of_improvement(np.array([[1.0]]), np.array([[1.0]])) == 0.5


def test_the_paired_test_is_exact() -> None:
    difference, p = paired_test([3.0, 5.0, 9.0], [1.0, 2.0, 4.0])
    assert difference == pytest.approx(10 / 3)
    assert p == pytest.approx(2 / 8)  # of eight swaps only two are as extreme
    assert paired_test([1.0, 2.0], [2.0, 1.0])[1] == 1.0


@pytest.mark.parametrize(("ours", "theirs"), [([1.0], [2.0]), ([1.0, 2.0], [1.0])])
def test_a_paired_test_needs_pairs(ours: list[float], theirs: list[float]) -> None:
    with pytest.raises(ValueError, match="at least two equal seeds"):
        paired_test(ours, theirs)
