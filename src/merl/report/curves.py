"""The curves of a run, read from its `metrics.csv`, and those of several seeds put together."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from merl.core import METRICS_FILE, MerlError
from merl.core.statistics import bootstrap_interval

Array = NDArray[np.float64]
Band = Literal["range", "bootstrap"]
"""Around the mean of several seeds: the smallest to the largest, or the mean's 95 % bootstrap."""


class Curve(NamedTuple):
    """One measured line.

    Attributes:
        steps: where it was measured, ascending, (N,); environment steps, or what else x is.
        values: what was measured there, (N,), without NaN.
    """

    steps: Array
    values: Array


class Aggregate(NamedTuple):
    """Several seeds on one grid.

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
    """Every column of a run's metrics.

    A last line without its line end is left out: the run is writing it, or was killed doing so.

    Args:
        run: a run's folder, or a CSV file laid out like its `metrics.csv`.

    Returns:
        name -> (N,) float64, in the order of the file, NaN where a row has no such number; `step`
        is always there, N may be 0.

    Raises:
        MerlError: no such file, or not a file of metrics.
    """
    path = Path(run)
    path = path / METRICS_FILE if path.is_dir() else path
    try:
        text = path.read_bytes()
    except OSError as error:
        raise MerlError(f"no metrics in {path}: {error.strerror}") from None
    try:
        whole = text[: text.rfind(b"\n") + 1].decode()
        columns, *lines = [*csv.reader(whole.splitlines(), strict=True)] or [["step"]]
        rows = [[float(cell) if cell else np.nan for cell in line] for line in lines]
        # reshape, for rows of unequal length to fail and for no rows to have columns
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
    except (ValueError, csv.Error) as error:
        raise MerlError(f"{path} is not a file of metrics: {error}") from None
    if columns[0] != "step":
        raise MerlError(f"{path} is not a file of metrics: its first column is not 'step'")
    return {name: table[:, i] for i, name in enumerate(columns)}


def curve(run: Path | str, name: str, x: str = "step") -> Curve:
    """One column of a run against another, without the rows that lack either.

    Args:
        run: as for `read_metrics`.
        name: the column, e.g. `eval/return`.
        x: the column that it is drawn over, e.g. `time/seconds`.

    Returns:
        The curve, ascending in x; empty if the run has no such columns yet.

    Raises:
        MerlError: as `read_metrics`.
    """
    return curve_of(read_metrics(run), name, x)


def curve_of(metrics: dict[str, Array], name: str, x: str = "step") -> Curve:
    """As `curve`, of metrics that have been read already."""
    empty = np.full(len(metrics["step"]), np.nan)
    steps, values = metrics.get(x, empty), metrics.get(name, empty)
    there = ~np.isnan(steps) & ~np.isnan(values)
    order = np.argsort(steps[there], kind="stable")
    return Curve(steps[there][order], values[there][order])


def aggregate(
    curves: Sequence[Curve], grid: Array | None = None, band: Band = "range"
) -> Aggregate:
    """Put the curves of several seeds together.

    Args:
        curves: one a seed, none of them empty. Between its points a curve is a straight line.
        grid: where to compare them, ascending, (G,). None: every step of any seed from where the
            last seed begins to where the first one ends.
        band: what surrounds the mean; of one seed it has no width.

    Raises:
        ValueError: no curve, an empty one, or no step that all of them reach.
    """
    if not curves or any(len(one.steps) == 0 for one in curves):
        raise ValueError("seeds can be put together when each has a point")
    begin = max(one.steps[0] for one in curves)
    end = min(one.steps[-1] for one in curves)
    if grid is None:
        grid = np.unique(np.concatenate([one.steps for one in curves]))
    steps = np.asarray(grid, dtype=np.float64)
    steps = steps[(begin <= steps) & (steps <= end)]
    if len(steps) == 0:
        raise ValueError("these seeds have no step in common")
    values = np.stack([np.interp(steps, one.steps, one.values) for one in curves])  # (S, G)
    mean = values.mean(axis=0)
    if band == "range":
        return Aggregate(steps, values, mean, values.min(axis=0), values.max(axis=0))
    intervals = [bootstrap_interval(column) for column in values.T]
    low = np.array([interval.low for interval in intervals])
    high = np.array([interval.high for interval in intervals])
    return Aggregate(steps, values, mean, low, high)
