"""The commands merl demos import and merl demos export."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from gymnasium import spaces

from merl.acting.instances import own_bounds
from merl.cli.console import make_console
from merl.cli.demos.shared import EnvOptions, FolderOptions, describe, make, tell_line, with_env
from merl.cli.parsing import parse
from merl.core import MerlError, check_choice, counted
from merl.core.fields import Range, check_fields
from merl.demos.demonstrations import Demonstrations
from merl.demos.exporting import Format, export_demos
from merl.demos.importing import Actions, Rules, Target, import_demos, open_source
from merl.envs.config import EnvConfig, UserEnvConfig
from merl.envs.frame_rate import frame_rate
from merl.envs.registration import ENV_IDS


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


def import_(args: list[str]) -> int:
    """Import demonstrations."""
    options, preset = with_env(ImportOptions, "import", args)
    if options.source is None:
        raise MerlError("merl demos import needs the folder or file to convert: --from PATH")
    # The environment may change the working folder.
    source, folder = open_source(options.source.absolute()), options.folder.absolute()
    with ExitStack() as stack:
        made = make(options, stack)
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
            options.env.form if options.task in ENV_IDS else {},
        )
    rules = Rules(options.keys, options.actions, options.clip, options.resize, options.any_rate)
    console = make_console()
    with console.status("importing", spinner="line"):
        found = import_demos(source, folder, target, rules)
    describe(console, found)
    names = [key for key, feature in source.features.items() if feature.lossy]
    if names:
        console.print(
            f"the source compressed {', '.join(names)} with loss: its frames are kept as decoded",
            highlight=False,
        )
    tell_line(console, options, preset, tuple(kept) if options.leave_out else ())
    return 0


def export(args: list[str]) -> int:
    """Export demonstrations."""
    options = parse(ExportOptions, "merl demos export", args)
    found = Demonstrations.open(options.folder)
    rate = options.rate
    if rate is None and found.task in ENV_IDS:
        from merl.envs.arm_env import ArmEnv  # imports dm_control

        rate = frame_rate(ArmEnv.metadata)
    ending = ".hdf5" if options.to == "robomimic" else f"-{options.to}"
    folder = options.folder.absolute()
    out = options.out or folder.with_name(folder.name + ending)
    console = make_console()
    with console.status("exporting", spinner="line"):
        export_demos(found, options.to, out, rate, lossless=options.lossless)
    told = f"{out}: {counted(len(found.lines), 'episode')}, {counted(found.steps, 'step')}"
    console.print(told, highlight=False, soft_wrap=True)
    return 0
