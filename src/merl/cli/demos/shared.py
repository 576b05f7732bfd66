"""What the actions of merl demos share: their options, the environment, and what they print."""

from __future__ import annotations

import dataclasses
import shlex
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from merl.acting.instances import EnvRecipe
from merl.cli.parsing import parse
from merl.core import check_choice, counted
from merl.core.fields import check_fields
from merl.core.statistics import bootstrap_interval
from merl.demos.demonstrations import Demonstrations
from merl.envs.config import EnvConfig
from merl.envs.registration import ENV_IDS
from merl.envs.user_env import load_module
from merl.experiments.experiment import flags
from merl.experiments.presets import PRESETS, compose, default_preset


@dataclass(frozen=True)
class Choice:
    """The option on which the defaults of the others depend."""

    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    """The images are those of this preset of `merl train`; by default the one of this machine."""


@dataclass(frozen=True)
class EnvOptions:
    """The environment of demonstrations."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """Task of merl, Gymnasium id, or module:function, as in `merl train`."""
    choice: Annotated[Choice, tyro.conf.arg(name="")]
    out: Path | None = None
    """Folder of the demonstrations; by default demos/TASK."""

    def __post_init__(self) -> None:
        check_fields(self, "--")

    @property
    def folder(self) -> Path:
        """Folder of the demonstrations."""
        return self.out or Path("demos", self.task.replace(":", "-").replace("/", "-"))


@dataclass(frozen=True)
class FolderOptions:
    """A folder of demonstrations."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the demonstrations."""


def with_env(kind: type[Any], action: str, args: list[str]) -> tuple[Any, str]:
    """Parse options with the defaults of a preset; return them and the preset."""
    prog, rest = f"merl demos {action}", list[str]()
    preset = parse(Choice, prog, args, rest=rest).preset or default_preset()
    check_choice("preset", preset, tuple(PRESETS))
    env = compose(preset, "reach_duplo").env
    default = kind(
        task=tyro.MISSING,
        choice=Choice(preset),
        env=dataclasses.replace(env, observations=(*env.observations, "state")),
    )
    return parse(kind, prog, args, default=default), preset


def make(options: Any, stack: ExitStack, render_mode: str | None = None) -> Any:
    """Make the environment of demonstrations, which closes with the stack."""
    if ":" in options.task:
        load_module(options.task, Path.cwd())
    recipe = EnvRecipe(options.task, options.env, options.user_env, action_repeat=1)
    made = recipe.instance(render_mode)
    stack.callback(made.close)
    return made


def describe(console: Console, demos: Demonstrations) -> None:
    """Print what a folder of demonstrations holds."""
    lines = demos.lines
    say = partial(console.print, highlight=False, soft_wrap=True)
    say(f"{demos.path}: {counted(len(lines), 'episode')} of {demos.task} by {demos.source}")
    for key, space in demos.observation_space.spaces.items():
        say(f"  {key}: {space.dtype} {space.shape}")
    if not lines:
        return
    steps = [line.steps for line in lines]
    returns = bootstrap_interval([line.returned for line in lines])
    say(f"{counted(sum(steps), 'step')}, {min(steps)} to {max(steps)} in an episode")
    say(f"return {returns.mean:.4g} [{returns.low:.4g}, {returns.high:.4g}]")
    told = [line.success for line in lines if line.success is not None]
    if told:
        say(f"success at the end in {sum(told)} of {len(told)}")


def tell_line(console: Console, options: Any, preset: str, keys: tuple[str, ...] = ()) -> None:
    """Print the command that learns from the demonstrations, with these keys alone."""
    given: list[str] = flags("agent.keys", keys) if keys else []
    if options.task in ENV_IDS:
        usual = compose(preset, "reach_duplo").env
        for each in dataclasses.fields(EnvConfig):
            value, before = getattr(options.env, each.name), getattr(usual, each.name)
            if each.name == "observations":
                before = (*before, "state")
            if value != before:
                given += flags(f"env.{each.name}", value)
    line = ["merl", "train", options.task, "--preset", preset, *given]
    line += ["--demos", str(options.folder)]
    console.print(f"learn from them: {shlex.join(line)}", highlight=False, soft_wrap=True)
