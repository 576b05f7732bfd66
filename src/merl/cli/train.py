"""merl train, merl resume."""

from __future__ import annotations

import dataclasses
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.console import Console
from rich.filesize import decimal

from merl.cli.parsing import meant, parse
from merl.cli.summary import summarize
from merl.core import MerlError
from merl.experiments.presets import ABOUT, PRESETS
from merl.replay import replay_bytes
from merl.training.checkpoint import Checkpoint
from merl.training.config import TrainConfig
from merl.training.console import ConsoleView
from merl.training.run import Run
from merl.training.trainer import Trainer


def train(args: list[str]) -> int:
    """Train an agent: merl train TASK [--preset paper|laptop|smoke] [--steps N] ..."""
    preset, why = _choose_preset(args)
    config = parse(TrainConfig, "merl train", args, default=PRESETS[preset])
    return _train(config, f"preset {preset} ({why}; {ABOUT[preset]})")


def resume(args: list[str]) -> int:
    """Go on with a run: merl resume RUN [--steps N] [--minutes N]."""

    def command(
        run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
        steps: int | None = None,
        minutes: float | None = None,
    ) -> tuple[Path, dict[str, Any]]:
        """Go on with a run from its last checkpoint.

        Args:
            run: The run's folder.
            steps: Train to this many steps in all, in place of what the run was started with.
            minutes: Stop after this many minutes in all; if not set, only the steps count.
        """
        changes: dict[str, Any] = {"minutes": minutes}
        return run, changes | ({} if steps is None else {"steps": steps})

    folder, changes = parse(command, "merl resume", args)
    run = Run.open(folder)
    config = dataclasses.replace(run.config, **changes)
    step = Checkpoint.find(run.checkpoints).step
    if step >= config.steps:
        print(f"{folder} is done: {step:,} of {config.steps:,} steps; --steps N takes it further")
        return 0
    return _train(
        config, f"run {folder} goes on at step {step:,}", resumed=Run(run.path, config), done=step
    )


def _train(config: TrainConfig, what: str, resumed: Run | None = None, done: int = 0) -> int:
    console = Console()
    with Trainer.prepare(config) as trainer:
        if resumed is None:
            trainer.check()
        console.print(_outlook(trainer, what, done), highlight=False)
        with ConsoleView(console) as view:
            outcome = trainer.resume(resumed, view) if resumed else trainer.start(view)
    folder = outcome.run.path
    if outcome.signal is not None:
        console.print(f"stopped at step {outcome.progress.step:,} and saved: go on with")
        console.print(f"    merl resume {folder}", highlight=False, soft_wrap=True)
        return 128 + outcome.signal
    summarize(outcome, console)
    return 0


def _outlook(trainer: Trainer, what: str, done: int) -> str:
    """What is going to happen, and how long it will take on this machine."""
    config, timing = trainer.config, trainer.timing
    seconds = timing.seconds(config, done)
    size = replay_bytes(config.replay, trainer.space, trainer.action_space, config.capacity)
    tried = ", ".join(f"{1000 * s:.0f} ms in {how}" for how, s in timing.update.items())
    lines = [
        f"{what}: {config.steps - done:,} steps of {config.task} on {config.device} take about "
        f"{timedelta(seconds=round(seconds))}",
    ]
    if seconds > 86_400 and config.preset != "laptop":
        lines.append("that is beyond a day: --preset laptop is made for a machine like this one")
    lines += [
        f"an update takes {tried}; a step takes {1000 * timing.step:.1f} ms "
        f"({config.env.renderer} pictures)",
        f"the replay takes {decimal(size)} for {config.capacity:,} steps",
    ]
    return "\n".join(lines)


def _choose_preset(args: list[str]) -> tuple[str, str]:
    """The preset's name and why it is this one."""
    for index, arg in enumerate(args):
        name = None
        if arg == "--preset" and index + 1 < len(args):
            name = args[index + 1]
        elif arg.startswith("--preset="):
            name = arg.removeprefix("--preset=")
        if name is not None:
            if name not in PRESETS:
                raise MerlError(f"preset {name!r} is unknown: {meant(name, PRESETS)}")
            return name, "as asked for"
    if torch.cuda.is_available():
        return "paper", "CUDA is there"
    return "laptop", "no CUDA here"
