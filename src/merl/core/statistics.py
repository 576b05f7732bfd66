"""How sure a number is: intervals around a mean and around a rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 9_999


class Interval(NamedTuple):
    """An estimate and the interval around it.

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
    """The mean of a sample, with a percentile bootstrap interval.

    The percentile form never leaves the range of the sample, and is what the field reports. One
    value, or values that are all equal, give an interval without width: there is nothing to
    resample, which is not to say that the mean is known.

    Args:
        values: the sample, at least one number, all finite.
        level: confidence, in (0, 1).
        seed: of the resampling; the same seed gives the same interval.

    Raises:
        ValueError: an empty sample, a number that is not finite, or a level outside (0, 1).
    """
    _check_level(level)
    sample = np.asarray(values, dtype=np.float64).ravel()
    if sample.size == 0 or not np.isfinite(sample).all():
        raise ValueError("a bootstrap needs at least one value, and finite ones")
    mean = float(sample.mean())
    if np.ptp(sample) == 0:
        return Interval(float(sample[0]), float(sample[0]), float(sample[0]))
    from scipy import stats  # here, for it takes a second to import

    low, high = stats.bootstrap(
        (sample,),
        np.mean,
        confidence_level=level,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    # Of a few values the mean can lie outside a narrow interval; an interval holds its estimate.
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def wilson_interval(successes: int, n: int, level: float = 0.95) -> Interval:
    """A rate of success, with Wilson's score interval, which holds for few trials and for 0 or n.

    Args:
        successes: in [0, n].
        n: trials, at least 1.
        level: confidence, in (0, 1).

    Returns:
        Fractions in [0, 1].

    Raises:
        ValueError: no trials, successes outside [0, n], or a level outside (0, 1).
    """
    _check_level(level)
    if n < 1 or not 0 <= successes <= n:
        raise ValueError(f"{successes} successes in {n} trials")
    from scipy import stats

    interval = stats.binomtest(int(successes), int(n)).proportion_ci(level, method="wilson")
    return Interval(successes / n, float(interval.low), float(interval.high))


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise ValueError(f"a level of confidence lies between 0 and 1, not {level}")
