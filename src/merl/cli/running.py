"""Start or resume a run from the command line; print its outlook and its result."""

from __future__ import annotations

import sys
from collections.abc import Collection
from contextlib import ExitStack
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.filesize import decimal

from merl.acting.run_env import key_lines
from merl.cli.console import make_console, say
from merl.cli.parsing import PolicyOptions
from merl.cli.summary import summarize
from merl.config import CUSTOM, Source, TrainConfig
from merl.core import MerlError, counted
from merl.core.signals import attended
from merl.core.watching import END_SECONDS, ending
from merl.evaluation.policy import Policy, load_policy
from merl.experiments.cloning_first import clone_first
from merl.report.references import EXPERT, RANDOM, references
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.live_view import LiveView
from merl.training.outcome import Outcome
from merl.training.resuming import resumption
from merl.training.setup import Setup
from merl.training.timing import Timing
from merl.training.trainer import Trainer

DAY = 86_400.0  # seconds
_STOPPING = "merl: stopping once the environment returns; a second signal (Ctrl-C) stops at once"
_UNCLOSED = f"merl: warning: close() of the environment did not return within {END_SECONDS:g} s"
Damaged = Literal["refuse", "skip"]
"""What to do with a replay of which a part is damaged."""


def begin(config: TrainConfig, source: Source, what: str) -> int:
    """Train a new run to its end, after a run that clones if asked; return the exit code.

    Args:
        config: the config of the run.
        source: where its values come from.
        what: a description of the run, for the first printed line.
    """
    cloning = f"{what}, which begins with a run that clones the demonstrations"
    then, stopped = clone_first(
        config, source, lambda first: _train(first, cloning, source=source), go_on, bool
    )
    return _train(then, what, source=source) if stopped is None else stopped


def go_on(
    run: Run,
    asked: TrainConfig,
    given_open: Collection[str] = (),
    *,
    trusted: bool = False,
    named_in: Path | None = None,
    skip_damaged: bool = False,
) -> int:
    """Resume a run and train it to its end; return the exit code.

    See `resumption`, and `Trainer` for `skip_damaged`.
    """
    with resumption(run, asked, given_open, trusted=trusted, named_in=named_in) as found:
        if found.done is not None:
            print(found.what)
            return 0
        resumed = found.run, found.start
        return _train(found.config, found.what, resumed, CUSTOM, skip_damaged)


def tell_trusted(run: Run) -> None:
    """Print which code `--trust` imports."""
    origin = run.origin()
    if origin is not None:
        print(f"merl: --trust: importing {origin}", file=sys.stderr)


def open_policy(options: PolicyOptions) -> Policy:
    """Load the policy that a command names; with `--trust`, print which code is imported."""
    if options.trust:
        tell_trusted(Run.open(options.run))
    return load_policy(options.run, checkpoint=options.checkpoint, trust=options.trust)


def _train(
    config: TrainConfig,
    what: str,
    resumed: tuple[Run, Checkpoint | None] | None = None,
    source: Source = CUSTOM,
    skip_damaged: bool = False,
) -> int:
    """Train, print the result, and return the exit code."""
    console = make_console()
    try:
        outcome = _fit(config, what, resumed, source, skip_damaged, console)
    except KeyboardInterrupt:  # during training, `Interrupt` defers signals
        console.print("stopped before training began: nothing was written")
        raise
    folder = outcome.run.path
    if outcome.signal is not None:
        outcome.check_saved()
        console.print(f"stopped at step {outcome.progress.step:,} and saved: resume with")
        say(console, f"    {resume_line(folder)}")
        return 128 + outcome.signal
    try:
        summarize(outcome, console)
    except KeyboardInterrupt:
        outcome.check_saved()
        say(console, f"{folder} is trained and saved")
        raise
    outcome.check_saved()
    return 0


def _fit(
    config: TrainConfig,
    what: str,
    resumed: tuple[Run, Checkpoint | None] | None,
    source: Source,
    skip_damaged: bool,
    console: Console,
) -> Outcome:
    """Train with the live view; the trainer and the files that it maps are gone at the end."""
    with ExitStack() as stack:
        view = LiveView(console, _scale(config))
        status = console.status("building the scene and timing this machine", spinner="line")
        with status, attended(_STOPPING):
            trainer = Trainer(
                config, [view], source=source, resumed=resumed, skip_damaged=skip_damaged
            )
            stack.enter_context(trainer)
        done = resumed[1].step if resumed and resumed[1] else 0
        console.print(_outlook(trainer.setup, what, done))
        seconds = trainer.setup.timing.seconds(trainer.config)
        if resumed is None and source.preset != "laptop" and seconds > DAY:
            console.print("that is more than a day: --preset laptop is made for such a machine")
        try:
            outcome = trainer.fit()
        except MerlError as error:
            with ending(error.exit_code, f"{_UNCLOSED}; error: {error}"):
                stack.close()
            raise
        with ending(*_end(outcome)):
            stack.close()
        return outcome


def _end(outcome: Outcome) -> tuple[int, str]:
    """Return exit code and line for a run whose environment cannot be closed."""
    try:
        outcome.check_saved()
    except MerlError as error:
        return error.exit_code, f"{_UNCLOSED}; error: {error}"
    if outcome.signal is None:
        return 0, f"{_UNCLOSED}; {outcome.run.path} is trained and saved"
    stopped = f"stopped at step {outcome.progress.step:,} and saved"
    line = resume_line(outcome.run.path)
    return 128 + outcome.signal, f"{_UNCLOSED}; {stopped}: resume with `{line}`"


def _scale(config: TrainConfig) -> dict[str, float]:
    """Return the reference returns for the live view; none for an unknown environment."""
    known = references(config.task, config.evaluated.env, config.eval.max_episode_steps)
    return {row.name: row.returns.mean for row in known if row.name in (RANDOM, EXPERT)}


def _outlook(setup: Setup, what: str, done: int) -> str:
    """Return lines that describe the run: its duration, inputs, speed and memory."""
    config, timing = setup.config, setup.timing
    size = decimal(setup.replay_spec.bytes)
    updates = ", ".join(f"{1000 * s:.3g} ms in {how}" for how, s in timing.update.items())
    has_images = not config.has_user_env and any(m.stacked for m in setup.spec.modalities.values())
    images = f" ({config.env.renderer} images)" if has_images else ""
    lines = [f"{what}: {duration(config, timing, done)}"]
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


def duration(config: TrainConfig, timing: Timing, done: int) -> str:
    """Return how many steps remain and how long they take, in one line.

    Args:
        config: the config of the run.
        timing: the measured times of a step and of an update.
        done: steps that the run has already taken.
    """
    left = config.steps - done
    steps = counted(left, "step")
    limit = None if config.minutes is None else counted(config.minutes, "minute")
    where = f"of {config.task} on {config.device}"
    if not timing.knows_env:
        bound = "" if limit is None else f" in at most {limit}"
        return f"{steps} {where}{bound}"
    seconds = timing.seconds(replace(config, minutes=None), done)
    about = f"about {timedelta(seconds=round(seconds))}"
    if config.minutes is not None and seconds > 60 * config.minutes:
        return f"{limit} {where} ({steps} would take {about})"
    bound = "" if limit is None else f", at most {limit}"
    return f"{steps} {where} {'takes' if left == 1 else 'take'} {about}{bound}"
