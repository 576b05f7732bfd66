"""A run is a folder; everything after training works from that folder alone.

config.json     what was run: the config, the spaces, versions, commit, machine
metrics.csv     the numbers, a row per episode and evaluation (the truth)
tensorboard/    the same numbers as events
checkpoints/    what the run goes on from
replay/         the memory-mapped ring
videos/         an evaluation episode each
curve.png       the learning curve, drawn when training ends
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
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
"""Of an environment's own actions: lower, upper."""


@dataclass(frozen=True)
class Run:
    """A run's folder and the config that it was started with.

    Attributes:
        path: the folder.
        config: with everything decided that the user left open.
        left_open: names of the fields that the user left open, so that they are decided anew on
            another machine (`resuming.REOPENED`).
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
        """Create the folder of a new run, lock it, and record what is run; unlock it at the end.

        Args:
            config: of the run.
            observation_space: what the agent consumes.
            action_space: what it does, in [-1, 1].
            bounds: of the environment's own actions, where they were rescaled.
            left_open: names of the fields that the user left open.
            home: see `run_path`.

        Raises:
            MerlError: the folder holds something, cannot be made, or another process begins a run
                in it.
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
            refuse_existing(path)  # by the process that had the lock before
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
        """Open a run that exists; nothing of it is imported or executed.

        Raises:
            MerlError: the folder is not a run's.
        """
        path = path.absolute()  # user code may change the working folder
        with _readable(path):
            record = _read(path)
            number = record["format"]
            if number != FORMAT:
                raise MerlError(f"it has format {number}, this merl reads {FORMAT}")
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
            trusted: the user says that the module may be imported, as `origin` names it.
            named_in: the folder in which the user named the task, where the module may lie, too.

        Raises:
            MerlError: nobody says that it may be imported (`trust.check`), or it cannot be.
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
        """The code that the run names as its environment; None if it is merl's or Gymnasium's."""
        return trust.origin(_read(self.path)) if imports_code(self.config.task) else None

    def record_resumption(self, step: int) -> None:
        """Note that the run goes on from `step`, with what; from now on its config is this one."""
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
        """That an environment is what the run was trained in; arguments as for `create`.

        Raises:
            MerlError: naming what differs.
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
            f"{name} was {before.get(name, 'not there')} and is {now.get(name, 'not there')}"
            for name in before | now
            if before.get(name) != now.get(name)
        ]
        if differs:
            raise MerlError(
                f"the environment is not what {self.path} was trained in: {'; '.join(differs)}: "
                "make it as it was, or begin another run"
            )

    def has_moved(self) -> bool:
        """Whether it was trained last on another machine than this one."""
        return _last_machine(_read(self.path)) != machine()

    def begin_again(self) -> bool:
        """Clear the folder for a first step, if it was left before its first checkpoint.

        Returns:
            Whether it is so; what has saved, measured or remembered anything is left as it is.
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
        """Before anything is written, lest a folder that was taken away be made anew.

        Raises:
            MerlError: the folder is gone.
        """
        if not (self.path / CONFIG_FILE).exists():
            raise MerlError(
                f"run folder {self.path} is gone, removed or moved while the run was trained in "
                "it: the run stops, and writes nothing in its place"
            )

    def discard(self) -> None:
        """Remove what this process has written, before the first step of a new run."""
        discard_folder(self.path, self.created)

    def lock(self) -> AbstractContextManager[None]:
        """Keep every other process from training in this folder; see `lock_folder`."""
        return lock_folder(self.path)

    def _write(self, record: Mapping[str, Any]) -> None:
        """Replace `config.json` whole."""
        part = self.path / PART
        try:
            with part.open("w") as file:
                file.write(json.dumps(record, indent=1))
                file.flush()
                os.fsync(file.fileno())
            part.replace(self.path / CONFIG_FILE)
        except OSError as error:
            raise MerlError(f"{self.path} cannot be written to: {error.strerror}") from None

    @property
    def checkpoints(self) -> Path:
        """Where the checkpoints are."""
        return self.path / "checkpoints"

    @property
    def videos(self) -> Path:
        """Where the videos are."""
        return self.path / "videos"

    @property
    def replay(self) -> Path:
        """Where the ring lies."""
        return self.path / "replay"

    def spaces(self) -> tuple[spaces.Dict, spaces.Box]:
        """What the agent consumes, and its actions, without building the environment."""
        with _readable(self.path):
            return _recorded_spaces(_read(self.path))


def _read_config(plain: Mapping[str, Any]) -> TrainConfig:
    """A run's config; that of its agent is of the kind that the agent's name says."""
    name = plain.get("agent_name", "merl")
    check_choice("agent", name, tuple(AGENTS))
    return from_plain(TrainConfig, plain, agent=type(AGENTS[name]))


def _updated(plain: Mapping[str, Any], space: spaces.Dict) -> Mapping[str, Any]:
    """Rewrite a recorded config without fields and values that merl no longer has.

    The renderer of a run whose agent sees no image of merl's own tasks does not matter.

    Raises:
        MerlError: the run depends on a value that no longer exists.
    """
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
    """Name the keys of a run by an earlier merl, which left `state` out unless it was named."""
    images, vectors = modalities(config.agent, space)
    agent = dataclasses.replace(config.agent, images=images, vectors=vectors)
    return dataclasses.replace(config, agent=agent)


def _read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((path / CONFIG_FILE).read_text())
    return record


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """What is wrong with a run's config, in one line."""
    file = path / CONFIG_FILE
    try:
        yield
    except FileNotFoundError:
        way = ""
        if holds_nothing(path):
            way = (
                ", and nothing else: begin it with the line of before, "
                f"{program()} train ... --run-dir {shlex.quote(str(path))}"
            )
        raise MerlError(f"{path} is not a run: it has no {CONFIG_FILE}{way}") from None
    except UnicodeDecodeError:
        raise MerlError(f"{file} cannot be read: it is no text") from None
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
    """Where the run was trained last."""
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
