"""The command merl check."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from merl.cli.parsing import parse
from merl.core import CONFIG_FILE, MerlError
from merl.runs.checking import check_run, damage_of
from merl.runs.run import Run


@dataclass(frozen=True)
class CheckOptions:
    """Find damage in a run: config, checkpoints, metrics and replay. Changes nothing."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""


def check(args: list[str]) -> int:
    """Print what is sound and what is damaged: merl check RUN; return 1 if something is damaged."""
    options = parse(CheckOptions, "merl check", args)
    try:
        run = Run.open(options.run)
    except MerlError as error:
        if not os.path.lexists(options.run / CONFIG_FILE):
            raise
        print(f"DAMAGED: {damage_of(error).text}; without it nothing else can be checked")
        return 1
    sound = True
    for finding in check_run(run):
        print("sound:  " if finding.sound else "DAMAGED:", finding.text)
        sound &= finding.sound
    return 0 if sound else 1
