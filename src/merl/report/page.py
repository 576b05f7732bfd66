"""The page of a report: one HTML file with its tables, figures and videos."""

from __future__ import annotations

import base64
import math
import time
from collections.abc import Callable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from merl.core import MerlError, counted
from merl.core.files import replace_file, reporting
from merl.report.collect import RETURN, SUCCESS, Group, SeedRun
from merl.report.curves import Curve
from merl.report.figures import learning_curves
from merl.report.film import film_strip
from merl.report.html import Cell, bullets, inline_svg, number_cell, slug, table
from merl.report.profiles import draw_profiles
from merl.report.references import EXPERT, RANDOM
from merl.report.summary import (
    LEVELS,
    SECONDS,
    Comparison,
    Estimate,
    Overall,
    Row,
    comparisons,
    overall,
    row_of,
    write_table,
)

MOST_VIDEO = 40_000_000
"""Bytes of all videos in a page; further ones are left out."""
RESULTS = {
    "final return": ("final return", ".3g", ""),
    "best return": ("best return", ".3g", ""),
    "mean return": ("mean return", ".3g", ""),
    "final success": ("final success", ".0f", " %"),
    "best success": ("best success", ".0f", " %"),
    **{
        f"{unit} to {level:.0%} success": (f"{unit} to {level:.0%} success", ",.0f", "")
        for unit in ("steps", "minutes")
        for level in LEVELS
    },
}
"""{heading of a column: name of the result, its format, its unit}."""


def write_report(
    groups: Sequence[Group],
    notes: Sequence[str],
    out: Path,
    title: str = "Learning curves",
    refresh: int | None = None,
) -> Path:
    """Write a report: `index.html`, `table.csv`, and the figures as PNG and SVG.

    Args:
        groups: the runs; see `collect`.
        notes: remarks that the page shows.
        out: the folder, which is created.
        title: the page's title.
        refresh: seconds after which the page loads itself again; None for never.

    Returns:
        The page.

    Raises:
        MerlError: a file cannot be written.
    """
    rows = [row_of(group) for group in groups]
    with reporting(f"{out} cannot be created"):
        out.mkdir(parents=True, exist_ok=True)
    write_table(rows, out / "table.csv")
    budget = _Budget(MOST_VIDEO)
    tasks = [*dict.fromkeys(group.task for group in groups)]
    compared = comparisons(groups)
    sections = [
        _task_section(
            task,
            [row for row in rows if row.group.task == task],
            [each for each in compared if each.task == task],
            out,
            budget,
        )
        for task in tasks
    ]
    summaries = overall(groups)
    if summaries:
        sections.append(_overall_section(summaries, tasks, out))
    notes = [*notes, *budget.notes]
    runs = sum(len(group.runs) for group in groups)
    page = Template((files("merl.report") / "page.html").read_text()).substitute(
        title=escape(title),
        refresh=f'<meta http-equiv="refresh" content="{refresh}">' if refresh else "",
        about=f"{counted(runs, 'run')}, {', '.join(map(escape, tasks))}; "
        f"made {time.strftime('%Y-%m-%d %H:%M')}. Brackets and bands are 95 % bootstrap intervals "
        "over seeds; thin lines are single seeds.",
        notes=bullets(notes),
        sections="\n".join(sections),
    )
    path = out / "index.html"
    with reporting(f"{path} cannot be written"):
        replace_file(path, page.encode())
    return path


def _task_section(
    task: str, rows: Sequence[Row], compared: Sequence[Comparison], out: Path, budget: _Budget
) -> str:
    parts = [f"<h2>{escape(task)}</h2>", _results(rows)]
    groups = [row.group for row in rows]
    for name, words in ((RETURN, "Return"), (SUCCESS, "Success at the end")):
        panels = [
            f"<div><h3>{words} over {x}</h3>{inline_svg(figure)}</div>"
            for x in ("steps", "minutes")
            if (figure := _curves(groups, task, name, x, out)) is not None
        ]
        parts.append(f'<div class="pair">{"".join(panels)}</div>')
    if compared:
        parts += [f"<h3>{escape(compared[0].ours)} against the others</h3>", _compared(compared)]
    parts += [_runs(group, out, budget) for group in groups]
    return f'<section id="{escape(slug(task))}">' + "\n".join(parts) + "</section>"


def _results(rows: Sequence[Row]) -> str:
    """Return the table of the groups' results."""
    columns: dict[str, Callable[[Row], Cell]] = {
        "variant": lambda row: (escape(row.group.label), row.group.label),
        "seeds": lambda row: (str(len(row.group.runs)), len(row.group.runs)),
        "steps": lambda row: (f"{row.steps:,}", row.steps),
        "minutes": lambda row: _estimate(row.minutes, ".0f"),
    }
    for heading, (name, form, unit) in RESULTS.items():
        if any(name in row.results for row in rows):
            columns[heading] = _result(name, form, unit)
    columns["spread"] = lambda row: number_cell(row.spread)
    return table(columns, rows)


def _result(name: str, form: str, unit: str) -> Callable[[Row], Cell]:
    def cell(row: Row) -> Cell:
        return _estimate(row.results[name], form, unit) if name in row.results else ("", "")

    return cell


def _estimate(one: Estimate, form: str, unit: str = "") -> Cell:
    shown, _, rest = one.text(form, 100.0 if unit else 1.0).partition(" ")
    if one.count == 0:
        return f"<small>{shown}</small>", ""
    return f"{shown}{unit}" + (f"<small>{rest}</small>" if rest else ""), one.mean


def _compared(compared: Sequence[Comparison]) -> str:
    def chance(each: Comparison) -> Cell:
        text = f"{each.better.mean:.0%}"
        if not math.isnan(each.better.low):
            text += f"<small>[{each.better.low:.0%}, {each.better.high:.0%}]</small>"
        return text, each.better.mean

    first = escape(compared[0].ours)
    note = (
        "<p class='muted'>The paired test swaps the two final returns of a seed (exact permutation "
        "test); with n seeds its p-value is at least 2 / 2<sup>n</sup>.</p>"
    )
    numbers = table(
        {
            "other": lambda each: (escape(each.theirs), each.theirs),
            f"probability that a run of {first} returns more": chance,
            "mean difference over equal seeds": lambda each: number_cell(each.difference),
            "equal seeds": lambda each: (str(each.pairs), each.pairs),
            "p": lambda each: number_cell(each.p, ".2g"),
        },
        compared,
    )
    return note + numbers


def _curves(groups: Sequence[Group], task: str, name: str, x: str, out: Path) -> Path | None:
    """Draw a column of the groups over steps or minutes; None if they do not have it."""
    found: dict[str, list[Curve]] = {}
    for group in groups:
        curves = [
            Curve(curve.steps / 60, curve.values) if x == "minutes" else curve
            for run in group.runs
            if len((curve := run.curve(name, SECONDS if x == "minutes" else "step")).steps)
        ]
        if curves:
            found[group.label] = curves
    if not found:
        return None
    known = groups[0].runs[0].references if name == RETURN else {}
    shown = {word: known[word] for word in (RANDOM, EXPERT) if word in known}
    stem = f"{slug(task)}-{name}-{x}"
    for suffix in (".png", ".svg"):
        learning_curves(
            found,
            out / f"{stem}{suffix}",  # a task's name may have dots
            x="minutes" if x == "minutes" else "steps",
            name=f"eval/{name}",
            band="bootstrap",
            references=shown,
        )
    return out / f"{stem}.svg"


def _overall_section(summaries: Sequence[Overall], tasks: Sequence[str], out: Path) -> str:
    def interval(name: str) -> Callable[[Overall], Cell]:
        def cell(each: Overall) -> Cell:
            one = getattr(each, name)
            return f"{one.mean:.2f}<small>[{one.low:.2f}, {one.high:.2f}]</small>", one.mean

        return cell

    numbers = table(
        {
            "variant": lambda each: (escape(each.label), each.label),
            "seeds": lambda each: (str(len(each.scores)), len(each.scores)),
            "interquartile mean": interval("interquartile_mean"),
            "mean": interval("mean"),
            "optimality gap": interval("gap"),
        },
        summaries,
    )
    scores = {each.label: each.scores for each in summaries}
    for suffix in (".png", ".svg"):
        draw_profiles(scores, out / f"profiles{suffix}")
    where = " and ".join([", ".join(tasks[:-1]), tasks[-1]]) if len(tasks) > 1 else tasks[0]
    return (
        f'<section id="overall"><h2>Over all seeds of {escape(where)}</h2><p class="muted">The '
        "score of a run is its final return, 0 for random actions and 1 for the scripted expert "
        "(Agarwal et al. 2021).</p>"
        + numbers
        + "<h3>Performance profiles: share of runs above a score</h3>"
        + inline_svg(out / "profiles.svg")
        + "</section>"
    )


def _runs(group: Group, out: Path, budget: _Budget) -> str:
    """Return the runs behind a curve: their results, commands, videos and film strip."""
    parts = [f"<summary>{escape(group.label)}: {counted(len(group.runs), 'run')}</summary>"]
    lines = [_about(run) for run in group.runs]
    parts.append("<ul>" + "".join(f"<li>{line}</li>" for line in lines) + "</ul>")
    videos = [budget.video(run) for run in group.runs]
    if any(videos):
        parts.append(f'<div class="videos">{"".join(videos)}</div>')
    filmed = [run for run in group.runs if len(run.videos) > 1]
    if filmed:
        strip = out / f"{slug(group.task)}-{slug(group.label)}-film.jpg"
        try:
            film_strip(filmed[0].videos, strip)
        except MerlError as error:
            budget.notes.append(str(error))
        else:
            image = base64.b64encode(strip.read_bytes()).decode()
            parts.append(
                f"<h3>{escape(filmed[0].name)} during training: an episode of some evaluations, "
                f'from its start to its end</h3><div class="wide"><img alt="film strip" '
                f'src="data:image/jpeg;base64,{image}"></div>'
            )
    return f"<details open>{''.join(parts)}</details>"


def _about(run: SeedRun) -> str:
    final = f"return {run.final(RETURN):.4g}"
    success = run.final(SUCCESS)
    if not math.isnan(success):
        final += f", success {success:.0%}"
    of = f"{len(run.episodes)} episodes" if run.episodes else "the last evaluation in training"
    machine = run.record.get("machine")
    where = (
        f"; {machine['processor']}" if isinstance(machine, dict) and "processor" in machine else ""
    )
    commit = run.record.get("commit")
    where += f"; commit {commit}" if commit else ""
    return f"<code>{escape(str(run.path))}</code>: {final} ({of}){escape(where)}"


class _Budget:
    """The videos of a page, up to a size."""

    def __init__(self, size: int) -> None:
        self._left, self.notes = size, list[str]()

    def video(self, run: SeedRun) -> str:
        """Return the last video of a run as HTML; empty if it has none or it does not fit."""
        if not run.videos:
            return ""
        step, path = [*run.videos.items()][-1]
        try:
            fits = path.stat().st_size <= self._left
            content = path.read_bytes() if fits else b""
        except OSError as error:
            self.notes.append(f"{path} cannot be read: {error.strerror}")
            return ""
        if not fits:
            self.notes.append(f"{run.name}: its video is left out, to keep the page small: {path}")
            return ""
        self._left -= len(content)
        data = base64.b64encode(content).decode()
        return (
            f'<figure><video controls muted loop playsinline preload="metadata" '
            f'src="data:video/mp4;base64,{data}"></video>'
            f"<figcaption>{escape(run.name)} at step {step:,}</figcaption></figure>"
        )
