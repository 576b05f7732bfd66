"""The numbers of a report: each group's results with intervals, and comparisons between groups."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from merl.core.files import reporting
from merl.core.statistics import Interval, bootstrap_interval
from merl.report.aggregates import (
    Array,
    interquartile_mean,
    optimality_gap,
    paired_test,
    probability_of_improvement,
    stratified_interval,
)
from merl.report.collect import RETURN, SUCCESS, Group, SeedRun
from merl.report.references import EXPERT, RANDOM

SECONDS = "time/seconds"
LEVELS = (0.5, 0.8)
"""Success rates whose time is reported."""


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds.

    Attributes:
        mean: the mean; NaN if no seed has a value.
        low, high: its 95 % bootstrap interval over seeds; NaN for fewer than two seeds.
        count: number of seeds that have a value.
        seeds: number of seeds.
    """

    mean: float
    low: float
    high: float
    count: int
    seeds: int

    @classmethod
    def of(cls, values: Sequence[float], seeds: int | None = None) -> Estimate:
        """Estimate the mean of values, one for each seed that has one."""
        count, total = len(values), len(values) if seeds is None else seeds
        if count < 2:
            return cls(values[0] if values else math.nan, math.nan, math.nan, count, total)
        interval = bootstrap_interval(values)
        if count < total:  # an interval of those that arrived would be too good
            return cls(interval.mean, math.nan, math.nan, count, total)
        return cls(*interval, count, total)

    def text(self, form: str = ".3g", scale: float = 1.0) -> str:
        """Return the mean with its interval, e.g. "81 [76, 88]"; or how many seeds have none."""
        if self.count == 0:
            return "never" if self.seeds else ""
        shown = f"{self.mean * scale:{form}}"
        if not math.isnan(self.low):
            shown += f" [{self.low * scale:{form}}, {self.high * scale:{form}}]"
        return (
            shown if self.count == self.seeds else f"{shown} ({self.count} of {self.seeds} seeds)"
        )


@dataclass(frozen=True)
class Row:
    """Results of a group.

    Attributes:
        group: the group.
        steps: environment steps at which its shortest seed ends.
        minutes: wall-clock time of its runs.
        results: {name: estimate over its seeds}.
        spread: standard deviation of the final return over seeds; NaN for one seed.
    """

    group: Group
    steps: int
    minutes: Estimate
    results: dict[str, Estimate]
    spread: float


def row_of(group: Group) -> Row:
    """Compute the results of a group."""
    runs, seeds = group.runs, len(group.runs)
    curves = [run.curve(RETURN) for run in runs]
    end = min(float(run.last_step) for run in runs)
    results = {"final return": Estimate.of(group.final(RETURN), seeds)}
    if all(len(curve.steps) for curve in curves):
        end = min(float(curve.steps[-1]) for curve in curves)
        results["best return"] = Estimate.of([float(curve.values.max()) for curve in curves])
        results["mean return"] = Estimate.of([_area(run, end) for run in runs])
    success = group.final(SUCCESS)
    if success:
        results["final success"] = Estimate.of(success, seeds)
        best = [float(run.curve(SUCCESS).values.max(initial=0.0)) for run in runs]
        results["best success"] = Estimate.of(best)
        for level in LEVELS:
            reached = [first for run in runs if (first := _first(run, level)) is not None]
            name = f"{level:.0%} success"
            results[f"steps to {name}"] = Estimate.of([steps for steps, _ in reached], seeds)
            times = [minutes for _, minutes in reached if not math.isnan(minutes)]
            if len(times) == len(reached):  # else the run has no clock
                results[f"minutes to {name}"] = Estimate.of(times, seeds)
    minutes = Estimate.of(
        [float(at[-1]) / 60 for run in runs if len(at := run.curve(RETURN, SECONDS).steps)]
    )
    finals = group.final(RETURN)
    spread = float(np.std(finals, ddof=1)) if len(finals) > 1 else math.nan
    return Row(group, int(end), minutes, results, spread)


def _area(run: SeedRun, end: float) -> float:
    """Return the mean return over the steps up to `end`."""
    curve = run.curve(RETURN)
    steps = np.append(curve.steps[curve.steps < end], end)
    values = np.interp(steps, curve.steps, curve.values)
    if len(steps) == 1:
        return float(values[0])
    return float(np.trapezoid(values, steps) / (steps[-1] - steps[0]))


def _first(run: SeedRun, level: float) -> tuple[float, float] | None:
    """Return steps and minutes of the first evaluation with at least this success; None if none."""
    success = run.curve(SUCCESS)
    reached = np.flatnonzero(success.values >= level)
    if len(reached) == 0:
        return None
    step = float(success.steps[reached[0]])
    times = run.curve(SUCCESS, SECONDS)
    at = float(times.steps[reached[0]]) / 60 if len(times.steps) == len(success.steps) else math.nan
    return step, at


@dataclass(frozen=True)
class Comparison:
    """A group against the first one of its task.

    Attributes:
        ours: the first group's label.
        theirs: the other group's label.
        task: the task.
        better: probability that a run of ours has the higher final return; its ends are NaN for
            fewer than two seeds on a side.
        difference: mean difference of the final return over equal seeds; NaN for fewer than two.
        p: p-value of the paired permutation test; NaN for fewer than two equal seeds.
        pairs: number of equal seeds.
    """

    ours: str
    theirs: str
    task: str
    better: Interval
    difference: float
    p: float
    pairs: int


def comparisons(groups: Sequence[Group]) -> list[Comparison]:
    """Compare the first group of each task with its other groups."""
    found = []
    for task in dict.fromkeys(group.task for group in groups):
        first, *others = (group for group in groups if group.task == task)
        for other in others:
            ours, theirs = (_column(group.final(RETURN)) for group in (first, other))
            if not (len(ours) and len(theirs)):
                continue
            if min(len(ours), len(theirs)) > 1:
                better = stratified_interval(probability_of_improvement, ours, theirs)
            else:
                better = Interval(probability_of_improvement(ours, theirs), math.nan, math.nan)
            pairs = [*_pairs(first, other)]
            difference, p = (
                paired_test(*zip(*pairs, strict=True)) if len(pairs) > 1 else (math.nan,) * 2
            )
            found.append(
                Comparison(first.label, other.label, task, better, difference, p, len(pairs))
            )
    return found


def _pairs(first: Group, other: Group) -> Iterator[tuple[float, float]]:
    by_seed = {run.seed: run.final(RETURN) for run in other.runs}
    for run in first.runs:
        if run.seed is None:
            continue
        pair = run.final(RETURN), by_seed.get(run.seed, math.nan)
        if not any(map(math.isnan, pair)):
            yield pair


def _column(values: Sequence[float]) -> Array:
    return np.array(values, dtype=np.float64)[:, None]


@dataclass(frozen=True)
class Overall:
    """A variant over all tasks, with scores of 0 for random actions and 1 for the expert.

    Attributes:
        label: the variant.
        scores: (seeds, tasks).
        mean, interquartile_mean, gap: with 95 % stratified bootstrap intervals.
    """

    label: str
    scores: Array
    mean: Interval
    interquartile_mean: Interval
    gap: Interval


def overall(groups: Sequence[Group]) -> list[Overall]:
    """Summarise each variant that has at least two seeds of every task; the others are left out.

    Empty if a task has no references.
    """
    tasks = [*dict.fromkeys(group.task for group in groups)]
    scale = {group.task: _scale(group.runs[0]) for group in groups}
    found = []
    for label in dict.fromkeys(group.label for group in groups):
        its = {group.task: group.final(RETURN) for group in groups if group.label == label}
        seeds = min((len(its.get(task, [])) for task in tasks), default=0)
        if seeds < 2 or any(value is None for value in scale.values()):
            continue
        columns = []
        for task in tasks:
            low, high = scale[task] or (0.0, 1.0)
            columns.append((np.array(its[task][:seeds]) - low) / (high - low))
        scores = np.stack(columns, axis=1)
        found.append(
            Overall(
                label,
                scores,
                *(
                    stratified_interval(statistic, scores)
                    for statistic in (
                        lambda each: float(np.mean(each)),
                        interquartile_mean,
                        optimality_gap,
                    )
                ),
            )
        )
    return found


def _scale(run: SeedRun) -> tuple[float, float] | None:
    """Return the returns of random actions and of the expert; None if they are not known."""
    known = run.references
    return (known[RANDOM], known[EXPERT]) if {RANDOM, EXPERT} <= {*known} else None


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write the results as a CSV file: mean and interval of each, empty where there is none.

    Raises:
        MerlError: the file cannot be written.
    """
    names = [*dict.fromkeys(name for row in rows for name in row.results)]
    ends = [f"{name}{end}" for name in names for end in ("", " low", " high", " seeds")]
    with reporting(f"{path} cannot be written"), path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "variant", "seeds", "steps", "minutes", "spread", *ends])
        for row in rows:
            cells: list[object] = [row.group.task, row.group.label]
            cells += [len(row.group.runs), row.steps, row.minutes.mean, row.spread]
            for name in names:
                one = row.results.get(name)
                cells += (
                    ["", "", "", 0] if one is None else [one.mean, one.low, one.high, one.count]
                )
            writer.writerow("" if cell != cell else cell for cell in cells)  # NaN
