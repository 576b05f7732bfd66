"""The command merl resume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from merl.cli.parsing import OpenOptions, parse
from merl.cli.running import Damaged, go_on, tell_trusted
from merl.config import Device
from merl.core.fields import Range
from merl.runs.resume import resume_request
from merl.runs.run import Run


@dataclass(frozen=True)
class ResumeOptions(OpenOptions):
    """Resume a run from its last checkpoint."""

    steps: Annotated[int, Range(1)] | None = None
    """Train to this total number of steps; by default to the run's own --steps."""
    minutes: Annotated[float, Range(0, without=0)] | None = None
    """Stop after this many minutes from now; by default there is no time limit."""
    device: Device | None = None
    """Where the networks live from now on; by default where they were before."""
    damaged: Damaged = "refuse"
    """If a part of the replay is damaged: do not resume, or skip the episodes with damage."""


def resume(args: list[str]) -> int:
    """Resume a run: merl resume RUN [--steps N] [--minutes N]."""
    options = parse(ResumeOptions, "merl resume", args)
    run = Run.open(options.run)
    if options.trust:
        tell_trusted(run)
    run = run.with_agent(trusted=options.trust)
    asked = resume_request(run.config, options.steps, options.minutes, options.device)
    skip = options.damaged == "skip"
    return go_on(run, asked, ["device"], trusted=options.trust, skip_damaged=skip)
