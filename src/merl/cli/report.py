"""The command merl report."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from merl.cli.console import make_console, say
from merl.cli.parsing import parse
from merl.core import MerlError, counted, suggest
from merl.core.fields import Range, check_fields
from merl.report.collect import collect


@dataclass(frozen=True)
class ReportOptions:
    """Draw learning curves of runs and compare them: a page with figures, tables and videos.

    Runs that differ in their seed only are one curve, with an interval over the seeds.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, CSV files with the layout of metrics.csv, or folders that hold them."""
    out: Path = Path("report")
    """Folder of the report: index.html, table.csv, and each figure as PNG and SVG."""
    title: str = "Learning curves"
    """Title of the page."""
    baseline: str | None = None
    """Label of the curve that is compared with the others; by default the first by name."""
    watch: Annotated[int, Range(1)] | None = None
    """Repeat the report at this interval, in seconds, while runs are training."""

    def __post_init__(self) -> None:
        check_fields(self, "--")
        if not self.runs:
            raise MerlError("missing from merl report: RUN...")


def report(args: list[str]) -> int:
    """Write a report: merl report RUN... [--out DIR] [--watch SECONDS]."""
    options = parse(ReportOptions, "merl report", args)
    console = make_console()
    before: list[str] = []
    while True:
        before = _report(options, console, before)
        if options.watch is None:
            return 0
        time.sleep(options.watch)


def _report(options: ReportOptions, console: Console, before: list[str]) -> list[str]:
    """Write the report once, print new notes, and return all notes."""
    from merl.report.page import write_report  # Matplotlib imports slowly

    try:
        groups, notes = collect(options.runs)
    except MerlError as error:
        if options.watch is None:
            raise
        groups, notes = [], [str(error)]  # the first evaluation may still come
    labels, wrong = sorted({group.label for group in groups}), None
    if options.baseline is not None and groups and options.baseline not in labels:
        hint = suggest(options.baseline, labels)
        wrong = f"--baseline {options.baseline!r} is none of the curves: {hint}"
        notes += [wrong] if options.watch else []  # as above
    for note in notes:
        if note not in before:
            say(console, note)
    if wrong is not None and options.watch is None:
        raise MerlError(wrong)
    groups.sort(key=lambda group: group.label != options.baseline)
    if groups:
        page = write_report(groups, notes, options.out, options.title, options.watch)
        runs = sum(len(group.runs) for group in groups)
        say(console, f"{page}: {counted(runs, 'run')}, {counted(len(groups), 'curve')}")
    return notes
