"""Read curves from the `metrics.csv` of a run, and aggregate the curves of several seeds."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from merl.core import METRICS_FILE, MerlError
from merl.core.files import read_file
from merl.core.statistics import bootstrap_interval

Array = NDArray[np.float64]
Band = Literal["range", "bootstrap"]
"""Band around the mean of the seeds: minimum to maximum, or the mean's 95 % bootstrap interval."""


class Curve(NamedTuple):
    """One measured line.

    Attributes:
        steps: x, ascending, (N,); environment steps or another unit.
        values: y, (N,), without NaN.
    """

    steps: Array
    values: Array


class Aggregate(NamedTuple):
    """Curves of several seeds on one grid.

    Attributes:
        steps: the grid, (G,); it ends where the shortest seed ends.
        values: every seed on the grid, (S, G).
        mean: over the seeds, (G,).
        low: lower edge of the band, (G,).
        high: upper edge of the band, (G,).
    """

    steps: Array
    values: Array
    mean: Array
    low: Array
    high: Array


def read_metrics(run: Path | str) -> dict[str, Array]:
    """Return all columns of a run's metrics.

    A last line without a line end is skipped: the run is still writing it, or was killed while it
    wrote it.

    Args:
        run: a run folder, or a CSV file with the layout of `metrics.csv`.

    Returns:
        {name: (N,) float64}, in the order of the file, NaN for empty cells; it always has `step`,
        N may be 0.

    Raises:
        MerlError: the file is missing, or it is not a file of metrics.
    """
    path = Path(run)
    path = path / METRICS_FILE if path.is_dir() else path
    try:
        text = read_file(path)
    except OSError as error:
        raise MerlError(f"no metrics in {path}: {error.strerror}") from None
    try:
        whole = text[: text.rfind(b"\n") + 1].decode()
        columns, *lines = [*csv.reader(whole.splitlines(), strict=True)] or [["step"]]
        rows = [[float(cell) if cell else np.nan for cell in line] for line in lines]
        # reshape rejects rows of unequal length, and gives an empty table its columns
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    except (ValueError, csv.Error) as error:
        raise MerlError(f"{path} is not a file of metrics: {error}") from None
    if columns[0] != "step":
        raise MerlError(f"{path} is not a file of metrics: its first column is not 'step'")
    return {name: table[:, i] for i, name in enumerate(columns)}


def curve_of(metrics: dict[str, Array], name: str, x: str = "step") -> Curve:
    """Return one column of a run over another, without rows in which either is empty.

    Args:
        metrics: see `read_metrics`.
        name: the column for y, e.g. `eval/return`.
        x: the column for x, e.g. `time/seconds`.

    Returns:
        The curve, ascending in x; empty if the run does not have these columns yet.
    """
    empty = np.full(len(metrics["step"]), np.nan)
    steps, values = metrics.get(x, empty), metrics.get(name, empty)
    known = ~np.isnan(steps) & ~np.isnan(values)
    order = np.argsort(steps[known], kind="stable")
    return Curve(steps[known][order], values[known][order])


def aggregate(curves: Sequence[Curve], band: Band = "range") -> Aggregate:
    """Aggregate the curves of several seeds: at all their steps in the range that all cover.

    Args:
        curves: one curve per seed, none of them empty; interpolated linearly between their points.
        band: kind of the band around the mean; for one seed it has no width.

    Raises:
        ValueError: no curve, an empty curve, or no step in the range that all curves cover.
    """
    if not curves or any(len(one.steps) == 0 for one in curves):
        raise ValueError("to aggregate seeds, give at least one curve, and none without points")
    begin = max(one.steps[0] for one in curves)
    end = min(one.steps[-1] for one in curves)
    steps = np.unique(np.concatenate([one.steps for one in curves]))
    steps = steps[(begin <= steps) & (steps <= end)]
    if len(steps) == 0:
        raise ValueError("the curves of these seeds have no step in common")
    values = np.stack([np.interp(steps, one.steps, one.values) for one in curves])  # (S, G)
    mean = values.mean(axis=0)
    if band == "range":
        return Aggregate(steps, values, mean, values.min(axis=0), values.max(axis=0))
    intervals = [bootstrap_interval(column) for column in values.T]
    low = np.array([interval.low for interval in intervals])
    high = np.array([interval.high for interval in intervals])
    return Aggregate(steps, values, mean, low, high)
