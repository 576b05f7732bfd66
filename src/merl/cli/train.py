"""The command merl train."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from merl.agents import AGENTS
from merl.agents.config import ObservationConfig
from merl.cli.parsing import parse
from merl.cli.running import Damaged, begin, go_on
from merl.config import ActorsConfig, Setting, Source, TrainConfig, flat
from merl.core import CONFIG_FILE, MerlError
from merl.experiments.cloning_first import starts_cloned
from merl.experiments.presets import PRESETS, compose, default_preset
from merl.link.protocol import PORT
from merl.runs.resume import decided, left_open
from merl.runs.run import Run

PROG = "merl train"
LEARNER: dict[str, Any] = {
    "actors": ActorsConfig(listen=f"127.0.0.1:{PORT}"),
    "random_steps": 0,
    "num_envs": 1,
}
"""Defaults of `merl learner` that differ from those of `merl train`."""


@dataclass(frozen=True)
class Choice:
    """The options on which the defaults of all others depend."""

    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    """Set of default values for the other options: paper (Table 1, for a machine with CUDA), laptop
    (2 cores without a GPU), demos (from demonstrations first), state (from the simulator's state)
    or smoke (a test in a minute)."""
    agent: Annotated[str | None, tyro.conf.arg(metavar="|".join([*AGENTS, "MODULE:CLASS"]))] = None
    """Agent and the observations that it uses. merl: camera and joints; drqv2: camera; proprio:
    joints; merl_state, ddpg, sac: state; module:Class: your own."""
    setting: Setting = "matched"
    """Source of the agent's hyperparameters: MERL and the preset (matched), or the agent's authors
    (published)."""


@dataclass(frozen=True)
class TrainOptions:
    """Train an agent on a task."""

    choice: Annotated[Choice, tyro.conf.arg(name="")]
    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Resume the run in --run-dir if there is one, else start it. A job that may be stopped at any
    time can be submitted again with the same command."""
    damaged: Damaged = "refuse"
    """With --resume, if a part of the replay is damaged: do not resume, or skip the episodes with
    damage."""


@dataclass(frozen=True)
class _First(Choice):
    """What is parsed first, before the defaults of the other options are known."""

    help: Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(aliases=["-h"])] = False


def train(args: list[str], *, acts: bool = True) -> int:
    """Train an agent: merl train TASK [--preset paper|laptop|demos|state|smoke] [--steps N] ...

    Args:
        args: the arguments after the command's name.
        acts: whether the run acts itself; False: it is `merl learner`, with other defaults.
    """
    rest: list[str] = []
    prog = PROG if acts else "merl learner"
    first = parse(_First, prog, args, rest=rest)
    preset = default_preset() if first.preset is None else first.preset
    source = Source(preset, first.setting)

    def composed(task: str) -> TrainConfig:
        config = compose(preset, task, first.agent, first.setting)
        return config if acts else dataclasses.replace(config, **LEARNER)

    def options(default: TrainConfig) -> TrainOptions:
        choice = Choice(preset, default.agent_name, first.setting)
        agent = dataclasses.replace(default.agent, **_by_key(rest, default.agent))
        without_task = dataclasses.replace(default, task=tyro.MISSING, agent=agent)
        return parse(TrainOptions, prog, args, default=TrainOptions(choice, without_task))

    default, given_open = composed("reach_duplo"), set[str]()
    if not first.help:  # the help shows the defaults of a task of merl's own
        closed = decided(default)
        asked = options(closed).config
        default, given_open = composed(asked.task), {*left_open(asked)} - {*left_open(closed)}
    chosen = options(default)
    config = chosen.config
    _refuse_foreign(config, default)
    if chosen.resume:
        if config.run_dir is None:
            raise MerlError("--resume needs --run-dir: name the folder of the run to resume")
        if (config.run_dir / CONFIG_FILE).exists():
            run = Run.open(config.run_dir)
            if run.config.agent_name == config.agent_name:  # otherwise `go_on` refuses
                run = run.with_agent(named_in=Path.cwd())
            asked, skip = starts_cloned(config, run), chosen.damaged == "skip"
            return go_on(run, asked, given_open, named_in=Path.cwd(), skip_damaged=skip)
    why = "CUDA is available" if preset == "paper" else "CUDA is not available"
    reason = why if first.preset is None else "as requested"
    return begin(config, source, f"preset {preset} ({reason}; {PRESETS[preset].about})")


def _by_key(args: list[str], agent: ObservationConfig) -> dict[str, Any]:
    """Return the agent's options for single keys, `--agent.encoders.KEY`, with empty values.

    tyro makes a flag for each key of a default, and the user's environment defines the keys.
    """
    found: dict[str, dict[str, str]] = {}
    for field in ("encoders", "encoder_weights"):
        start = f"--agent.{field.replace('_', '-')}."
        keys = [arg.partition("=")[0].removeprefix(start) for arg in args if arg.startswith(start)]
        if keys and hasattr(agent, field):
            found[field] = dict.fromkeys(keys, "")
    return found


def _refuse_foreign(config: TrainConfig, default: TrainConfig) -> None:
    """Refuse options of merl's tasks for a user's environment, and the other way round.

    Raises:
        MerlError: such an option differs from its default.
    """
    before = flat(default)
    changed = [name for name, value in flat(config).items() if value != before[name]]
    if config.has_user_env:
        flags = [name.partition(".")[2] for name in changed if name.startswith("env.")]
        whose = f"merl's own tasks: {config.task} defines its own observations"
    else:
        flags = [name.removeprefix("user_") for name in changed if name.startswith("user_env.")]
        whose = f"your own environment: omit it for {config.task}"
    if flags:
        named = ", ".join(f"--{flag.replace('_', '-')}" for flag in flags)
        raise MerlError(f"{named} is for {whose}")
