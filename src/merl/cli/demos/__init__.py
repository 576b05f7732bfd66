"""The command merl demos: record, show, import and export demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from merl.cli.console import make_console
from merl.cli.demos.convert import ExportOptions, ImportOptions, export, import_
from merl.cli.demos.record import RecordOptions, record
from merl.cli.demos.shared import FolderOptions, describe
from merl.cli.parsing import parse
from merl.core import MerlError, suggest
from merl.demos.demonstrations import Demonstrations
from merl.modalities import Image, Modality, modalities_of
from merl.report.film import MOST_ROWS, draw_rows, equally_spaced

ACTIONS = {
    "record": "record demonstrations of the expert, a policy or a person",
    "show": "show what a folder of demonstrations holds",
    "import": "convert a LeRobotDataset v3, a robomimic file or a Minari dataset",
    "export": "write demonstrations in one of these formats",
}


@dataclass(frozen=True)
class ShowOptions(FolderOptions):
    """Show what a folder of demonstrations holds."""

    film: Path | None = None
    """Draw frames of some episodes, as the agent sees them, into this PNG file."""


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
    found, console = Demonstrations.open(options.folder), make_console()
    rows: dict[str, list[NDArray[np.uint8]]] = {}
    keys = [key for key, kind in modalities_of(found.observation_space).items() if _is_rgb(kind)]
    chosen = {*np.linspace(0, len(found.lines) - 1, MOST_ROWS).round().astype(int)}
    for number, episode in enumerate(found.episodes()):  # all are read, which checks them
        if number in chosen:
            for key in keys:
                frames = episode.observations[key]
                rows[f"{key} {number}"] = [frames[i] for i in equally_spaced(len(frames))]
    describe(console, found)
    if options.film is not None:
        if not rows:
            raise MerlError(f"{found.path} has no images to draw")
        console.print(f"frames: {draw_rows(rows, options.film)}", highlight=False, soft_wrap=True)
    return 0


def _is_rgb(modality: Modality) -> bool:
    return isinstance(modality, Image) and modality.shape[-1] == 3
