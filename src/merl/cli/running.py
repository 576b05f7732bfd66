"""Start or resume a run from the command line; print its outlook and its result."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.filesize import decimal

from merl.acting.run_env import key_lines
from merl.cli.duration import DurationView, duration
from merl.cli.output import make_console
from merl.cli.summary import summarize
from merl.config import TrainConfig
from merl.core import MerlError, NotSaved, counted
from merl.report.references import EXPERT, RANDOM, references
from merl.runs.checkpoint import Checkpoint, readable
from merl.runs.resume import REOPENED, left_open, merge_resume_config, reopened
from merl.runs.run import Run
from merl.runs.run_folder import check_links, resume_line
from merl.training.setup import Setup, device_name
from merl.training.trainer import Outcome, Trainer

DAY = 86_400.0  # seconds


def begin(config: TrainConfig, what: str) -> int:
    """Train a new run to its end; return the exit code.

    Args:
        config: the config of the run.
        what: a description of the run, for the first printed line.
    """
    return _train(config, what)


def go_on(
    run: Run,
    asked: TrainConfig,
    given_open: Collection[str] = (),
    *,
    trusted: bool = False,
    named_in: Path | None = None,
) -> int:
    """Resume a run from its last intact checkpoint and train it to its end; return the exit code.

    Args:
        run: the run.
        asked: the requested config; fields that it leaves open keep their recorded values.
        given_open: fields that the user explicitly left open, as with `--agent.precision auto`.
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
    run = dataclasses.replace(
        run,
        left_open=tuple(
            name
            for name in REOPENED
            if name in given_open or (name in run.left_open and name not in fixed)
        ),
    )
    if run.has_moved() or config.device != run.config.device:
        config = reopened(config, run.left_open)
    check_links(run.path)
    with run.lock():
        run.load_module(trusted=trusted, named_in=named_in)
        run.load_encoders(trusted=trusted, named_in=named_in)
        if run.begin_again():
            what = f"run {run.path}, which was stopped before its first step, starts again"
            return _train(config, what, (run, None))
        start = Checkpoint.find(run.checkpoints)
        with readable(start):
            state = start.state()
            evaluated, is_open = state["progress"]["evaluated"], state["replay"]["open"]
        if config.steps < min(start.step, run.config.steps):
            raise MerlError(f"--steps {config.steps} is less than the {start.step:,} already taken")
        if start.step >= config.steps and (not config.eval.every or evaluated == start.step):
            steps = f"{start.step:,} of {counted(config.steps, 'step')}"
            print(f"{run.path} is done: {steps}; --steps N trains it further")
            return 0
        if not run.replay.is_dir():
            raise MerlError(
                f"{run.replay} is gone: without it the run can be evaluated, not resumed"
            )
        what = f"run {run.path} resumes at step {start.step:,}"
        if is_open:
            what += " (it was stopped within an episode; a new one begins)"
        if changes:
            what += f" with {', '.join(changes)}"
        return _train(config, what, (run, start))


def tell_trusted(run: Run) -> None:
    """Print which code `--trust` imports."""
    origin = run.origin()
    if origin is not None:
        print(f"merl: --trust: importing {origin}", file=sys.stderr)


def _train(
    config: TrainConfig, what: str, resumed: tuple[Run, Checkpoint | None] | None = None
) -> int:
    """Train, print the result, and return the exit code."""
    console = make_console()
    try:
        outcome = _fit(config, what, resumed, console)
    except KeyboardInterrupt:  # during training, `Interrupt` defers signals
        console.print("stopped before training began: nothing was written")
        raise
    folder = outcome.run.path
    if outcome.signal is not None:
        check_saved(outcome)
        console.print(f"stopped at step {outcome.progress.step:,} and saved: resume with")
        console.print(f"    {resume_line(folder)}", highlight=False, soft_wrap=True)
        return 128 + outcome.signal
    try:
        summarize(outcome, console)
    except KeyboardInterrupt:
        check_saved(outcome)
        console.print(f"{folder} is trained and saved", highlight=False, soft_wrap=True)
        raise
    check_saved(outcome)
    return 0


def _fit(
    config: TrainConfig,
    what: str,
    resumed: tuple[Run, Checkpoint | None] | None,
    console: Console,
) -> Outcome:
    """Train with the live view; the trainer and the files that it maps are gone at the end."""
    with ExitStack() as stack:
        view = DurationView(console, _scale(config))
        with console.status("building the scene and timing this machine", spinner="line"):
            trainer = stack.enter_context(Trainer(config, [view], resumed=resumed))
        done = resumed[1].step if resumed and resumed[1] else 0
        console.print(_outlook(trainer.setup, what, done), highlight=False)
        return trainer.fit()


def check_saved(outcome: Outcome) -> None:
    """Check that the end of a run is saved.

    Raises:
        NotSaved: its last checkpoint or rows of its metrics are not on the disk.
    """
    run, rows = outcome.run, outcome.unwritten
    lost = [] if outcome.saved else ["its checkpoint"]
    lost += [f"{counted(rows, 'row')} of its metrics"] if rows else []
    if not lost:
        return
    try:
        last = f"step {Checkpoint.find(run.checkpoints).step:,}"
    except MerlError:
        last = "its start"
    raise NotSaved(
        f"{run.path} ended at step {outcome.progress.step:,}, but {' and '.join(lost)} could not "
        f"be written: make room on the disk, then `{resume_line(run.path)}` continues from {last}"
    )


def _scale(config: TrainConfig) -> dict[str, float]:
    """Return the reference returns for the live view; none for an unknown environment."""
    return {
        reference.name: reference.returns.mean
        for reference in references(config.task, config.evaluated.env)
        if reference.name in (RANDOM, EXPERT)
    }


def _outlook(setup: Setup, what: str, done: int) -> str:
    """Return lines that describe the run: its duration, inputs, speed and memory."""
    config, timing = setup.config, setup.timing
    size = decimal(setup.replay_spec.bytes)
    updates = ", ".join(f"{1000 * s:.3g} ms in {how}" for how, s in timing.update.items())
    has_images = not config.own_env and any(m.stacked for m in setup.spec.modalities.values())
    images = f" ({config.env.renderer} images)" if has_images else ""
    lines = [f"{what}: {duration(config, timing, done)}"]
    if timing.seconds(config, done) > DAY and config.preset != "laptop":
        lines.append("that is more than a day: --preset laptop is made for a machine like this one")
    lines += key_lines(config, setup.env)
    step = "ms per step" if timing.knows_env else "ms per step, without the environment"
    lines += [
        f"an update takes {updates}; acting takes {1000 * timing.step:.1f} {step}{images}",
        f"the replay takes {size} for {counted(config.capacity, 'step')}",
    ]
    if timing.not_compiled is not None:
        lines.append(f"updates are not compiled because compiling fails: {timing.not_compiled}")
    if (config.steps - config.seed_steps) * config.updates_per_step < 1:
        lines.append(
            "nothing will be learnt: the first update comes after "
            f"{counted(config.seed_steps, 'step')}, with --updates-per-step above 0"
        )
    return "\n".join(lines)
