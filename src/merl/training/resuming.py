"""Resume a run, from Python and from the command line."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from merl.config import TrainConfig
from merl.core import MerlError, counted
from merl.runs.checkpoint import Checkpoint, readable
from merl.runs.resume import REOPENED, left_open, merge_resume_config, reopened
from merl.runs.run import Run
from merl.runs.run_folder import check_links
from merl.training.loop import Progress
from merl.training.outcome import Outcome
from merl.training.setup import device_name


@dataclass(frozen=True)
class Resumption:
    """A run that can be resumed.

    Attributes:
        run: the run.
        config: its config from now on.
        start: the checkpoint to resume from; None to start at the first step.
        done: the outcome of the run, if it has ended; None if there is something left to do.
        what: a description of the resumption in one line.
    """

    run: Run
    config: TrainConfig
    start: Checkpoint | None
    done: Outcome | None
    what: str


@contextmanager
def resumption(
    run: Run,
    asked: TrainConfig,
    given_open: Collection[str] = (),
    *,
    imports: bool = True,
    trusted: bool = False,
    named_in: Path | None = None,
) -> Iterator[Resumption]:
    """Lock a run and find its last intact checkpoint.

    Args:
        run: the run.
        asked: the requested config; fields that it leaves open keep their recorded values.
        given_open: fields that the user explicitly left open, as with `--agent.precision auto`.
        imports: whether to import the environment that the run names.
        trusted: whether the code that the run names may be imported; see `Run.load_module`.
        named_in: the folder in which the user named the task and the agent.

    Raises:
        MerlError: the config would make it another run, another process trains it, its checkpoint
            or replay is missing, or its code is not trusted.
    """
    if asked.device == "auto" and "device" in given_open:
        asked = dataclasses.replace(asked, device=device_name("auto"))
    config, changes = merge_resume_config(run.config, asked, given_open)
    fixed = {name for name in REOPENED if name not in left_open(asked)}
    kept = {name for name in run.left_open if name not in fixed}
    still_open = tuple(name for name in REOPENED if name in kept or name in given_open)
    run = dataclasses.replace(run, left_open=still_open)
    if run.has_moved() or config.device != run.config.device:
        config = reopened(config, run.left_open)
    check_links(run.path)
    with run.lock():
        if imports and not config.lacks_env:
            run.load_module(trusted=trusted, named_in=named_in)
        run.load_encoders(trusted=trusted, named_in=named_in)
        if run.begin_again():
            what = f"run {run.path}, which was stopped before its first step, starts again"
            yield Resumption(run, config, None, None, what)
            return
        start = Checkpoint.find(run.checkpoints)
        with readable(start):
            state = start.state()
            progress, is_open = Progress(**state["progress"]), state["replay"]["open"]
        if config.steps < min(start.step, run.config.steps):
            raise MerlError(f"--steps {config.steps} is less than the {start.step:,} already taken")
        is_evaluated = not config.eval.every or progress.evaluated == start.step
        if start.step >= config.steps and is_evaluated:
            steps = f"{start.step:,} of {counted(config.steps, 'step')}"
            what = f"{run.path} is done: {steps}; --steps N trains it further"
            yield Resumption(run, config, start, Outcome(run, progress, None, None, True), what)
            return
        if not run.replay.is_dir():
            raise MerlError(
                f"{run.replay} is gone: without it the run can be evaluated, not resumed"
            )
        what = f"run {run.path} resumes at step {start.step:,}"
        if is_open:
            what += " (it was stopped within an episode; a new one begins)"
        if changes:
            what += f" with {', '.join(changes)}"
        yield Resumption(run, config, start, None, what)
