"""Statistics over seeds and tasks, as Agarwal et al. 2021 recommend.

"Deep Reinforcement Learning at the Edge of the Statistical Precipice". Scores are arrays of shape
(seeds, tasks); a bootstrap resamples the seeds of each task on its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from merl.core.statistics import LEVEL, Interval

Array = NDArray[np.float64]
RESAMPLES = 2000


def interquartile_mean(scores: Array) -> float:
    """Return the mean of the middle half of all scores."""
    from scipy import stats

    return float(stats.trim_mean(scores, proportiontocut=0.25, axis=None))


def optimality_gap(scores: Array, target: float = 1.0) -> float:
    """Return by how much the scores fall short of a target, on average; more does not help."""
    return float(target - np.minimum(scores, target).mean())


def probability_of_improvement(ours: Array, theirs: Array) -> float:
    """Return the probability that a run of ours scores higher than one of theirs.

    It is the mean over tasks, and equal scores count half (the Mann-Whitney U statistic).

    Args:
        ours: scores, (M, T).
        theirs: scores, (N, T).
    """
    above = (ours[:, None] > theirs[None]).mean(axis=(0, 1))
    equal = (ours[:, None] == theirs[None]).mean(axis=(0, 1))
    return float((above + 0.5 * equal).mean())


def performance_profile(scores: Array, thresholds: Array) -> Array:
    """Return the share of runs that score above each threshold."""
    shares: Array = (scores[..., None] > thresholds).mean(axis=(0, 1))
    return shares


def stratified_interval(
    statistic: Callable[..., float], *scores: Array, resamples: int = RESAMPLES
) -> Interval:
    """Return a statistic with its 95 % percentile bootstrap interval.

    Args:
        statistic: a function of the scores.
        *scores: arrays (seeds, tasks) with at least one seed; each is resampled on its own.
        resamples: number of resamples.
    """
    generator = np.random.default_rng(0)  # the same scores give the same interval
    values = [
        statistic(*(_resampled(each, generator) for each in scores)) for _ in range(resamples)
    ]
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    mean = statistic(*scores)
    return Interval(mean, min(float(low), mean), max(float(high), mean))


def profile_band(scores: Array, thresholds: Array) -> tuple[Array, Array]:
    """Return the lower and upper edge of a profile's 95 % bootstrap band."""
    generator = np.random.default_rng(0)
    profiles = np.stack(
        [performance_profile(_resampled(scores, generator), thresholds) for _ in range(RESAMPLES)]
    )
    low, high = np.quantile(profiles, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return low, high


def _resampled(scores: Array, generator: np.random.Generator) -> Array:
    drawn = generator.integers(0, scores.shape[0], size=scores.shape)
    return np.take_along_axis(scores, drawn, axis=0)


def paired_test(ours: Sequence[float], theirs: Sequence[float]) -> tuple[float, float]:
    """Compare the results of equal seeds.

    Returns:
        The mean difference, and the p-value of the two-sided exact permutation test, which swaps
        the two results of a seed. With n seeds it is at least 2 / 2^n: 3 seeds give 0.25 at least.

    Raises:
        ValueError: the lists have different lengths, or fewer than two results.
    """
    if len(ours) != len(theirs) or len(ours) < 2:
        raise ValueError("a paired test needs the results of at least two equal seeds")
    differences = np.asarray(ours, dtype=np.float64) - np.asarray(theirs, dtype=np.float64)
    from scipy import stats

    found = stats.permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        n_resamples=100_000,
        rng=np.random.default_rng(0),
    )
    return float(differences.mean()), float(found.pvalue)
