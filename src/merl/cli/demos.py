"""The command merl demos: record, show, import and export demonstrations."""

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

from merl.acting.run_env import own_bounds
from merl.cli.output import make_console
from merl.cli.parsing import parse
from merl.core import MerlError, check_choice, counted, suggest
from merl.core.fields import Range, check_fields
from merl.core.statistics import bootstrap_interval
from merl.demos.demonstrations import Demonstrations
from merl.demos.exporting import Format, export_demos
from merl.demos.importing import Actions, Rules, Target, import_demos, open_source
from merl.demos.recorder import Recorder
from merl.envs import make_env
from merl.envs.config import EnvConfig, UserEnvConfig
from merl.envs.expert import ExpertPolicy
from merl.envs.frame_rate import frame_rate
from merl.envs.registration import ENV_IDS
from merl.envs.user_env import check_task, make_user_env
from merl.evaluation.demonstrating import record_episodes
from merl.evaluation.policy import Policy, load_policy
from merl.experiments.experiment import flags
from merl.experiments.presets import PRESETS, compose, default_preset

ACTIONS = {
    "record": "record demonstrations of the expert or of a policy",
    "show": "show what a folder of demonstrations holds",
    "import": "convert a LeRobotDataset v3, a robomimic file or a Minari dataset",
    "export": "write demonstrations in one of these formats",
}
EXPERT = "expert"


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
class RecordOptions(EnvOptions):
    """Record demonstrations."""

    source: Annotated[str, tyro.conf.arg(name="from", metavar="expert|RUN")] = EXPERT
    """Who acts: the scripted expert (in merl's own tasks), or the policy of a run."""
    episodes: Annotated[int, Range(1, 100_000)] = 50
    """Number of episodes."""
    noise: Annotated[float, Range(0, 1)] = 0.1
    """Standard deviation of Gaussian noise on every action: it shows how to recover from errors."""
    seed: Annotated[int, Range(0, 10_000)] = 0
    """Selects the start states and the noise."""
    failures: tyro.conf.FlagCreatePairsOff[bool] = False
    """Keep episodes that do not end in success."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    user_env: Annotated[UserEnvConfig, tyro.conf.arg(name="env")] = field(
        default_factory=UserEnvConfig
    )


@dataclass(frozen=True)
class ImportOptions(EnvOptions):
    """Convert demonstrations in the format of another project, and check that they fit a task."""

    source: Annotated[Path | None, tyro.conf.arg(name="from", metavar="PATH")] = None
    """The folder of a LeRobotDataset v3 or of a Minari dataset, or an HDF5 file of robomimic."""
    keys: dict[str, str] = field(default_factory=dict)
    """The source's feature for an observation of the environment, e.g. `image
    observation.images.front`; one that is not named takes the feature of its own name."""
    leave_out: tuple[str, ...] = ()
    """Observations of the environment that the source does not have."""
    actions: Actions = "unit"
    """Unit of the source's actions: in [-1, 1] (unit), or the environment's own (env)."""
    clip: tyro.conf.FlagCreatePairsOff[bool] = False
    """Clip actions that are out of range."""
    resize: tyro.conf.FlagCreatePairsOff[bool] = False
    """Resize images that have another size."""
    any_rate: tyro.conf.FlagCreatePairsOff[bool] = False
    """Accept another number of steps per second than the environment's."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    user_env: Annotated[UserEnvConfig, tyro.conf.arg(name="env")] = field(
        default_factory=UserEnvConfig
    )


@dataclass(frozen=True)
class FolderOptions:
    """A folder of demonstrations."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the demonstrations."""


@dataclass(frozen=True)
class ShowOptions(FolderOptions):
    """Show what a folder of demonstrations holds."""


@dataclass(frozen=True)
class ExportOptions(FolderOptions):
    """Write demonstrations in the format of another project."""

    to: Format = "lerobot"
    """Format: a LeRobotDataset v3, an HDF5 file of robomimic, or a dataset of Minari."""
    out: Path | None = None
    """The new folder or file; by default DIR-FORMAT, or DIR.hdf5."""
    rate: Annotated[float, Range(0, 1000, without=0)] | None = None
    """Steps per second; by default those of the task, if it is one of merl's."""
    lossless: tyro.conf.FlagCreatePairsOff[bool] = False
    """Store the images of a LeRobotDataset as PNG, in place of videos."""

    def __post_init__(self) -> None:
        check_fields(self, "--")


@dataclass(frozen=True)
class DemosOptions:
    """Record, show, import or export demonstrations; for tab completion."""

    action: Annotated[
        Annotated[RecordOptions, tyro.conf.subcommand("record")]
        | Annotated[ShowOptions, tyro.conf.subcommand("show")]
        | Annotated[ImportOptions, tyro.conf.subcommand("import")]
        | Annotated[ExportOptions, tyro.conf.subcommand("export")],
        tyro.conf.arg(name=""),
    ]
    """What to do."""


def demos(args: list[str]) -> int:
    """Record, show, import or export demonstrations: merl demos record TASK, ..."""
    action, *rest = args or ["--help"]
    if action in ("-h", "--help"):
        lines = [f"  {name:<12}{about}" for name, about in ACTIONS.items()]
        print("\n".join(["usage: merl demos ACTION ...", "", *lines, ""]))
        print("merl demos ACTION --help shows its options.")
        return 0
    if action not in ACTIONS:
        raise MerlError(f"merl demos {action!r} is unknown: {suggest(action, tuple(ACTIONS))}")
    run = {"record": record, "show": show, "import": import_, "export": export}[action]
    return run(rest)


def record(args: list[str]) -> int:
    """Record demonstrations."""
    options, preset = _with_env(RecordOptions, "record", args)
    check_task(options.task)
    own_task = options.task in ENV_IDS
    if options.source == EXPERT and not own_task:
        raise MerlError(
            f"there is no expert for {options.task}: name a run with --from, or record episodes of "
            "your own with Python (docs/howto/demonstrations.md)"
        )
    console = make_console()
    with ExitStack() as stack:
        made = _make(options, stack)
        policy: ExpertPolicy | Policy = (
            ExpertPolicy(made) if options.source == EXPERT else load_policy(options.source)
        )
        if isinstance(policy, Policy) and policy.config.task != options.task:
            raise MerlError(
                f"{options.source} was trained on {policy.config.task}, not on {options.task}: "
                "name another run with --from"
            )
        source = f"{options.source}, noise {options.noise:g}"
        form = {n: getattr(options.env, n) for n in ("reward", "start", "occluded") if own_task}
        recorder = Recorder(
            options.folder, options.task, source, made.observation_space, made.action_space, form
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
    _tell_line(console, options, preset)
    return 0


def show(args: list[str]) -> int:
    """Show demonstrations."""
    options = parse(ShowOptions, "merl demos show", args)
    found = Demonstrations.open(options.folder)
    for _ in found.episodes():  # check that all can be read
        pass
    _describe(make_console(), found)
    return 0


def import_(args: list[str]) -> int:
    """Import demonstrations."""
    options, preset = _with_env(ImportOptions, "import", args)
    if options.source is None:
        raise MerlError("merl demos import needs the folder or file to convert: --from PATH")
    source = open_source(options.source)
    with ExitStack() as stack:
        made = _make(options, stack)
        assert isinstance(made.observation_space, spaces.Dict)
        assert isinstance(made.action_space, spaces.Box)
        given = made.observation_space.spaces
        for key in options.leave_out:
            check_choice("observation", key, tuple(given))
        kept = {key: space for key, space in given.items() if key not in options.leave_out}
        target = Target(
            options.task,
            spaces.Dict(kept),
            made.action_space,
            own_bounds(made),
            frame_rate(made.metadata),
        )
    rules = Rules(options.keys, options.actions, options.clip, options.resize, options.any_rate)
    console = make_console()
    with console.status("importing", spinner="line"):
        found = import_demos(source, options.folder, target, rules)
    _describe(console, found)
    names = [key for key, feature in source.features.items() if feature.lossy]
    if names:
        console.print(
            f"the source compressed {', '.join(names)} with loss: its frames are kept as decoded",
            highlight=False,
        )
    _tell_line(console, options, preset, tuple(kept) if options.leave_out else ())
    return 0


def export(args: list[str]) -> int:
    """Export demonstrations."""
    options = parse(ExportOptions, "merl demos export", args)
    found = Demonstrations.open(options.folder)
    rate = options.rate
    if rate is None and found.task in ENV_IDS:
        made = make_env(found.task, observations=("proprio",))
        rate = frame_rate(made.metadata)
        made.close()
    ending = ".hdf5" if options.to == "robomimic" else f"-{options.to}"
    folder = options.folder.absolute()
    out = options.out or folder.with_name(folder.name + ending)
    console = make_console()
    with console.status("exporting", spinner="line"):
        export_demos(found, options.to, out, rate, lossless=options.lossless)
    told = f"{out}: {counted(len(found.lines), 'episode')}, {counted(found.steps, 'step')}"
    console.print(told, highlight=False, soft_wrap=True)
    return 0


def _with_env(kind: type[Any], action: str, args: list[str]) -> tuple[Any, str]:
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


def _make(options: Any, stack: ExitStack) -> Any:
    """Make the environment of demonstrations, which closes with the stack."""
    if options.task in ENV_IDS:
        settings = {f.name: getattr(options.env, f.name) for f in dataclasses.fields(EnvConfig)}
        made: Any = make_env(options.task, **settings)
    else:
        made = make_user_env(options.task, config=options.user_env)
    stack.callback(made.close)
    return made


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


def _tell_line(console: Console, options: Any, preset: str, keys: tuple[str, ...] = ()) -> None:
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
