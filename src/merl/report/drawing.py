"""Style of the figures: size, colours, axes, and labels beside the curves that they name."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import EngFormatter, FixedLocator, MaxNLocator, PercentFormatter

from merl.core import MerlError
from merl.report.curves import Array, Curve

# Okabe and Ito's palette, for every kind of colour vision, without its yellow, which is too pale.
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
)
PALETTE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
DASHES = ("-", "--", "-.", ":")  # for more labels than colours
INK, MUTED, FAINT, GRID = "#222222", "#6B7280", "#B4BBC5", "#E8EBEF"
DPI = 160
LABEL_SIZE = 9.0  # points


class Label(NamedTuple):
    """Text right of a panel, at the height of the line that it names."""

    text: str
    y: float
    color: str
    weight: str = "normal"


def new_figure(height: float) -> Figure:
    """Return an empty figure, 7.6 inches wide and `height` inches high."""
    figure = Figure(figsize=(7.6, height), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def headline(figure: Figure, text: str) -> None:
    """Write a title above all panels."""
    figure.suptitle(text, x=0.012, ha="left", color=INK, size=12, weight="bold")


def style(axes: Axes, ylabel: str) -> None:
    """Give a panel a light grid and no frame."""
    axes.set_axisbelow(True)
    axes.grid(color=GRID, lw=0.8)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT)
    axes.tick_params(colors=MUTED, labelsize=LABEL_SIZE, length=0)
    axes.set_ylabel(ylabel, color=MUTED)


def value_axis(axes: Axes, values: Sequence[float], rate: bool) -> None:
    """Scale the y axis: percent for a rate, else from 0, or the lowest value, to the highest."""
    if rate:
        axes.set_ylim(-0.03, 1.03)
        axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
        axes.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
        return
    known = [float(v) for v in (*values, axes.dataLim.y0, axes.dataLim.y1) if np.isfinite(v)]
    bottom, top = min([0.0, *known]), max([0.0, *known])
    room = 0.04 * (top - bottom) if top > bottom else 1.0
    axes.set_ylim(bottom - room, top + room)


def step_axis(axes: Axes, steps: Array) -> None:
    """Scale the x axis: environment steps, from 0 to the last."""
    axes.set_xlabel("environment steps", color=MUTED)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10], integer=True))
    axes.set_xlim(0, float(np.max(steps, initial=100.0)))


def time_axis(axes: Axes, seconds: Curve) -> None:
    """Draw a second x axis on top: wall-clock time at each step; the speed may vary."""
    if len(seconds.steps) == 0 or seconds.values.max() <= 0:
        return
    unit, length = ("minutes", 60) if seconds.values.max() < 5 * 3600 else ("hours", 3600)
    passed = np.maximum.accumulate(seconds.values) / length
    reached = np.concatenate([[0.0], passed]), np.concatenate([[0.0], seconds.steps])
    ticks = np.asarray(MaxNLocator(7, steps=[1, 2, 5, 10]).tick_values(0, passed[-1]))
    apart = 0.05 * axes.get_xlim()[1]  # in steps; keeps ticks of a slow start from overlapping
    shown: list[tuple[float, float]] = []  # (step, time)
    for tick in ticks[(ticks >= 0) & (ticks <= passed[-1])]:
        step = float(np.interp(tick, *reached))
        if not shown or step - shown[-1][0] >= apart:
            shown.append((step, tick))
    top = axes.secondary_xaxis("top")
    top.xaxis.set_major_locator(FixedLocator([step for step, _ in shown]))
    top.set_xticklabels([f"{tick:g}" for _, tick in shown])
    top.spines["top"].set_visible(False)
    top.tick_params(colors=MUTED, labelsize=LABEL_SIZE, length=0)
    top.set_xlabel(f"{unit} of wall-clock", color=MUTED)


def direct_labels(figure: Figure, labels: Mapping[Axes, Sequence[Label]]) -> None:
    """Write labels right of each panel at their heights; move them apart where they overlap.

    The panels' heights are those before the layout, which takes longer than all else here and
    changes them by a few percent.
    """
    for axes, of_axes in labels.items():
        _label_panel(figure, axes, of_axes)


def _label_panel(figure: Figure, axes: Axes, labels: Sequence[Label]) -> None:
    points = axes.get_window_extent().height * 72 / figure.dpi
    heights = [LABEL_SIZE * 1.35 * (1 + label.text.count("\n")) / points for label in labels]
    bottom, top = axes.get_ylim()
    wanted = [(label.y - bottom) / (top - bottom) for label in labels]
    for label, y in zip(labels, _spread(wanted, heights), strict=True):
        axes.annotate(
            label.text,
            (1, y),
            xycoords="axes fraction",
            xytext=(7, 0),
            textcoords="offset points",
            va="center",
            color=label.color,
            weight=label.weight,
            size=LABEL_SIZE,
            annotation_clip=False,
        )


def _spread(wanted: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Return centres for boxes that do not overlap, in the order of the wanted centres.

    Boxes that would overlap are joined to a block around the mean of their wanted centres, until no
    blocks overlap.

    Args:
        wanted: the wanted centre of each box.
        heights: the height of each box.
    """
    order = np.argsort(wanted, kind="stable")
    blocks: list[tuple[float, float, list[int]]] = []  # (centre, height, boxes from below)
    for i in order:
        centre, height, boxes = float(wanted[i]), heights[i], [int(i)]
        while blocks and blocks[-1][0] + blocks[-1][1] / 2 > centre - height / 2:
            below, below_height, below_boxes = blocks.pop()
            count = len(boxes) + len(below_boxes)
            centre = (centre * len(boxes) + below * len(below_boxes)) / count
            height, boxes = height + below_height, below_boxes + boxes
        blocks.append((centre, height, boxes))
    centres = [0.0] * len(wanted)
    for centre, height, boxes in blocks:
        edge = centre - height / 2
        for i in boxes:
            centres[i] = edge + heights[i] / 2
            edge += heights[i]
    return centres


def number(value: float) -> str:
    """Format a value with three digits; values below 0.05 as "0"."""
    return f"{value:.3g}" if abs(value) >= 0.05 else "0"


def save(figure: Figure, output: Path) -> Path:
    """Save a figure; write a temporary file first, so that `output` is never incomplete.

    Returns:
        `output`.

    Raises:
        MerlError: the file cannot be written, or its suffix is unknown.
    """
    part = output.with_name(f".{output.stem}.part{output.suffix}")
    # In SVG, text stays text, and the same figure gives the same file.
    options: Any = {"svg.fonttype": "none", "svg.hashsalt": output.stem}
    metadata = {"Date": None} if output.suffix == ".svg" else None
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with rc_context(options), warnings.catch_warnings():
            # A name may have a letter that the font lacks; it is drawn as a box.
            warnings.filterwarnings("ignore", "Glyph")
            for text in figure.findobj(Text):
                text.set_parse_math(False)  # a `$` in a name is a `$`
            figure.savefig(part, metadata=metadata)
        part.replace(output)
    except (OSError, ValueError) as error:  # ValueError: a suffix that matplotlib does not know
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise MerlError(f"the figure {output} cannot be written: {error}") from None
    return output
