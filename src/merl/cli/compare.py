"""The command merl compare."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from merl.cli.console import make_console
from merl.cli.parsing import parse
from merl.core import CONFIG_FILE, MerlError
from merl.report.collect import RETURN, SUCCESS, Group, SeedRun, read_run
from merl.report.summary import row_of


@dataclass(frozen=True)
class CompareOptions:
    """Print what differs between two runs: config, versions, machine, and result."""

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run."""
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of the other run."""


def compare(args: list[str]) -> int:
    """Compare two runs: merl compare RUN RUN."""
    options = parse(CompareOptions, "merl compare", args)
    runs = [read_run(path) for path in (options.first, options.second)]
    for run in runs:
        if not run.record:
            raise MerlError(f"{run.path} has no {CONFIG_FILE}: name the folder of a run")
    mine, its = (_facts(run) for run in runs)
    table = Table("", *(run.name for run in runs), box=None, padding=(0, 2))
    differing = [name for name in mine | its if mine.get(name) != its.get(name)]
    for name in differing:
        table.add_row(name, *(str(facts.get(name, "")) for facts in (mine, its)))
    for name, *values in _results(runs):
        table.add_row(name, *values)
    console = make_console()
    console.print(table)
    if not differing:
        console.print("config, versions and machine are the same")
    return 0


def _facts(run: SeedRun) -> dict[str, Any]:
    """Return what the record of a run says, by dotted name."""
    facts = {
        f"{key}": run.record.get(key) for key in ("preset", "setting", "seed", "merl", "commit")
    }
    machine, versions = run.record.get("machine"), run.record.get("versions")
    for part in (machine, versions):
        facts |= part if isinstance(part, dict) else {}
    return facts | run.values


def _results(runs: list[SeedRun]) -> list[tuple[str, ...]]:
    """Return rows with the results of the runs."""
    have = [len(run.curve(RETURN).steps) > 0 for run in runs]
    rows = [
        row_of(Group(run.label, run.task, (run,))) if known else None
        for run, known in zip(runs, have, strict=True)
    ]
    lines = [("step", *(f"{run.last_step:,}" for run in runs))]
    for name, what in (("final return", RETURN), ("final success", SUCCESS)):
        values = [run.final(what) for run in runs]
        form = ".0%" if what == SUCCESS else ".4g"
        if not all(map(math.isnan, values)):
            lines.append(
                (name, *("" if math.isnan(value) else f"{value:{form}}" for value in values))
            )
    names = [name for row in rows if row for name in row.results if not name.startswith("final")]
    for name in dict.fromkeys(names):
        form = {"best success": ".0%"}.get(name, ",.4g" if "to" not in name else ",.0f")
        lines.append(
            (
                name,
                *(
                    row.results[name].text(form) if row and name in row.results else ""
                    for row in rows
                ),
            )
        )
    return lines
