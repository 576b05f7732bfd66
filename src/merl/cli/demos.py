"""The commands merl demos record and merl demos show."""

from __future__ import annotations

import dataclasses
import shlex
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from gymnasium import spaces
from rich.console import Console

from merl.cli.output import make_console
from merl.cli.parsing import parse
from merl.core import MerlError, check_choice, counted, suggest
from merl.core.fields import Range, check_fields
from merl.core.statistics import bootstrap_interval
from merl.envs import make_env
from merl.envs.config import EnvConfig
from merl.envs.expert import ExpertPolicy
from merl.envs.registration import ENV_IDS
from merl.evaluation.demonstrating import record_episodes
from merl.evaluation.policy import Policy, load_policy
from merl.experiments.experiment import flags
from merl.experiments.presets import PRESETS, compose, default_preset
from merl.runs.demonstrations import Demonstrations, Recorder

ACTIONS = ("record", "show")
EXPERT = "expert"


@dataclass(frozen=True)
class Choice:
    """The option on which the defaults of the others depend."""

    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    """The images are those of this preset of `merl train`; by default the one of this machine."""


@dataclass(frozen=True)
class RecordOptions:
    """Record demonstrations in one of merl's tasks."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="|".join(ENV_IDS))]
    """The task."""
    choice: Annotated[Choice, tyro.conf.arg(name="")]
    source: Annotated[str, tyro.conf.arg(name="from", metavar="expert|RUN")] = EXPERT
    """Who acts: the scripted expert, or the policy of a run."""
    out: Path | None = None
    """Folder of the demonstrations; by default demos/TASK."""
    episodes: Annotated[int, Range(1, 100_000)] = 50
    """Number of episodes."""
    noise: Annotated[float, Range(0, 1)] = 0.1
    """Standard deviation of Gaussian noise on every action: it shows how to recover from errors."""
    seed: Annotated[int, Range(0, 10_000)] = 0
    """Selects the start states and the noise."""
    failures: tyro.conf.FlagCreatePairsOff[bool] = False
    """Keep episodes that do not end in success."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)

    def __post_init__(self) -> None:
        check_fields(self, "--")


@dataclass(frozen=True)
class ShowOptions:
    """Show what a folder of demonstrations holds."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the demonstrations."""


@dataclass(frozen=True)
class DemosOptions:
    """Record or show demonstrations; for tab completion."""

    action: Annotated[
        Annotated[RecordOptions, tyro.conf.subcommand("record")]
        | Annotated[ShowOptions, tyro.conf.subcommand("show")],
        tyro.conf.arg(name=""),
    ]
    """What to do."""


def demos(args: list[str]) -> int:
    """Record or show demonstrations: merl demos record TASK, merl demos show DIR."""
    action, *rest = args or ["--help"]
    if action in ("-h", "--help"):
        print(
            "usage: merl demos ACTION ...\n\n"
            "  record      record demonstrations of the expert or of a policy\n"
            "  show        show what a folder of demonstrations holds\n\n"
            "merl demos ACTION --help shows its options."
        )
        return 0
    if action not in ACTIONS:
        raise MerlError(f"merl demos {action!r} is unknown: {suggest(action, ACTIONS)}")
    return {"record": record, "show": show}[action](rest)


def record(args: list[str]) -> int:
    """Record demonstrations."""
    rest: list[str] = []
    preset = parse(Choice, "merl demos record", args, rest=rest).preset or default_preset()
    check_choice("preset", preset, tuple(PRESETS))
    env = compose(preset, "reach_duplo").env
    default: Any = RecordOptions(
        task=tyro.MISSING,
        choice=Choice(preset),
        env=dataclasses.replace(env, observations=(*env.observations, "state")),
    )
    options: RecordOptions = parse(RecordOptions, "merl demos record", args, default=default)
    check_choice("task", options.task, tuple(ENV_IDS))
    console = make_console()
    settings = {f.name: getattr(options.env, f.name) for f in dataclasses.fields(options.env)}
    with ExitStack() as stack:
        made = make_env(options.task, **settings)
        stack.callback(made.close)
        policy: ExpertPolicy | Policy = (
            ExpertPolicy(made) if options.source == EXPERT else load_policy(options.source)
        )
        if isinstance(policy, Policy) and policy.config.task != options.task:
            raise MerlError(
                f"{options.source} was trained on {policy.config.task}, not on {options.task}: "
                "name another run with --from"
            )
        out = options.out or Path("demos", options.task)
        source = f"{options.source}, noise {options.noise:g}"
        assert isinstance(made.observation_space, spaces.Dict)
        assert isinstance(made.action_space, spaces.Box)
        form = {name: settings[name] for name in ("reward", "start", "occluded")}
        recorder = Recorder(
            out, options.task, source, made.observation_space, made.action_space, form
        )
        found = record_episodes(
            policy,
            made,
            options.episodes,
            reset=policy.reset,
            noise=options.noise,
            seed=options.seed,
            failures=options.failures,
        )
        with console.status("recording", spinner="line"):
            for episode in found:
                recorder.add(episode)
    _describe(console, recorder.demonstrations)
    changed = {
        f"env.{name}": value
        for name, value in settings.items()
        if name != "observations" and value != getattr(env, name)
    }
    given = [part for name, value in changed.items() for part in flags(name, value)]
    line = ["merl", "train", options.task, "--preset", preset, *given, "--replay.demos", str(out)]
    console.print(f"learn from them: {shlex.join(line)}", highlight=False, soft_wrap=True)
    return 0


def show(args: list[str]) -> int:
    """Show demonstrations."""
    options = parse(ShowOptions, "merl demos show", args)
    found = Demonstrations.open(options.folder)
    for _ in found.episodes():  # check that all can be read
        pass
    _describe(make_console(), found)
    return 0


def _describe(console: Console, demos: Demonstrations) -> None:
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
