"""The command merl train."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

import tyro

from merl.cli.parsing import parse
from merl.cli.running import begin, go_on
from merl.config import Setting, TrainConfig
from merl.core import CONFIG_FILE, MerlError
from merl.experiments.presets import PRESETS, compose, default_preset
from merl.runs.resume import decided, left_open
from merl.runs.run import Run


@dataclass(frozen=True)
class TrainOptions:
    """Train an agent on a task."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Resume the run in --run-dir if there is one, else start it. A job that may be stopped at any
    time can be submitted again with the same command."""


def train(args: list[str]) -> int:
    """Train an agent: merl train TASK [--preset paper|laptop|state|smoke] [--steps N] ..."""
    preset, why = _choose_preset(args)
    agent = _given(args, "--agent")
    setting = cast(Setting, _given(args, "--setting") or "matched")  # `compose` checks it
    default = compose(preset, tyro.MISSING, agent, setting)
    task = _parse(args, default).config.task
    options = _parse(args, compose(preset, task, agent, setting))
    config = options.config
    if config.own_env and config.env != default.env:
        changed = [
            f"--{field.name.replace('_', '-')}"
            for field in dataclasses.fields(config.env)
            if getattr(config.env, field.name) != getattr(default.env, field.name)
        ]
        raise MerlError(
            f"{', '.join(changed)} is for merl's own tasks: {config.task} defines its own "
            "observations"
        )
    if not config.own_env and config.user_env != default.user_env:
        raise MerlError(
            "--env.image-layout and --env.allow-wide-actions are for your own environment: "
            f"omit them for {config.task}"
        )
    if options.resume:
        if config.run_dir is None:
            raise MerlError("--resume needs --run-dir: name the folder of the run to resume")
        if (config.run_dir / CONFIG_FILE).exists():
            closed = decided(compose(preset, task, agent, setting))
            given_open = {*left_open(_parse(args, closed).config)} - {*left_open(closed)}
            run = Run.open(config.run_dir)
            if run.config.agent_name == config.agent_name:  # otherwise `go_on` refuses
                run = run.with_agent(named_in=Path.cwd())
            return go_on(run, config, given_open, named_in=Path.cwd())
    return begin(config, f"preset {preset} ({why}; {PRESETS[preset].about})")


def _parse(args: list[str], default: TrainConfig) -> TrainOptions:
    return parse(TrainOptions, "merl train", args, default=TrainOptions(default))


def _choose_preset(args: list[str]) -> tuple[str, str]:
    """Return the preset's name and the reason for the choice."""
    name = _given(args, "--preset")
    if name is not None:
        return name, "as requested"
    name = default_preset()
    return name, "CUDA is available" if name == "paper" else "CUDA is not available"


def _given(args: list[str], flag: str) -> str | None:
    """Return the value of a flag, before all arguments are parsed; the last occurrence counts."""
    for index, arg in reversed(list(enumerate(args))):
        if arg == flag and index + 1 < len(args):
            return args[index + 1]
        if arg.startswith(f"{flag}="):
            return arg.removeprefix(f"{flag}=")
    return None
