"""Figures of learning curves, drawn from run folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes

from merl.core import CONFIG_FILE, METRICS_FILE, MerlError
from merl.core.files import read_json
from merl.report.curves import (
    Aggregate,
    Array,
    Band,
    Curve,
    aggregate,
    curve_of,
    read_metrics,
)
from merl.report.drawing import (
    BLUE,
    DASHES,
    FAINT,
    GREEN,
    LABEL_SIZE,
    MUTED,
    PALETTE,
    Label,
    direct_labels,
    headline,
    new_figure,
    number,
    save,
    step_axis,
    style,
    time_axis,
    value_axis,
)

SMOOTHED_POINTS = 150  # a longer curve is drawn as means of several episodes

Run = Path | str
Reference = Mapping[str, float]


def learning_curve(
    run_dir: Run, output: Path | str, *, references: Reference | None = None
) -> Path:
    """Draw the learning curve of one run: return, and below it success, over environment steps.

    Evaluations are drawn with their intervals, training episodes as a thin line behind them.
    Columns that the run does not have are skipped.

    Args:
        run_dir: the run's folder, with `metrics.csv` and, optionally, `config.json`.
        output: the figure's file; its suffix sets the format (`.png`, `.svg`, `.pdf`).
        references: {label: return}, drawn as horizontal lines, e.g. {"random": 2.1}.

    Returns:
        `output`.

    Raises:
        MerlError: `run_dir` has no metrics, or `output` cannot be written.
    """
    metrics = read_metrics(run_dir)
    success = [name for name in ("eval/success_end", "eval/success_any") if name in metrics]
    figure = new_figure(height=5.4 if success else 4.2)
    if success:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1))
        above.tick_params(labelbottom=False)
    else:
        above = below = figure.subplots()

    style(above, "return per episode")
    labels = {above: _draw_returns(above, metrics, references or {})}
    if success:
        style(below, "success")
        labels[below] = _draw_success(below, metrics)
    step_axis(below, metrics["step"])
    if "time/seconds" in metrics:
        time_axis(above, curve_of(metrics, "time/seconds"))
    headline(figure, f"{_title(run_dir)}{_missing_note(metrics)}")
    direct_labels(figure, labels)
    return save(figure, Path(output))


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
    """Draw the learning curves of several agents: each agent's mean, its band, and its seeds.

    Args:
        runs: {label: seeds}; a seed is a run folder, a CSV file with the layout of `metrics.csv`,
            or a `Curve` whose `steps` are already in the unit of x.
        output: the figure's file; its suffix sets the format (`.png`, `.svg`, `.pdf`).
        x: environment steps, or minutes of wall-clock time (column `time/seconds`).
        name: the column to draw; a success rate is drawn in percent.
        band: kind of the band around the mean of several seeds.
        references: {label: value in the unit of the column}, drawn as horizontal lines.
        title: title of the figure.

    Returns:
        `output`.

    Raises:
        MerlError: a file is missing or malformed, there is nothing to draw, or `output` cannot be
            written.
    """
    seeds = {label: _seeds(label, several, name, x) for label, several in runs.items()}
    if not seeds:
        raise MerlError("no run given to draw a learning curve of")
    figure = new_figure(height=4.4)
    axes = figure.subplots()
    rate = "success" in name
    style(axes, _axis_name(name))
    labels = _draw_references(axes, references or {}, rate)
    several_seeds = False
    for i, (label, curves) in enumerate(seeds.items()):
        color, dash = PALETTE[i % len(PALETTE)], DASHES[i // len(PALETTE) % len(DASHES)]
        together = _together(curves, band)
        several_seeds |= together is not None
        last = _draw_seeds(axes, curves, together, color, dash)
        count = f"{len(curves)} seed" + "s" * (len(curves) > 1)
        labels.append(Label(f"{label} ({count})", last, color, "bold"))

    value_axis(axes, [label.y for label in labels], rate)
    longest = np.concatenate([one.steps for curves in seeds.values() for one in curves])
    if x == "steps":
        step_axis(axes, longest)
    else:
        axes.set_xlabel("minutes of wall-clock", color=MUTED)
        axes.set_xlim(0, max(float(longest.max()), 1e-9))
    if title:
        headline(figure, title)
    if several_seeds:
        around = "minimum to maximum" if band == "range" else "its 95 % bootstrap interval"
        note = f"bold: mean over the seeds; band: {around}; thin: each seed"
        axes.set_title(note, loc="left", color=MUTED, size=LABEL_SIZE)
    direct_labels(figure, {axes: labels})
    return save(figure, Path(output))


def _seeds(label: str, runs: Sequence[Run | Curve], name: str, x: str) -> list[Curve]:
    """Return the curve of each seed, over steps or minutes."""
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
        raise MerlError(f"{label}: no run given")
    return curves


def _together(curves: Sequence[Curve], band: Band) -> Aggregate | None:
    """Return the aggregated seeds; None for a single seed or without a common step."""
    if len(curves) < 2:
        return None
    try:
        return aggregate(curves, band=band)
    except ValueError:
        return None


def _draw_seeds(
    axes: Axes, curves: Sequence[Curve], together: Aggregate | None, color: str, dash: str
) -> float:
    """Draw the seeds of one label; return the height of the label."""
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


def _draw_returns(axes: Axes, metrics: dict[str, Array], references: Reference) -> list[Label]:
    labels = _draw_references(axes, references)
    training, per_point = _smooth(curve_of(metrics, "train/return"))
    if len(training.steps):
        axes.plot(*training, color=FAINT, lw=0.9, zorder=1.5)
        text = "training" if per_point == 1 else f"training,\nmeans of {per_point}"
        labels.append(Label(text, training.values[-1], MUTED))
    evaluation = _draw_with_interval(axes, metrics, "eval/return", BLUE)
    if len(evaluation.steps):
        last = evaluation.values[-1]
        labels.append(Label(f"evaluation {last:.0f}", last, BLUE, "bold"))
    highs = metrics.get("eval/return_high", np.empty(0))
    value_axis(axes, [*references.values(), *training.values, *evaluation.values, *highs], False)
    return labels


def _draw_success(axes: Axes, metrics: dict[str, Array]) -> list[Label]:
    labels = []
    at_any_time = curve_of(metrics, "eval/success_any")
    if len(at_any_time.steps):
        marker = "o" if len(at_any_time.steps) == 1 else ""
        axes.plot(*at_any_time, color=GREEN, lw=1.2, ls=(0, (3, 1.5)), marker=marker, ms=3.5)
        last = at_any_time.values[-1]
        labels.append(Label(f"at any time {100 * last:.0f} %", last, GREEN))
    at_the_end = _draw_with_interval(axes, metrics, "eval/success_end", GREEN)
    if len(at_the_end.steps):
        last = at_the_end.values[-1]
        labels.append(Label(f"at the end {100 * last:.0f} %", last, GREEN, "bold"))
    value_axis(axes, [], True)
    return labels


def _draw_with_interval(axes: Axes, metrics: dict[str, Array], name: str, color: str) -> Curve:
    """Draw a column of evaluations and its interval, if both ends are in the metrics."""
    drawn = curve_of(metrics, name)
    low, high = curve_of(metrics, f"{name}_low"), curve_of(metrics, f"{name}_high")
    if len(drawn.steps) == 0:
        return drawn
    if len(low.steps) > 1 and np.array_equal(low.steps, high.steps):
        axes.fill_between(low.steps, low.values, high.values, color=color, alpha=0.16, lw=0)
    elif len(low.steps) == len(high.steps) == 1:
        axes.vlines(low.steps, low.values, high.values, color=color, alpha=0.5, lw=2)
    marker = "o" if len(drawn.steps) <= 40 else ""
    # not clipped: the last marker lies on the panel's edge
    axes.plot(*drawn, color=color, lw=2.0, marker=marker, ms=3.5, zorder=3, clip_on=False)
    return drawn


def _draw_references(axes: Axes, references: Reference, rate: bool = False) -> list[Label]:
    for value in references.values():
        axes.axhline(value, color=MUTED, lw=1.0, ls=(0, (4, 3)), zorder=1.2)
    return [
        Label(
            f"{label} {number(100 * value)} %" if rate else f"{label} {number(value)}",
            value,
            MUTED,
        )
        for label, value in references.items()
    ]


def _smooth(of: Curve) -> tuple[Curve, int]:
    """Return a curve as means over groups of points, and the group size; a short curve as it is."""
    per_point = -(-len(of.steps) // SMOOTHED_POINTS)
    if per_point <= 1:
        return of, 1
    whole = len(of.steps) // per_point * per_point
    return Curve(*(part[:whole].reshape(-1, per_point).mean(axis=1) for part in of)), per_point


def _axis_name(name: str) -> str:
    """Return a column's name in words: `eval/return` -> "evaluation return"."""
    special = {"eval/success_end": "success at the end", "eval/success_any": "success at any time"}
    room, _, what = name.partition("/")
    words = {"eval": "evaluation", "train": "training"}
    return special.get(name, f"{words.get(room, room)} {what.replace('_', ' ')}".strip())


_TITLE = ("task", "agent", "preset", "setting")


def _title(run_dir: Run) -> str:
    """Return task, agent, preset and seed from the run's `config.json`, as far as it has them.

    For a baseline, add the setting (matched or published).
    """
    path = Path(run_dir)
    try:
        config: Any = read_json(path / CONFIG_FILE)
    except (OSError, ValueError):
        config = {}
    config = config if isinstance(config, dict) else {}
    keys = ("task", "agent", "preset") if config.get("agent") == "merl" else _TITLE
    parts = [config[key] for key in keys if isinstance(config.get(key), str)]
    if config.get("seed") is not None:
        parts.append(f"seed {config['seed']}")
    name = path.parent if path.name == METRICS_FILE else path
    return " · ".join(parts) or name.resolve().name


def _missing_note(metrics: dict[str, Array]) -> str:
    if len(curve_of(metrics, "eval/return").steps):
        return ""
    trained = len(curve_of(metrics, "train/return").steps) > 0
    return " (no evaluation yet)" if trained else " (no episode has ended yet)"
