"""merl train, merl resume."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Literal, cast

import torch
import tyro
from rich.console import Console
from rich.filesize import decimal

from merl.cli.parsing import parse, program
from merl.cli.summary import summarize
from merl.core import MerlError, is_image
from merl.experiments.presets import PRESETS, compose
from merl.replay import replay_bytes
from merl.training.checkpoint import Checkpoint
from merl.training.config import Setting, TrainConfig
from merl.training.console import ConsoleView
from merl.training.run import Run
from merl.training.trainer import Trainer


def train(args: list[str]) -> int:
    """Train an agent: merl train TASK [--preset paper|laptop|state|smoke] [--steps N] ..."""
    preset, why = _choose_preset(args)
    agent = _given(args, "--agent")
    setting = cast(Setting, _given(args, "--setting") or "matched")  # `compose` checks it
    default = compose(preset, tyro.MISSING, agent, setting)
    task = parse(TrainConfig, "merl train", args, default=default).task
    config = parse(TrainConfig, "merl train", args, default=compose(preset, task, agent, setting))
    if config.own_env and config.env != default.env:
        changed = [
            f"--{field.name.replace('_', '-')}"
            for field in dataclasses.fields(config.env)
            if getattr(config.env, field.name) != getattr(default.env, field.name)
        ]
        raise MerlError(
            f"{', '.join(changed)} is for merl's own tasks: {config.task} decides for itself how "
            "it is seen"
        )
    return _train(config, f"preset {preset} ({why}; {PRESETS[preset].about})")


def resume(args: list[str]) -> int:
    """Go on with a run: merl resume RUN [--steps N] [--minutes N]."""
    options = parse(ResumeOptions, "merl resume", args)
    run = Run.open(options.run)
    with run.lock():
        start = Checkpoint.find(run.checkpoints)
        config = _resumed_config(run, start, options)
        evaluated = start.state()["progress"]["evaluated"]
        if start.step >= config.steps and evaluated == start.step:
            steps = f"{start.step:,} of {config.steps:,} steps"
            print(f"{run.path} is done: {steps}; --steps N takes it further")
            return 0
        if not run.replay.is_dir():
            raise MerlError(f"{run.replay} is gone, and without its replay a run cannot go on")
        return _train(config, f"run {run.path} goes on at step {start.step:,}", (run, start))


def _resumed_config(run: Run, start: Checkpoint, options: ResumeOptions) -> TrainConfig:
    """The run's config with what the user changes; on another machine what it decided is open."""
    steps = options.steps or run.config.steps
    if options.steps is not None and start.step > steps:
        raise MerlError(f"--steps {steps} is less than the {start.step:,} already taken")
    config = dataclasses.replace(run.config, minutes=options.minutes, steps=steps)
    if run.has_moved() or options.device not in (None, config.device):
        agent = dataclasses.replace(config.agent, precision="auto")
        config = dataclasses.replace(config, threads=None, agent=agent)
    return dataclasses.replace(config, device=options.device or config.device)


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


def _train(config: TrainConfig, what: str, resumed: tuple[Run, Checkpoint] | None = None) -> int:
    console = Console()
    with ExitStack() as stack:
        try:
            with console.status("building the scene and timing this machine"):
                trainer = stack.enter_context(Trainer.prepare(config, new=resumed is None))
        except KeyboardInterrupt:
            console.print("stopped before training began: nothing was written")
            raise
        done = resumed[1].step if resumed else 0
        console.print(_outlook(trainer, what, done), highlight=False)
        with ConsoleView(console) as view:
            outcome = trainer.resume(*resumed, view) if resumed else trainer.start(view)
    folder = outcome.run.path
    if outcome.signal is not None:
        stopped = f"stopped at step {outcome.progress.step:,}"
        how = (
            "and saved: go on" if outcome.saved else "and not saved: go on from the last checkpoint"
        )
        console.print(f"{stopped} {how} with")
        console.print(f"    {program()} resume {folder}", highlight=False, soft_wrap=True)
        return 128 + outcome.signal
    try:
        summarize(outcome, console)
    except KeyboardInterrupt:
        console.print(f"{folder} is trained and saved", highlight=False, soft_wrap=True)
        raise
    return 0


def _outlook(trainer: Trainer, what: str, done: int) -> str:
    """What is going to happen, and how long it will take on this machine."""
    config, timing = trainer.config, trainer.timing
    seconds = timing.seconds(config, done)
    size = replay_bytes(config.replay, trainer.space, trainer.action_space, config.capacity)
    tried = ", ".join(f"{1000 * s:.0f} ms in {how}" for how, s in timing.update.items())
    seen = not config.own_env and any(is_image(space) for space in trainer.space.values())
    pictures = f" ({config.env.renderer} pictures)" if seen else ""
    lines = [
        f"{what}: {_amount(config, done)} of {config.task} on {config.device} take about "
        f"{timedelta(seconds=round(seconds))}",
    ]
    if seconds > 86_400 and config.preset != "laptop":
        lines.append("that is beyond a day: --preset laptop is made for a machine like this one")
    lines += [
        f"an update takes {tried}; acting takes {1000 * timing.step:.1f} ms a step{pictures}",
        f"the replay takes {decimal(size)} for {config.capacity:,} steps",
    ]
    if (config.steps - config.seed_steps) * config.updates_per_step < 1:
        lines.append(
            f"nothing will be learnt: the first update comes after {config.seed_steps:,} steps, "
            "with --updates-per-step above 0"
        )
    return "\n".join(lines)


def _amount(config: TrainConfig, done: int) -> str:
    """How much there is to do."""
    steps = f"{config.steps - done:,} steps"
    return steps if config.minutes is None else f"{config.minutes:g} minutes, or {steps},"


def _choose_preset(args: list[str]) -> tuple[str, str]:
    """The preset's name and why it is this one."""
    name = _given(args, "--preset")
    if name is not None:
        return name, "as asked for"
    if torch.cuda.is_available():
        return "paper", "CUDA is there"
    return "laptop", "no CUDA here"


def _given(args: list[str], flag: str) -> str | None:
    """What a flag is given, before the whole line is parsed; of two, the last one counts."""
    for index, arg in reversed(list(enumerate(args))):
        if arg == flag and index + 1 < len(args):
            return args[index + 1]
        if arg.startswith(f"{flag}="):
            return arg.removeprefix(f"{flag}=")
    return None
