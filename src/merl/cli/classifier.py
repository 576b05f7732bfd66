"""The command merl classifier."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from merl.cli.console import make_console, say
from merl.cli.parsing import check_writable, parse
from merl.core import MerlError
from merl.core.fields import NOT_EMPTY, Range, check_fields
from merl.demos.demonstrations import Demonstrations
from merl.evaluation.success_training import label, save_classifier, train_classifier


@dataclass(frozen=True)
class ClassifierOptions:
    """Train a classifier that sees success in the images, for an arm that cannot measure it."""

    folders: Annotated[
        tuple[Path, ...], NOT_EMPTY, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")
    ]
    """Folders of demonstrations, with episodes that fail too (`merl demos record --failures`)."""
    out: Path = Path("success.safetensors")
    """The file of the classifier."""
    keys: tuple[str, ...] = ()
    """Cameras to use; by default all."""
    updates: Annotated[int, Range(1, 10**6)] = 2000
    """Updates, with batches of 64 images."""
    threshold: Annotated[float, Range(0, 1)] = 0.9
    """Probability from which an image counts as a success in the printed test."""
    seed: Annotated[int, Range(0)] = 0
    """Seed of the networks, batches, shifts, and of the choice of the tested episodes."""

    def __post_init__(self) -> None:
        check_fields(self, "--")


def classifier(args: list[str]) -> int:
    """Train a classifier of success: merl classifier DIR... [--out FILE]."""
    options = parse(ClassifierOptions, "merl classifier", args)
    folders = [Demonstrations.open(folder) for folder in options.folders]
    tasks = {folder.task for folder in folders}
    if len(tasks) > 1:
        raise MerlError(f"these are demonstrations of {' and '.join(sorted(tasks))}: give one task")
    check_writable(options.out)
    console = make_console()
    data = label(folders, options.keys)
    with console.status("training", spinner="line"):
        network, report = train_classifier(
            data, updates=options.updates, threshold=options.threshold, seed=options.seed
        )
    save_classifier(network, data, options.out)
    say(
        console,
        f"{options.out}: sees success in {report.found:,} of {report.solved:,} images with it, and "
        f"in {report.alarms:,} of {report.others:,} without it (episodes that it was not trained "
        f"on, threshold {options.threshold:g})",
    )
    return 0
