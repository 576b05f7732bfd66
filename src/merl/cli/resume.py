"""merl resume."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from merl.cli.parsing import parse
from merl.cli.running import go_on
from merl.core import MerlError
from merl.training.run import Run


@dataclass(frozen=True)
class ResumeOptions:
    """Go on with a run from its last checkpoint."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    steps: int | None = None
    """Train to this many steps in all, in place of what the run was started with."""
    minutes: float | None = None
    """Stop after this many minutes from now; if not set, only the steps count."""
    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where the networks live from now on; where they were, if not set."""

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise MerlError(f"steps must be at least 1, not {self.steps}")


def resume(args: list[str]) -> int:
    """Go on with a run: merl resume RUN [--steps N] [--minutes N]."""
    options = parse(ResumeOptions, "merl resume", args)
    run = Run.open(options.run)
    asked = dataclasses.replace(
        run.config,
        steps=options.steps or run.config.steps,
        minutes=options.minutes,
        device=options.device or run.config.device,
    )
    return go_on(run, asked)
