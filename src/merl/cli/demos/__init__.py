"""The command merl demos: record, show, import and export demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from merl.cli.demos.convert import ExportOptions, ImportOptions, export, import_
from merl.cli.demos.record import RecordOptions, record
from merl.cli.demos.shared import FolderOptions, describe
from merl.cli.output import make_console
from merl.cli.parsing import parse
from merl.core import MerlError, suggest
from merl.demos.demonstrations import Demonstrations

ACTIONS = {
    "record": "record demonstrations of the expert, a policy or a person",
    "show": "show what a folder of demonstrations holds",
    "import": "convert a LeRobotDataset v3, a robomimic file or a Minari dataset",
    "export": "write demonstrations in one of these formats",
}


@dataclass(frozen=True)
class ShowOptions(FolderOptions):
    """Show what a folder of demonstrations holds."""


@dataclass(frozen=True)
class DemosOptions:
    """Record, show, import or export demonstrations; for tab completion."""

    action: Annotated[
        Annotated[RecordOptions, tyro.conf.subcommand("record")]
        | Annotated[ShowOptions, tyro.conf.subcommand("show")]
        | Annotated[ImportOptions, tyro.conf.subcommand("import")]
        | Annotated[ExportOptions, tyro.conf.subcommand("export")],
        tyro.conf.arg(name=""),
    ]
    """What to do."""


def demos(args: list[str]) -> int:
    """Record, show, import or export demonstrations: merl demos record TASK, ..."""
    action, *rest = args or ["--help"]
    if action in ("-h", "--help"):
        lines = [f"  {name:<12}{about}" for name, about in ACTIONS.items()]
        print("\n".join(["usage: merl demos ACTION ...", "", *lines, ""]))
        print("merl demos ACTION --help shows its options.")
        return 0
    if action not in ACTIONS:
        raise MerlError(f"merl demos {action!r} is unknown: {suggest(action, tuple(ACTIONS))}")
    run = {"record": record, "show": show, "import": import_, "export": export}[action]
    return run(rest)


def show(args: list[str]) -> int:
    """Show demonstrations."""
    options = parse(ShowOptions, "merl demos show", args)
    found = Demonstrations.open(options.folder)
    for _ in found.episodes():  # check that all can be read
        pass
    describe(make_console(), found)
    return 0
