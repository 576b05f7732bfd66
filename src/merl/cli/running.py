"""A run from the command line: what is told before it, and after it."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack

from rich.console import Console
from rich.filesize import decimal

from merl.cli.duration import DurationView, duration
from merl.cli.summary import summarize
from merl.core import MerlError, counted, is_image
from merl.replay import replay_bytes
from merl.training import trainer
from merl.training.checkpoint import Checkpoint
from merl.training.config import TrainConfig
from merl.training.console import ConsoleView
from merl.training.environment import own_bounds
from merl.training.parts import Parts
from merl.training.resuming import taken_up
from merl.training.run import Run, resume_line

DAY = 86_400.0  # seconds


def begin(config: TrainConfig, what: str) -> int:
    """Train a new run to its end; returns the exit code.

    Args:
        config: of the run.
        what: it is, for the first line.
    """
    return _train(config, what)


def go_on(run: Run, asked: TrainConfig) -> int:
    """Train a run from its last whole checkpoint to its end; returns the exit code.

    Args:
        run: which.
        asked: the config with which it is to go on.

    Raises:
        MerlError: that would be another run, another process trains it, or it has nothing to go on
            from.
    """
    config, changes = taken_up(run.config, asked)
    if run.has_moved() or config.device != run.config.device:
        # What was decided for another machine or device is open again.
        agent = dataclasses.replace(config.agent, precision="auto", torch_compile="auto")
        config = dataclasses.replace(config, threads=None, agent=agent)
    with run.lock():
        if run.begin_again():
            return _train(config, f"run {run.path} was ended before its first step", (run, None))
        start = Checkpoint.find(run.checkpoints)
        state = start.state()
        if config.steps < min(start.step, run.config.steps):
            raise MerlError(f"--steps {config.steps} is less than the {start.step:,} already taken")
        if start.step >= config.steps and state["progress"]["evaluated"] == start.step:
            steps = f"{start.step:,} of {counted(config.steps, 'step')}"
            print(f"{run.path} is done: {steps}; --steps N takes it further")
            return 0
        if not run.replay.is_dir():
            raise MerlError(f"{run.replay} is gone, and without its replay a run cannot go on")
        what = f"run {run.path} goes on at step {start.step:,}"
        if state["replay"]["open"]:
            what += " (it was stopped in an episode, and begins a new one)"
        if changes:
            what += f" with {', '.join(changes)}"
        return _train(config, what, (run, start))


def _train(
    config: TrainConfig, what: str, resumed: tuple[Run, Checkpoint | None] | None = None
) -> int:
    console = Console(markup=False)
    with ExitStack() as stack:
        try:
            with console.status("building the scene and timing this machine"):
                parts = stack.enter_context(Parts.prepare(config, new=resumed is None))
            if resumed:
                resumed[0].check_environment(parts.space, parts.action_space, own_bounds(parts.env))
            done = resumed[1].step if resumed and resumed[1] else 0
            console.print(_outlook(parts, what, done), highlight=False)
            view = ConsoleView(console) if parts.timing.knows_env else DurationView(console, parts)
            with view:
                if resumed:
                    outcome = trainer.resume(parts, *resumed, view)
                else:
                    outcome = trainer.start(parts, view)
        except KeyboardInterrupt:  # from there on a signal is a wish, see `Interrupt`
            console.print("stopped before training began: nothing was written")
            raise
    folder = outcome.run.path
    if outcome.signal is not None:
        stopped = f"stopped at step {outcome.progress.step:,}"
        how = (
            "and saved: go on" if outcome.saved else "and not saved: go on from the last checkpoint"
        )
        console.print(f"{stopped} {how} with")
        console.print(f"    {resume_line(folder)}", highlight=False, soft_wrap=True)
        return 128 + outcome.signal
    try:
        summarize(outcome, console)
    except KeyboardInterrupt:
        console.print(f"{folder} is trained and saved", highlight=False, soft_wrap=True)
        raise
    return 0


def _outlook(parts: Parts, what: str, done: int) -> str:
    """Return what is going to happen, and how long it will take on this machine."""
    config, timing = parts.config, parts.timing
    size = replay_bytes(
        config.replay, parts.space, parts.action_space, config.capacity, config.num_envs
    )
    tried = ", ".join(f"{1000 * s:.3g} ms in {how}" for how, s in timing.update.items())
    seen = not config.own_env and any(is_image(space) for space in parts.space.values())
    pictures = f" ({config.env.renderer} pictures)" if seen else ""
    lines = [f"{what}: {duration(config, timing, done)}"]
    if timing.seconds(config, done) > DAY and config.preset != "laptop":
        lines.append("that is beyond a day: --preset laptop is made for a machine like this one")
    step = "a step" if timing.knows_env else "a step, without the environment's part"
    lines += [
        f"an update takes {tried}; acting takes {1000 * timing.step:.1f} ms {step}{pictures}",
        f"the replay takes {decimal(size)} for {counted(config.capacity, 'step')}",
    ]
    if timing.not_compiled is not None:
        lines.append(f"updates are not compiled, which fails here: {timing.not_compiled}")
    if (config.steps - config.seed_steps) * config.updates_per_step < 1:
        lines.append(
            "nothing will be learnt: the first update comes after "
            f"{counted(config.seed_steps, 'step')}, with --updates-per-step above 0"
        )
    return "\n".join(lines)
