"""Confidence intervals of a mean and of a success rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 9_999


class Interval(NamedTuple):
    """An estimate and its confidence interval.

    Attributes:
        mean: the estimate.
        low: lower end, at most `mean`.
        high: upper end, at least `mean`.
    """

    mean: float
    low: float
    high: float


def bootstrap_interval(
    values: Sequence[float] | NDArray[np.floating], level: float = 0.95, seed: int = 0
) -> Interval:
    """Return the mean of a sample with its percentile bootstrap interval.

    A percentile interval never exceeds the range of the sample, and it is the common choice in the
    field. A single value, or equal values, give an interval of width 0, because resampling cannot
    vary them; this does not mean that the mean is known exactly.

    Args:
        values: the sample, at least one number, all finite.
        level: confidence level, in (0, 1).
        seed: seed of the resampling; the same seed gives the same interval.

    Raises:
        ValueError: an empty sample, a number that is not finite, or a level outside (0, 1).
    """
    _check_level(level)
    sample = np.asarray(values, dtype=np.float64).ravel()
    if sample.size == 0 or not np.isfinite(sample).all():
        raise ValueError("a bootstrap needs at least one value, and all values must be finite")
    mean = float(sample.mean())
    if np.ptp(sample) == 0:
        return Interval(float(sample[0]), float(sample[0]), float(sample[0]))
    from scipy import stats  # imported here because it takes a second

    low, high = stats.bootstrap(
        (sample,),
        np.mean,
        confidence_level=level,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    # With few values the mean can lie outside a narrow interval: extend the interval to the mean.
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def wilson_interval(successes: int, n: int, level: float = 0.95) -> Interval:
    """Return a success rate with Wilson's score interval.

    The interval is valid for few trials, and for 0 or n successes.

    Args:
        successes: number of successes, in [0, n].
        n: number of trials, at least 1.
        level: confidence level, in (0, 1).

    Returns:
        The rate and its interval, as fractions in [0, 1].

    Raises:
        ValueError: no trials, successes outside [0, n], or a level outside (0, 1).
    """
    _check_level(level)
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"impossible counts: {successes} successes in {n} trials")
    from scipy import stats

    interval = stats.binomtest(int(successes), int(n)).proportion_ci(level, method="wilson")
    return Interval(successes / n, float(interval.low), float(interval.high))


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise ValueError(f"the confidence level must be between 0 and 1, not {level}")
