"""A run is a folder; everything after training needs only this folder.

config.json     config, spaces, versions, commit, machine
metrics.csv     the metrics, one row per episode and evaluation (authoritative)
tensorboard/    the same metrics as TensorBoard events, with `--log tensorboard`
checkpoints/    the checkpoints from which the run resumes
replay/         the memory-mapped replay buffer
videos/         one episode of each filmed evaluation
curve.png       the learning curve, drawn when training ends
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

import merl
from merl.agents import AGENTS
from merl.agents.networks import modalities
from merl.config import TrainConfig
from merl.core import CONFIG_FILE, METRICS_FILE, MerlError, check_choice
from merl.envs.config import AUTO_RENDERER, check_not_removed
from merl.envs.registration import ENV_IDS
from merl.envs.user_env import imports_code, load_module, module_folder
from merl.runs import trust
from merl.runs.plain import box, describe, from_plain, to_plain, told
from merl.runs.provenance import commit, machine, package_versions
from merl.runs.resume import REOPENED
from merl.runs.run_folder import (
    PART,
    create_folder,
    discard_folder,
    holds_nothing,
    lock_folder,
    program,
    refuse_existing,
)
from merl.runs.trust import Origin

FORMAT = 1
Bounds = tuple[list[float], list[float]]
"""Lower and upper bounds of the environment's actions before rescaling."""


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
            home: see `run_path`.

        Raises:
            MerlError: the folder holds other files, cannot be created, or is in use by another
                process.
        """
        path, created = create_folder(config, home)
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
                record = {
                    "format": FORMAT,
                    "id": trust.identity(),
                    "merl": merl.__version__,
                    "task": config.task,
                    "agent": config.agent_name,
                    "preset": config.preset,
                    "setting": config.setting,
                    "seed": config.seed,
                    "config": to_plain(config),
                    "left_open": list(left_open),
                    "module_folder": _module_folder(config.task),
                    "observation_space": {k: describe(s) for k, s in observation_space.items()},
                    "action_space": describe(action_space) | {"own_bounds": bounds},
                    "versions": package_versions(),
                    "commit": commit(),
                    "machine": machine(),
                }
                run._write(record)
                trust.remember(record)
            except BaseException:
                run.discard()
                raise
            yield run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Open an existing run without importing or executing any code of it.

        Raises:
            MerlError: the folder is not a run, or its config cannot be read.
        """
        path = path.absolute()  # user code may change the working folder
        with _readable(path):
            record = _read(path)
            number = record["format"]
            if number != FORMAT:
                raise MerlError(
                    f"it has format {number}, but this version of merl reads format {FORMAT}"
                )
            observation_space, _ = _recorded_spaces(record)
            config = _read_config(_updated(record["config"], observation_space))
            if config.own_env and "user_env" not in record["config"]:
                config = _naming_its_keys(config, observation_space)
            _last_machine(record)
            trust.origin(record)
            recorded = record.get("left_open", REOPENED)
            left_open = tuple(name for name in REOPENED if name in recorded)
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
        record = _read(self.path)
        folder: str | None = None
        try:
            folder = trust.check(self.path, record).folder
        except MerlError:
            if trusted:
                folder = trust.origin(record).folder
            elif named_in is None:
                raise
        if ":" in self.config.task:
            folders = [Path(folder) if folder is not None else None, named_in]
            load_module(self.config.task, *(each for each in folders if each is not None))

    def origin(self) -> Origin | None:
        """Return the origin of the environment's code; None for merl's and Gymnasium's own."""
        return trust.origin(_read(self.path)) if imports_code(self.config.task) else None

    def record_resumption(self, step: int) -> None:
        """Record that the run resumes at `step`: its current config, versions and machine."""
        record = _read(self.path)
        record["config"] = to_plain(self.config)
        record["left_open"] = list(self.left_open)
        record["module_folder"] = _module_folder(self.config.task)
        record["id"] = trust.identity(record.get("id"))
        record.setdefault("resumed", []).append(
            {
                "step": step,
                "merl": merl.__version__,
                "versions": package_versions(),
                "commit": commit(),
                "machine": machine(),
            }
        )
        self._write(record)
        trust.remember(record)

    def check_environment(
        self, observation_space: spaces.Dict, action_space: spaces.Box, bounds: Bounds | None
    ) -> None:
        """Check that an environment has the spaces of the run; arguments as for `begin`.

        Raises:
            MerlError: the spaces differ; the message names each difference.
        """
        record = _read(self.path)
        before = {f"observation {k!r}": told(s) for k, s in record["observation_space"].items()}
        now = {f"observation {k!r}": told(describe(s)) for k, s in observation_space.items()}
        before["action"], now["action"] = (
            told(record["action_space"]),
            told(describe(action_space)),
        )
        own = record["action_space"].get("own_bounds")
        if own is not None and bounds is not None:
            before["the actions' bounds"], now["the actions' bounds"] = (
                "low {}, high {}".format(*each) for each in (own, bounds)
            )
        differs = [
            f"{name} was {before.get(name, 'missing')} and is {now.get(name, 'missing')}"
            for name in before | now
            if before.get(name) != now.get(name)
        ]
        if differs:
            raise MerlError(
                f"the environment has changed since {self.path} was trained: {'; '.join(differs)}: "
                "restore the environment, or start a new run"
            )

    def has_moved(self) -> bool:
        """Return whether the run was last trained on another machine."""
        return _last_machine(_read(self.path)) != machine()

    def begin_again(self) -> bool:
        """Clear the folder for a new start, if the run ended before it produced any data.

        Returns:
            Whether the folder was cleared. A run with a checkpoint, with metrics, or with steps in
            its replay buffer is left unchanged.
        """
        if any(path.name.isdecimal() for path in self.checkpoints.glob("*")):
            return False
        metrics = self.path / METRICS_FILE
        has_rows = metrics.exists() and metrics.read_bytes().count(b"\n") > 1
        if has_rows or any(np.fromfile(f, "<i8").any() for f in self.replay.rglob("timestep.bin")):
            return False
        for folder in (self.replay, self.checkpoints):
            shutil.rmtree(folder, ignore_errors=True)
        return True

    def check_there(self) -> None:
        """Check before a write that the folder still exists, so that it is not created again.

        Raises:
            MerlError: the folder was removed or moved.
        """
        if not (self.path / CONFIG_FILE).exists():
            raise MerlError(
                f"run folder {self.path} is gone: it was removed or moved during training; the run "
                "stops and does not create it again"
            )

    def discard(self) -> None:
        """Delete everything that this process has written, before the first step of a new run."""
        discard_folder(self.path, self.created)

    def lock(self) -> AbstractContextManager[None]:
        """Lock the folder so that no other process trains in it; see `lock_folder`."""
        return lock_folder(self.path)

    def _write(self, record: Mapping[str, Any]) -> None:
        """Replace `config.json` atomically."""
        part = self.path / PART
        try:
            with part.open("w") as file:
                file.write(json.dumps(record, indent=1))
                file.flush()
                os.fsync(file.fileno())
            part.replace(self.path / CONFIG_FILE)
        except OSError as error:
            raise MerlError(f"{self.path} is not writable: {error.strerror}") from None

    @property
    def public_id(self) -> str:
        """Return an id of the run that may be published; `trust` keeps the recorded one secret."""
        return uuid.uuid5(uuid.UUID(_read(self.path)["id"]), "merl").hex

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
        with _readable(self.path):
            return _recorded_spaces(_read(self.path))


def _read_config(plain: Mapping[str, Any]) -> TrainConfig:
    """Restore the config of a run; the agent's name selects the class of the agent config."""
    name = plain.get("agent_name", "merl")
    check_choice("agent", name, tuple(AGENTS))
    return from_plain(TrainConfig, plain, agent=type(AGENTS[name]))


def _updated(plain: Mapping[str, Any], space: spaces.Dict) -> Mapping[str, Any]:
    """Replace or drop fields and values of a recorded config that merl no longer has.

    A removed renderer is replaced only if the agent uses no image of merl's own tasks.

    Raises:
        MerlError: the run depends on a value that no longer exists.
    """
    plain = {name: value for name, value in plain.items() if name != "measure"}
    env = plain.get("env")
    if not isinstance(env, dict):
        return plain
    env = dict(env)
    floor = env.pop("floor", "rough")
    check_not_removed("floor", floor)
    check_choice("floor", floor, ("rough",))
    is_drawn = plain["task"] in ENV_IDS and "image" in space.spaces
    if env.get("renderer") == "warp" and not is_drawn:
        env["renderer"] = AUTO_RENDERER
    return {**plain, "env": env}


def _naming_its_keys(config: TrainConfig, space: spaces.Dict) -> TrainConfig:
    """Add the observation keys to the config of a run of an earlier version.

    That version did not use `state` unless the config named it.
    """
    images, vectors = modalities(config.agent, space)
    agent = dataclasses.replace(config.agent, images=images, vectors=vectors)
    return dataclasses.replace(config, agent=agent)


def _read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((path / CONFIG_FILE).read_text())
    return record


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert an error inside the block into a one-line error about the run's config."""
    file = path / CONFIG_FILE
    try:
        yield
    except FileNotFoundError:
        way = ""
        if holds_nothing(path):
            way = (
                " and no other files: start it with the original command, "
                f"{program()} train ... --run-dir {shlex.quote(str(path))}"
            )
        raise MerlError(f"{path} is not a run: it has no {CONFIG_FILE}{way}") from None
    except UnicodeDecodeError:
        raise MerlError(f"{file} cannot be read: it is not a text file") from None
    except KeyError as error:
        raise MerlError(f"{file} cannot be read: it has no {error}") from None
    except OSError as error:
        raise MerlError(f"{file} cannot be read: {error.strerror}") from None
    except (
        MerlError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
        ArithmeticError,
        MemoryError,
        RecursionError,
    ) as error:
        raise MerlError(f"{file} cannot be read: {error}") from None


def _last_machine(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the machine on which the run was last trained."""
    recorded: dict[str, Any] = record.get("resumed", [record])[-1]["machine"]
    return recorded


def _recorded_spaces(record: Mapping[str, Any]) -> tuple[spaces.Dict, spaces.Box]:
    observation: dict[str, spaces.Space[Any]] = {
        key: box(described) for key, described in record["observation_space"].items()
    }
    return spaces.Dict(observation), box(record["action_space"])


def _module_folder(task: str) -> str | None:
    folder = module_folder(task)
    return None if folder is None else str(folder)
