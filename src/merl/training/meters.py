"""What a run counts about itself: time, rates, and the means of what the learner tells."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from torch import Tensor

from merl.training.loop import Progress


class Averages:
    """Means of the learner's metrics since they were last taken; on the device until then."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._counts: Counter[str] = Counter()

    def add(self, metrics: dict[str, Tensor]) -> None:
        """Add the metrics of one update; not every update has all of them."""
        for name, value in metrics.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._counts.update(metrics.keys())

    def take(self) -> dict[str, float]:
        """The means, and begin anew."""
        means = {f"learn/{name}": float(s) / self._counts[name] for name, s in self._sums.items()}
        self._sums, self._counts = {}, Counter()
        return means


class Clock:
    """Time of training across interruptions, and rates since they were last taken.

    Beside the wall's clock it keeps the processor's, of all threads together: on a machine that is
    shared, the one that can be compared.

    Args:
        seconds: on the wall's clock, when the run was last left.
        cpu_seconds: on the processor's.
    """

    def __init__(self, seconds: float = 0.0, cpu_seconds: float = 0.0) -> None:
        self._before, self._cpu_before = seconds, cpu_seconds
        self._start, self._cpu_start = time.perf_counter(), time.process_time()
        self._mark = (0.0, 0, 0)

    def seconds(self) -> float:
        """Since the run began, time away not counted."""
        return self._before + self.stretch()

    def cpu_seconds(self) -> float:
        """Processor time since the run began."""
        return self._cpu_before + time.process_time() - self._cpu_start

    def stretch(self) -> float:
        """Seconds since the run began or was gone on with."""
        return time.perf_counter() - self._start

    def mark(self, progress: Progress) -> None:
        """Have the next rates count from here."""
        self._mark = (self.stretch(), progress.step, progress.updates)

    def rates(self, progress: Progress) -> dict[str, float]:
        """The time, and steps and updates per second since the last mark; sets a mark."""
        then, steps, updates = self._mark
        self.mark(progress)
        span = max(self.stretch() - then, 1e-9)
        return {
            "time/seconds": self.seconds(),
            "time/cpu_seconds": self.cpu_seconds(),
            "time/steps_per_second": (progress.step - steps) / span,
            "time/updates_per_second": (progress.updates - updates) / span,
        }


class Interval:
    """When to save: at an episode's end, or within one that takes much longer than usual.

    Args:
        seconds: that may lie between two saves.
        now: tells the time, in seconds.
    """

    LEAST = 5.0
    """Seconds: a shorter interval does not make saves within an episode more frequent."""

    def __init__(self, seconds: float, now: Callable[[], float] = time.perf_counter) -> None:
        self._seconds, self._now = seconds, now
        self._saved = self._chance = now()
        self._longest = 0.0  # between two chances
        self._within = False  # the last save was within an episode

    def is_due(self) -> bool:
        """At a chance to save: whether the next one, as far away as the last, would be too late."""
        now = self._now()
        apart, self._chance = now - self._chance, now
        self._longest = max(self._longest, apart)
        # A run resumes exactly only from an episode's end: a save within one is soon replaced.
        return self._within or now + apart - self._saved > self._seconds

    def is_overdue(self) -> bool:
        """Within an episode: whether its end is too late to wait for with the next save."""
        patience = 2 * max(self._seconds, self.LEAST) + 3 * self._longest
        return self._now() - self._saved > patience

    def saved(self, within: bool = False) -> None:
        """Count from here: a save is done, or was tried.

        Args:
            within: it was within an episode.
        """
        self._saved, self._within = self._now(), within
        if not within:
            self._chance = self._saved
