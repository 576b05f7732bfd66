"""Confidence intervals of a mean and of a success rate.

They are those of scipy.stats, which takes a second to import and 75 MB in every run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LEVEL, RESAMPLES = 0.95, 9_999


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


def bootstrap_interval(values: Sequence[float] | NDArray[np.floating]) -> Interval:
    """Return the mean of a sample with its 95 % percentile bootstrap interval.

    A percentile interval never exceeds the range of the sample, and it is the common choice in the
    field. A single value, or equal values, give an interval of width 0, because resampling cannot
    vary them; this does not mean that the mean is known exactly.

    Args:
        values: the sample, at least one number, all finite.

    Raises:
        ValueError: an empty sample, or a number that is not finite.
    """
    sample = np.asarray(values, dtype=np.float64).ravel()
    if sample.size == 0 or not np.isfinite(sample).all():
        raise ValueError("a bootstrap needs at least one value, and all values must be finite")
    mean = float(sample.mean())
    if np.ptp(sample) == 0:
        return Interval(float(sample[0]), float(sample[0]), float(sample[0]))
    rng = np.random.default_rng(0)  # the same sample gives the same interval
    means = sample[rng.integers(0, sample.size, (RESAMPLES, sample.size))].mean(axis=1)
    low, high = np.percentile(means, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    # By rounding, the mean of nearly equal values can lie outside: extend the interval to the mean.
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def wilson_interval(successes: int, n: int) -> Interval:
    """Return a success rate with Wilson's 95 % score interval.

    The interval is valid for few trials, and for 0 or n successes.

    Args:
        successes: number of successes, in [0, n].
        n: number of trials, at least 1.

    Returns:
        The rate and its interval, as fractions in [0, 1].

    Raises:
        ValueError: no trials, or successes outside [0, n].
    """
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"impossible counts: {successes} successes in {n} trials")
    rate, z = successes / n, NormalDist().inv_cdf((1 + LEVEL) / 2)
    shrink = 1 / (1 + z * z / n)
    centre = shrink * (rate + z * z / (2 * n))
    half = shrink * z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    low = 0.0 if successes == 0 else centre - half  # exactly, without rounding
    high = 1.0 if successes == n else centre + half
    return Interval(rate, low, high)
