"""Table and figure of a policy under disturbances, from the rows of `merl robustness`."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from matplotlib.ticker import PercentFormatter

from merl.core.files import reporting
from merl.core.statistics import Interval
from merl.report.drawing import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    VERMILION,
    headline,
    new_figure,
    save,
    style,
)

COLOURS = {"none": INK, "camera": BLUE, "joints": VERMILION, "actions": GREEN, "scene": ORANGE}
"""Colour of each disturbed sense."""


@dataclass(frozen=True)
class Row:
    """A policy under one disturbance; intervals are 95 % over episodes.

    Attributes:
        sense: what is disturbed.
        disturbance: name of the disturbance.
        episodes: number of episodes.
        result: mean return, or success rate at the end.
        low, high: its interval.
        reports_success: whether `result` is a success rate.
    """

    sense: str
    disturbance: str
    episodes: int
    result: float
    low: float
    high: float
    reports_success: bool

    @classmethod
    def of(
        cls, sense: str, name: str, episodes: int, returns: Interval, success: Interval | None
    ) -> Row:
        """Make a row from an evaluation's intervals."""
        shown = returns if success is None else success
        return cls(sense, name, episodes, shown.mean, shown.low, shown.high, success is not None)

    @property
    def text(self) -> str:
        """The result with its interval."""
        form = ".0%" if self.reports_success else ".4g"
        return f"{self.result:{form}} [{self.low:{form}}, {self.high:{form}}]"


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write the rows to a CSV file.

    Raises:
        MerlError: the file cannot be written.
    """
    with reporting(f"{path} cannot be written"), path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def draw_rows(rows: Sequence[Row], title: str, output: Path) -> Path:
    """Draw the rows as points with intervals; the undisturbed result is a band.

    Raises:
        MerlError: the figure cannot be written.
    """
    figure = new_figure(1.2 + 0.24 * len(rows))
    axes = figure.subplots()
    style(axes, "")
    first = rows[0]
    axes.axvspan(first.low, first.high, color=INK, alpha=0.08, lw=0)
    for place, row in enumerate(rows):
        colour = COLOURS[row.sense]
        axes.plot([row.low, row.high], [place, place], color=colour, lw=2, solid_capstyle="round")
        axes.plot(row.result, place, "o", color=colour, ms=5)
    names = [
        row.disturbance if row.sense == "none" else f"{row.sense}: {row.disturbance}"
        for row in rows
    ]
    axes.set_yticks(range(len(rows)), names)
    axes.invert_yaxis()
    if first.reports_success:
        axes.set_xlim(-0.03, 1.03)
        axes.xaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    what = "success at the end" if first.reports_success else "return"
    axes.set_xlabel(f"{what}, {first.episodes} episodes, 95 % intervals", color=MUTED)
    headline(figure, title)
    return save(figure, output)
