"""merl resume."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from merl.cli.parsing import parse
from merl.cli.running import go_on, tell_trusted
from merl.core import MerlError
from merl.runs.resume import reopened
from merl.runs.run import Run


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
    trust: tyro.conf.FlagCreatePairsOff[bool] = False
    """Import the environment that the run names, although you have not trained this run here: that
    runs the code of whoever made the run."""

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise MerlError(f"steps must be at least 1, not {self.steps}")


def resume(args: list[str]) -> int:
    """Go on with a run: merl resume RUN [--steps N] [--minutes N]."""
    options = parse(ResumeOptions, "merl resume", args)
    run = Run.open(options.run)
    asked = dataclasses.replace(
        reopened(run.config),
        steps=options.steps or run.config.steps,
        minutes=options.minutes,
        device=options.device or run.config.device,
    )
    if options.trust:
        tell_trusted(run)
    return go_on(run, asked, ["device"], trusted=options.trust)
