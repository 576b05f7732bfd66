"""Meters of a run: time, rates, means of the learner's metrics, and the schedule of saves."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from torch import Tensor

from merl.config import TrainConfig
from merl.training.loop import Progress, StepResult

LONG = 2000
"""Steps per environment without the end of an episode after which the user is warned; the limit is
half of the run's steps if these are fewer."""


class Averages:
    """Means of the learner's metrics since the last `take`; the sums stay on the device."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._counts: Counter[str] = Counter()

    def add(self, metrics: dict[str, Tensor]) -> None:
        """Add the metrics of one update, which may be only some of all metrics."""
        for name, value in metrics.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._counts.update(metrics.keys())

    def take(self) -> dict[str, float]:
        """Return the means on the host, and reset them."""
        means = {f"learn/{name}": float(s) / self._counts[name] for name, s in self._sums.items()}
        self._sums, self._counts = {}, Counter()
        return means


class Clock:
    """Training time of a run, without interruptions, and rates since the last mark.

    The clock counts wall-clock time and the processor time of all threads. On a shared machine,
    only processor times are comparable.
    """

    def __init__(self) -> None:
        self.restore(0.0, 0.0)
        self._mark = (0.0, 0, 0)

    def restore(self, seconds: float, cpu_seconds: float) -> None:
        """Restore wall-clock and processor time from a checkpoint, in seconds."""
        self._before, self._cpu_before = seconds, cpu_seconds
        self._start, self._cpu_start = time.perf_counter(), time.process_time()

    def seconds(self) -> float:
        """Return the wall-clock time of training in seconds, without interruptions."""
        return self._before + self.seconds_since_start()

    def cpu_seconds(self) -> float:
        """Return the processor time of training in seconds, of all threads."""
        return self._cpu_before + time.process_time() - self._cpu_start

    def seconds_since_start(self) -> float:
        """Return the wall-clock seconds since start or resume."""
        return time.perf_counter() - self._start

    def mark(self, progress: Progress) -> None:
        """Start to measure the next rates."""
        self._mark = (self.seconds_since_start(), progress.step, progress.updates)

    def rates(self, progress: Progress) -> dict[str, float]:
        """Return the time, and steps and updates per second since the last mark; set a mark."""
        start, steps, updates = self._mark
        self.mark(progress)
        span = max(self.seconds_since_start() - start, 1e-9)
        return {
            "time/seconds": self.seconds(),
            "time/cpu_seconds": self.cpu_seconds(),
            "time/steps_per_second": (progress.step - steps) / span,
            "time/updates_per_second": (progress.updates - updates) / span,
        }


class Interval:
    """Schedule of saves: at the end of an episode, or within one that takes much longer than usual.

    Args:
        seconds: maximum time between two saves.
        now: returns the time in seconds.
    """

    LEAST = 5.0
    """Lower bound, in seconds, of the interval that is used for saves within an episode."""

    def __init__(self, seconds: float, now: Callable[[], float] = time.perf_counter) -> None:
        self._seconds, self._now = seconds, now
        self._saved = self._episode_end = now()
        self._longest = 0.0  # time between two ends of episodes
        self._within = False  # the last save was within an episode

    def is_due(self) -> bool:
        """Return, at the end of an episode, whether a save at the next end would be too late."""
        now = self._now()
        apart, self._episode_end = now - self._episode_end, now
        self._longest = max(self._longest, apart)
        # A run resumes exactly only from the end of an episode: soon replace a save within one.
        return self._within or now + apart - self._saved > self._seconds

    def is_overdue(self) -> bool:
        """Return, within an episode, whether a save at its end would be too late."""
        limit = 2 * max(self._seconds, self.LEAST) + 3 * self._longest
        return self._now() - self._saved > limit

    def saved(self, within: bool = False) -> None:
        """Restart the interval after a save, or after an attempt to save.

        Args:
            within: whether the save was within an episode.
        """
        self._saved, self._within = self._now(), within
        if not within:
            self._episode_end = self._saved


class EpisodeWatch:
    """Watch whether episodes end, since metrics and evaluations wait for that.

    Args:
        config: the run's config.
        step: the step from which on episodes begin.
    """

    def __init__(self, config: TrainConfig, step: int) -> None:
        self._most = min(LONG * config.num_envs, max(1, config.steps // 2))
        self._end: int | None = step  # of the last episode; None once the user is warned

    def note(self, result: StepResult) -> str | None:
        """Return, once, a warning if no episode has ended for a long time."""
        if result.episodes:
            self._end = result.step
        elif self._end is not None and result.step - self._end > self._most:
            self._end = None
            return (
                f"no episode has ended in {self._most:,} steps, and nothing is logged or evaluated "
                "until one ends: if episodes have no end, wrap the environment in "
                "gymnasium.wrappers.TimeLimit"
            )
        return None
