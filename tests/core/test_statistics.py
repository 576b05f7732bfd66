import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from merl.core.statistics import Interval, bootstrap_interval, wilson_interval


def test_bootstrap_of_two_values_by_hand():
    # Resampled means: 0 with 1/4, 0.5 with 1/2, 1 with 1/4.
    assert bootstrap_interval([0.0, 1.0]) == Interval(0.5, 0.0, 1.0)


def test_bootstrap_of_three_values_by_hand():
    # Resampled means: 0, 1, 2, 3 with 8/27, 12/27, 6/27, 1/27; 96.3 % of them are at most 2.
    assert bootstrap_interval([0.0, 0.0, 3.0]) == Interval(1.0, 0.0, 3.0)


def test_bootstrap_approaches_the_normal_interval():
    values = np.random.default_rng(1).normal(100, 20, 400)
    interval = bootstrap_interval(values)
    half = 1.96 * values.std() / 20
    assert interval.low == pytest.approx(interval.mean - half, abs=0.2)
    assert interval.high == pytest.approx(interval.mean + half, abs=0.2)


def test_bootstrap_of_the_same_sample_is_the_same():
    values = np.random.default_rng(2).normal(size=20)
    assert bootstrap_interval(values) == bootstrap_interval(values)


@pytest.mark.parametrize("values", [[0.1], [0.1] * 7])
def test_bootstrap_of_equal_values_has_width_zero(values):
    assert bootstrap_interval(values) == Interval(0.1, 0.1, 0.1)


@pytest.mark.parametrize("values", [[], [1.0, float("nan")], [float("inf")]])
def test_bootstrap_refuses_empty_and_non_finite_samples(values):
    with pytest.raises(ValueError, match="finite"):
        bootstrap_interval(values)


@pytest.mark.parametrize("size", [2, 7, 50])
def test_bootstrap_is_that_of_scipy(size):
    values = np.random.default_rng(3).normal(5, 2, size)
    expected = stats.bootstrap(
        (values,), np.mean, n_resamples=9_999, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    interval = bootstrap_interval(values)
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high), rel=1e-12)


@pytest.mark.parametrize(("successes", "n"), [(0, 10), (3, 10), (25, 50), (10, 10), (1, 1)])
def test_wilson_is_that_of_scipy(successes, n):
    expected = stats.binomtest(successes, n).proportion_ci(0.95, method="wilson")
    expected = (successes / n, expected.low, expected.high)
    interval = wilson_interval(successes, n)
    assert interval == pytest.approx(expected, abs=1e-12)
    assert 0 <= interval.low <= interval.mean <= interval.high <= 1


def test_the_intervals_need_not_import_scipy():
    code = (
        "import sys; from merl.core.statistics import *; wilson_interval(1, 3); "
        "bootstrap_interval([1, 2]); sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_wilson_of_no_success_by_hand():
    # z^2 / (n + z^2) = 3.8415 / 13.8415
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.0, 0.27753), abs=1e-5)


@pytest.mark.parametrize(("successes", "n"), [(0, 0), (-1, 5), (6, 5)])
def test_wilson_refuses_impossible_counts(successes, n):
    with pytest.raises(ValueError, match="trials"):
        wilson_interval(successes, n)
