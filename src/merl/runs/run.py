"""A run is a folder; everything after training needs only this folder.

config.json     config, spaces, versions, commit, machine
metrics.csv     the metrics, one row per episode and evaluation (authoritative)
tensorboard/    the same metrics as TensorBoard events, with `--log tensorboard`
checkpoints/    the checkpoints from which the run resumes
replay/         the memory-mapped replay buffer
corrections/    the steps that a person has corrected, as demonstrations
videos/         one episode of each filmed evaluation
curve.png       the learning curve, drawn when training ends
"""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from gymnasium import spaces

from merl.agents import find_agent
from merl.agents.config import UnloadedConfig
from merl.agents.networks import user_encoders
from merl.config import CUSTOM, Source, TrainConfig
from merl.core import CONFIG_FILE, METRICS_FILE, MerlError, user_code
from merl.core.files import is_gone, remove
from merl.envs.user_env import imports_code, load_module
from merl.replay.storage import holds_steps
from merl.runs import record, trust
from merl.runs.checkpoint_folders import folders
from merl.runs.metrics import read_rows
from merl.runs.plain import from_plain
from merl.runs.provenance import machine
from merl.runs.record import FORMAT, Bounds
from merl.runs.resume import REOPENED
from merl.runs.run_folder import (
    PRETRAINED,
    create_folder,
    discard_folder,
    existing_run,
    lock_folder,
    refuse_existing,
)
from merl.runs.trust import Origin


@dataclass(frozen=True)
class Run:
    """A run: its folder and its config.

    Attributes:
        path: the folder.
        config: the config, with a value for each field that the user left open.
        left_open: names of the fields that the user left open; some of them are chosen again on
            another machine (`merl.runs.resume.REOPENED`).
        created: this process has created the folder.
    """

    path: Path
    config: TrainConfig
    left_open: tuple[str, ...] = REOPENED
    created: bool = False

    @classmethod
    @contextmanager
    def begin(
        cls,
        config: TrainConfig,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        bounds: Bounds | None = None,
        left_open: tuple[str, ...] = REOPENED,
        *,
        source: Source = CUSTOM,
        home: Path | None = None,
    ) -> Iterator[Run]:
        """Create the folder of a new run, lock it, and write its config; unlock it at the end.

        Args:
            config: the config of the run.
            observation_space: the observation keys that the agent uses.
            action_space: the agent's actions, in [-1, 1].
            bounds: the bounds of the environment's actions before rescaling; None if they are not
                rescaled.
            left_open: names of the fields that the user left open.
            source: where the config's values come from.
            home: see `run_path`.

        Raises:
            MerlError: the folder holds other files, cannot be created, or is in use by another
                process.
        """
        path, created = create_folder(config, source, home)
        run = cls(path, config, left_open, created)
        with ExitStack() as stack:
            try:
                stack.enter_context(run.lock())
            except BaseException:
                with suppress(OSError):  # another process has locked it
                    if created:
                        path.rmdir()
                raise
            refuse_existing(path)  # another process may have started a run before this lock
            try:
                described = {
                    "format": FORMAT,
                    "id": trust.identity(),
                    "task": config.task,
                    "agent": config.agent_name,
                    **dataclasses.asdict(source),
                    "seed": config.seed,
                    **record.describe_config(config, left_open),
                    **record.describe_spaces(observation_space, action_space, bounds),
                    **record.describe_origin(),
                }
                record.write(path, described)
                trust.remember(described)
            except BaseException:
                run.discard()
                raise
            yield run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Open an existing run without importing or executing any code of it.

        The config of a user's own agent is an `UnloadedConfig` until `with_agent`.

        Raises:
            MerlError: the folder is not a run, or its config cannot be read.
        """
        path = existing_run(path)  # absolute, since user code may change the working folder
        recorded = record.read(path)
        with record.readable(path):
            config = record.config_of(recorded)
            record.spaces_of(recorded)
            record.machine_of(recorded)
            trust.origin(recorded)
            left_open = tuple(name for name in REOPENED if name in recorded["left_open"])
        return cls(path, dataclasses.replace(config, run_dir=path), left_open)

    def load_module(self, *, trusted: bool = False, named_in: Path | None = None) -> None:
        """Import the module of the run's environment, if the environment is the user's own.

        Args:
            trusted: the user allows the import of the module that `origin` describes.
            named_in: a folder that may contain the module as well, because the user named the task
                there; this also allows the import.

        Raises:
            MerlError: the import is not allowed (`trust.check`), or it fails.
        """
        if not imports_code(self.config.task):
            return
        folders = self._folders_of(self.config.task, trusted, named_in)
        if ":" in self.config.task:
            load_module(self.config.task, *folders)

    def with_agent(self, *, trusted: bool = False, named_in: Path | None = None) -> Run:
        """Import the module of a user's own agent; return the run with the agent's config.

        Args:
            trusted: see `load_module`.
            named_in: a folder that may contain the module as well, because the user named the agent
                there; this also allows the import.

        Raises:
            MerlError: the import is not allowed (`trust.check`), it fails, or the class of the
                agent's config does not accept the recorded values.
        """
        agent, name = self.config.agent, self.config.agent_name
        if not isinstance(agent, UnloadedConfig):
            return self
        found = find_agent(name, *self._folders_of(name, trusted, named_in))
        with record.readable(self.path):
            loaded = from_plain(type(found.config), agent.values)
        return dataclasses.replace(self, config=dataclasses.replace(self.config, agent=loaded))

    def load_encoders(self, *, trusted: bool = False, named_in: Path | None = None) -> None:
        """Import the modules of the user's encoders that the agent's config names.

        Args:
            trusted: see `load_module`.
            named_in: as for `load_module`, because the user named the same encoders there.

        Raises:
            MerlError: the import is not allowed (`trust.check`), or it fails.
        """
        for name in user_encoders(self.config.agent):
            user_code.load_module(name, *self._folders_of(name, trusted, named_in), kind="encoder")

    def _folders_of(self, name: str, trusted: bool, named_in: Path | None) -> list[Path]:
        """Return the folders from which a module that the run names may be imported.

        Raises:
            MerlError: the import is not allowed.
        """
        recorded = record.read(self.path)
        folders = [] if named_in is None else [named_in]
        try:
            origin = trust.check(self.path, recorded)
        except MerlError:
            if not trusted:
                if named_in is None:
                    raise
                return folders
            origin = trust.origin(recorded)
        return [Path(origin.folders[name]), *folders] if name in origin.folders else folders

    def origin(self) -> Origin | None:
        """Return the origin of the code that the run imports; None if it is merl's own."""
        origin = trust.origin(record.read(self.path))
        return origin if origin.code() else None

    def record_resumption(self, step: int) -> None:
        """Record that the run resumes at `step`: its current config, versions and machine."""
        recorded = record.read(self.path)
        recorded |= record.describe_config(self.config, self.left_open)
        recorded["id"] = trust.identity(recorded["id"])
        recorded.setdefault("resumed", []).append({"step": step, **record.describe_origin()})
        record.write(self.path, recorded)
        trust.remember(recorded)

    def check_environment(
        self, observation_space: spaces.Dict, action_space: spaces.Box, bounds: Bounds | None
    ) -> None:
        """Check that an environment has the spaces of the run; arguments as for `begin`.

        Raises:
            MerlError: the spaces differ; the message names each difference.
        """
        now = record.describe_spaces(observation_space, action_space, bounds)
        differs = record.changed_spaces(record.read(self.path), now)
        if differs:
            raise MerlError(
                f"the environment has changed since {self.path} was trained: {'; '.join(differs)}: "
                "restore the environment, or start a new run"
            )

    def has_moved(self) -> bool:
        """Return whether the run was last trained on another machine."""
        return record.machine_of(record.read(self.path)) != machine()

    def begin_again(self) -> bool:
        """Clear the folder for a new start, if the run ended before it produced any data.

        Returns:
            Whether the folder was cleared. A run with a checkpoint, with metrics, or with steps in
            its replay buffer is left unchanged.
        """
        try:
            if folders(self.checkpoints) or read_rows(self.path / METRICS_FILE)[1]:
                return False
            if holds_steps(self.replay):
                return False
        except (OSError, MerlError):  # damaged: it is not known to be empty
            return False
        for folder in (self.replay, self.checkpoints):
            remove(folder)
        return True

    def check_there(self) -> None:
        """Check before a write that the folder still exists, so that it is not created again.

        Raises:
            MerlError: the folder was removed or moved.
        """
        if is_gone(self.path / CONFIG_FILE):
            raise MerlError(
                f"run folder {self.path} is gone: it was removed or moved during training; the run "
                "stops and does not create it again"
            )

    def discard(self) -> None:
        """Delete everything that this process has written, before the first step of a new run."""
        discard_folder(self.path, self.created)

    def lock(self) -> AbstractContextManager[None]:
        """Lock the folder so that no other process trains in it; see `lock_folder`.

        Raises:
            MerlError: another process trains in it, or it is a policy that comes with merl.
        """
        if self.path.parent == PRETRAINED:
            raise MerlError(
                f"pretrained/{self.path.name} is a trained policy without what training needs: "
                f"evaluate it, or train with `merl train {self.config.task}`"
            )
        return lock_folder(self.path)

    @property
    def public_id(self) -> str:
        """Return an id of the run that may be published; `trust` keeps the recorded one secret."""
        return uuid.uuid5(uuid.UUID(record.read(self.path)["id"]), "merl").hex

    @property
    def checkpoints(self) -> Path:
        """Return the folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def videos(self) -> Path:
        """Return the folder of the videos."""
        return self.path / "videos"

    @property
    def replay(self) -> Path:
        """Return the folder of the replay buffer."""
        return self.path / "replay"

    def spaces(self) -> tuple[spaces.Dict, spaces.Box]:
        """Return the recorded observation and action space; no environment is made."""
        recorded = record.read(self.path)
        with record.readable(self.path):
            return record.spaces_of(recorded)
