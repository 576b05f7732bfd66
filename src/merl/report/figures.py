"""Pictures of learning, drawn from run folders."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FixedLocator, MaxNLocator, PercentFormatter

from merl.core import CONFIG_FILE, METRICS_FILE, MerlError
from merl.report.curves import (
    Aggregate,
    Array,
    Band,
    Curve,
    aggregate,
    curve_of,
    read_metrics,
)

# Okabe and Ito's palette: told apart by every kind of colour vision. Its yellow is too pale here.
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
SMOOTHED_POINTS = 150  # more training episodes than this are drawn as means of several

Run = Path | str
Reference = Mapping[str, float]


class _Label(NamedTuple):
    """What stands right of a panel, at the height of what it names."""

    text: str
    y: float
    color: str
    weight: str = "normal"


def learning_curve(
    run_dir: Run, output: Path | str, *, references: Reference | None = None
) -> Path:
    """Draw how one run learns: the return, and below it the success, over environment steps.

    Evaluations are drawn with their intervals, training episodes as a thin line behind them. What
    the run has not measured is left out.

    Args:
        run_dir: the run's folder, with `metrics.csv` and perhaps `config.json`.
        output: the picture to make; its suffix says which kind (`.png`, `.svg`, `.pdf`).
        references: label -> return, drawn as horizontal lines, e.g. {"random": 2.1}.

    Returns:
        `output`.

    Raises:
        MerlError: no metrics in `run_dir`, or `output` cannot be written.
    """
    metrics = read_metrics(run_dir)
    success = [name for name in ("eval/success_end", "eval/success_any") if name in metrics]
    figure = _figure(height=5.4 if success else 4.2)
    if success:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1))
        above.tick_params(labelbottom=False)
    else:
        above = below = figure.subplots()

    _style(above, "return per episode")
    labels = {above: _draw_returns(above, metrics, references or {})}
    if success:
        _style(below, "success")
        labels[below] = _draw_success(below, metrics)
    _step_axis(below, metrics["step"])
    if "time/seconds" in metrics:
        _time_axis(above, curve_of(metrics, "time/seconds"))
    _headline(figure, f"{_title(run_dir)}{_what_is_missing(metrics)}")
    for axes, of_axes in labels.items():
        _direct_labels(figure, axes, of_axes)
    return _save(figure, Path(output))


def learning_curves(
    runs: Mapping[str, Sequence[Run | Curve]],
    output: Path | str,
    *,
    x: Literal["steps", "minutes"] = "steps",
    name: str = "eval/return",
    band: Band = "range",
    references: Reference | None = None,
    title: str = "",
) -> Path:
    """Compare what several agents learn: the mean of each one's seeds, its band, and every seed.

    Args:
        runs: label -> its seeds: run folders, CSV files laid out like `metrics.csv`, or `Curve`s
            whose `steps` are already in the unit of x.
        output: the picture to make; its suffix says which kind (`.png`, `.svg`, `.pdf`).
        x: environment steps, or minutes of wall-clock (column `time/seconds`).
        name: the column to draw; a rate of success is drawn in percent.
        band: what surrounds the mean of several seeds.
        references: label -> value in the unit of the column, drawn as horizontal lines.
        title: above the picture.

    Returns:
        `output`.

    Raises:
        MerlError: a file that is missing or malformed, nothing to draw, or an `output` that
            cannot be written.
    """
    seeds = {label: _seeds(label, several, name, x) for label, several in runs.items()}
    if not seeds:
        raise MerlError("no run to draw a learning curve of")
    figure = _figure(height=4.4)
    axes = figure.subplots()
    rate = "success" in name
    _style(axes, _axis_name(name))
    labels = _draw_references(axes, references or {}, rate)
    several_seeds = False
    for i, (label, curves) in enumerate(seeds.items()):
        color, dash = PALETTE[i % len(PALETTE)], DASHES[i // len(PALETTE) % len(DASHES)]
        together = _together(curves, band)
        several_seeds |= together is not None
        last = _draw_seeds(axes, curves, together, color, dash)
        count = f"{len(curves)} seed" + "s" * (len(curves) > 1)
        labels.append(_Label(f"{label} ({count})", last, color, "bold"))

    _value_axis(axes, [label.y for label in labels], rate)
    longest = np.concatenate([one.steps for curves in seeds.values() for one in curves])
    if x == "steps":
        _step_axis(axes, longest)
    else:
        axes.set_xlabel("minutes of wall-clock", color=MUTED)
        axes.set_xlim(0, max(float(longest.max()), 1e-9))
    if title:
        _headline(figure, title)
    if several_seeds:
        around = "the smallest to the largest" if band == "range" else "its 95 % bootstrap interval"
        note = f"bold: mean over the seeds; band: {around}; thin: each seed"
        axes.set_title(note, loc="left", color=MUTED, size=LABEL_SIZE)
    _direct_labels(figure, axes, labels)
    return _save(figure, Path(output))


def _seeds(label: str, runs: Sequence[Run | Curve], name: str, x: str) -> list[Curve]:
    """The curve of each seed; steps, or minutes."""
    curves = []
    for run in runs:
        if isinstance(run, Curve):
            one = run
        else:
            column = "time/seconds" if x == "minutes" else "step"
            one = curve_of(read_metrics(run), name, column)
            if x == "minutes":
                one = Curve(one.steps / 60, one.values)
        if len(one.steps) == 0:
            raise MerlError(f"{label}: no {name} over {x} in {run}")
        curves.append(one)
    if not curves:
        raise MerlError(f"{label}: no run")
    return curves


def _together(curves: Sequence[Curve], band: Band) -> Aggregate | None:
    """The seeds as one; None if there is but one, or if they have no step in common."""
    if len(curves) < 2:
        return None
    try:
        return aggregate(curves, band=band)
    except ValueError:
        return None


def _draw_seeds(
    axes: Axes, curves: Sequence[Curve], together: Aggregate | None, color: str, dash: str
) -> float:
    """Draw the seeds of one label; returns the height at which the label belongs."""
    if together is None:
        for one in curves:
            marker = "o" if len(one.steps) < 3 else ""
            axes.plot(*one, color=color, linestyle=dash, lw=1.6, marker=marker, ms=4)
        return float(curves[-1].values[-1])
    for one in curves:
        axes.plot(*one, color=color, lw=0.7, alpha=0.45)
    axes.fill_between(together.steps, together.low, together.high, color=color, alpha=0.14, lw=0)
    marker = "o" if len(together.steps) == 1 else ""
    axes.plot(together.steps, together.mean, color=color, linestyle=dash, lw=2.2, marker=marker)
    return float(together.mean[-1])


def _draw_returns(axes: Axes, metrics: dict[str, Array], references: Reference) -> list[_Label]:
    labels = _draw_references(axes, references)
    training, per_point = _smooth(curve_of(metrics, "train/return"))
    if len(training.steps):
        axes.plot(*training, color=FAINT, lw=0.9, zorder=1.5)
        text = "training" if per_point == 1 else f"training,\nmeans of {per_point}"
        labels.append(_Label(text, training.values[-1], MUTED))
    evaluation = _draw_with_interval(axes, metrics, "eval/return", BLUE)
    if len(evaluation.steps):
        last = evaluation.values[-1]
        labels.append(_Label(f"evaluation {last:.0f}", last, BLUE, "bold"))
    highs = metrics.get("eval/return_high", np.empty(0))
    _value_axis(axes, [*references.values(), *training.values, *evaluation.values, *highs], False)
    return labels


def _draw_success(axes: Axes, metrics: dict[str, Array]) -> list[_Label]:
    labels = []
    at_any_time = curve_of(metrics, "eval/success_any")
    if len(at_any_time.steps):
        marker = "o" if len(at_any_time.steps) == 1 else ""
        axes.plot(*at_any_time, color=GREEN, lw=1.2, ls=(0, (3, 1.5)), marker=marker, ms=3.5)
        last = at_any_time.values[-1]
        labels.append(_Label(f"at any time {100 * last:.0f} %", last, GREEN))
    at_the_end = _draw_with_interval(axes, metrics, "eval/success_end", GREEN)
    if len(at_the_end.steps):
        last = at_the_end.values[-1]
        labels.append(_Label(f"at the end {100 * last:.0f} %", last, GREEN, "bold"))
    _value_axis(axes, [], True)
    return labels


def _draw_with_interval(axes: Axes, metrics: dict[str, Array], name: str, color: str) -> Curve:
    """Draw a column of evaluations and, where both its ends are known, the interval around it."""
    drawn = curve_of(metrics, name)
    low, high = curve_of(metrics, f"{name}_low"), curve_of(metrics, f"{name}_high")
    if len(drawn.steps) == 0:
        return drawn
    if len(low.steps) > 1 and np.array_equal(low.steps, high.steps):
        axes.fill_between(low.steps, low.values, high.values, color=color, alpha=0.16, lw=0)
    elif len(low.steps) == len(high.steps) == 1:
        axes.vlines(low.steps, low.values, high.values, color=color, alpha=0.5, lw=2)
    marker = "o" if len(drawn.steps) <= 40 else ""
    # not clipped, for the last marker to be whole: it sits on the panel's edge
    axes.plot(*drawn, color=color, lw=2.0, marker=marker, ms=3.5, zorder=3, clip_on=False)
    return drawn


def _draw_references(axes: Axes, references: Reference, rate: bool = False) -> list[_Label]:
    for value in references.values():
        axes.axhline(value, color=MUTED, lw=1.0, ls=(0, (4, 3)), zorder=1.2)
    return [
        _Label(
            f"{label} {_number(100 * value)} %" if rate else f"{label} {_number(value)}",
            value,
            MUTED,
        )
        for label, value in references.items()
    ]


def _number(value: float) -> str:
    """Three digits, and no power of ten for what is next to nothing."""
    return f"{value:.3g}" if abs(value) >= 0.05 else "0"


def _smooth(of: Curve) -> tuple[Curve, int]:
    """A long curve as means over equally many neighbours, and how many; a short one as it is."""
    per_point = -(-len(of.steps) // SMOOTHED_POINTS)
    if per_point <= 1:
        return of, 1
    whole = len(of.steps) // per_point * per_point
    return Curve(*(part[:whole].reshape(-1, per_point).mean(axis=1) for part in of)), per_point


def _figure(height: float) -> Figure:
    figure = Figure(figsize=(7.6, height), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _headline(figure: Figure, text: str) -> None:
    figure.suptitle(text, x=0.012, ha="left", color=INK, size=12, weight="bold")


def _style(axes: Axes, ylabel: str) -> None:
    axes.set_axisbelow(True)
    axes.grid(color=GRID, lw=0.8)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(FAINT)
    axes.tick_params(colors=MUTED, labelsize=LABEL_SIZE, length=0)
    axes.set_ylabel(ylabel, color=MUTED)


def _axis_name(name: str) -> str:
    """`eval/return` -> "evaluation return"."""
    special = {"eval/success_end": "success at the end", "eval/success_any": "success at any time"}
    room, _, what = name.partition("/")
    words = {"eval": "evaluation", "train": "training"}
    return special.get(name, f"{words.get(room, room)} {what.replace('_', ' ')}".strip())


def _value_axis(axes: Axes, values: Sequence[float], rate: bool) -> None:
    """The vertical axis: percent for a rate, else from 0 (or the lowest value) to the highest."""
    if rate:
        axes.set_ylim(-0.03, 1.03)
        axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
        axes.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
        return
    known = [float(v) for v in (*values, axes.dataLim.y0, axes.dataLim.y1) if np.isfinite(v)]
    bottom, top = min([0.0, *known]), max([0.0, *known])
    room = 0.04 * (top - bottom) if top > bottom else 1.0
    axes.set_ylim(bottom - room, top + room)


def _step_axis(axes: Axes, steps: Array) -> None:
    axes.set_xlabel("environment steps", color=MUTED)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10], integer=True))
    axes.set_xlim(0, float(np.max(steps, initial=100.0)))


def _time_axis(axes: Axes, seconds: Curve) -> None:
    """Along the top, the wall-clock time at which a step was reached; steps need not be even."""
    if len(seconds.steps) == 0 or seconds.values.max() <= 0:
        return
    unit, length = ("minutes", 60) if seconds.values.max() < 5 * 3600 else ("hours", 3600)
    passed = np.maximum.accumulate(seconds.values) / length
    reached = np.concatenate([[0.0], passed]), np.concatenate([[0.0], seconds.steps])
    ticks = np.asarray(MaxNLocator(7, steps=[1, 2, 5, 10]).tick_values(0, passed[-1]))
    apart = 0.05 * axes.get_xlim()[1]  # steps; during a slow start the ticks would overlap
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


def _direct_labels(figure: Figure, axes: Axes, labels: Sequence[_Label]) -> None:
    """Write labels right of a panel at the height of what they name, moved apart where needed."""
    if not labels:
        return
    figure.draw_without_rendering()  # the layout, for the height of the panel
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
    """Centres for boxes of these heights, near the wanted ones, in their order, without overlap.

    Boxes that touch are joined to a block about the mean of what they want, until none does.
    """
    order = np.argsort(wanted, kind="stable")
    blocks: list[tuple[float, float, list[int]]] = []  # (centre, height, boxes from below)
    for i in order:
        centre, height, boxes = float(wanted[i]), heights[i], [int(i)]
        while blocks and blocks[-1][0] + blocks[-1][1] / 2 > centre - height / 2:
            below, its_height, its_boxes = blocks.pop()
            count = len(boxes) + len(its_boxes)
            centre = (centre * len(boxes) + below * len(its_boxes)) / count
            height, boxes = height + its_height, its_boxes + boxes
        blocks.append((centre, height, boxes))
    centres = [0.0] * len(wanted)
    for centre, height, boxes in blocks:
        edge = centre - height / 2
        for i in boxes:
            centres[i] = edge + heights[i] / 2
            edge += heights[i]
    return centres


def _title(run_dir: Run) -> str:
    """Task, preset and seed from the run's `config.json`, as far as it tells them."""
    path = Path(run_dir)
    try:
        config: Any = json.loads((path / CONFIG_FILE).read_text())
    except (OSError, ValueError):
        config = {}
    config = config if isinstance(config, dict) else {}
    parts = [str(config[key]) for key in ("task", "preset") if config.get(key)]
    if config.get("seed") is not None:
        parts.append(f"seed {config['seed']}")
    name = path.parent if path.name == METRICS_FILE else path
    return " · ".join(parts) or name.resolve().name


def _what_is_missing(metrics: dict[str, Array]) -> str:
    if len(curve_of(metrics, "eval/return").steps):
        return ""
    trained = len(curve_of(metrics, "train/return").steps) > 0
    return " (no evaluation yet)" if trained else " (no episode has ended yet)"


def _save(figure: Figure, output: Path) -> Path:
    """Write the picture to a temporary name first, so that none is ever half there."""
    part = output.with_name(f".{output.stem}.part{output.suffix}")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(part)
        part.replace(output)
    except (OSError, ValueError) as error:  # ValueError: a suffix that matplotlib does not know
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise MerlError(f"the picture {output} cannot be written: {error}") from None
    return output
