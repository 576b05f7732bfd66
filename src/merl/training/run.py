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
import fcntl
import itertools
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

import merl
from merl.agents import AGENTS
from merl.agents.networks import modalities
from merl.core import CONFIG_FILE, METRICS_FILE, MerlError, check_choice
from merl.envs.own import module_folder, search_first
from merl.training.config import TrainConfig
from merl.training.machine import commit, machine, package_versions
from merl.training.plain import box, describe, from_plain, to_plain, told

LOCK_FILE = "lock"
FORMAT = 1
Bounds = tuple[list[float], list[float]]
"""Of an environment's own actions: lower, upper."""


@dataclass(frozen=True)
class Run:
    """A run's folder and the config that it was started with."""

    path: Path
    config: TrainConfig

    @classmethod
    def create(
        cls,
        config: TrainConfig,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        bounds: Bounds | None = None,
        *,
        home: Path | None = None,
    ) -> Run:
        """Make the folder and record what is run.

        Args:
            config: of the run.
            observation_space: what the agent consumes.
            action_space: what it does, in [-1, 1].
            bounds: of the environment's own actions, where they were rescaled.
            home: see `run_path`.

        Raises:
            MerlError: the folder exists, or cannot be made.
        """
        path = run_path(config, home)
        refuse_existing(path)
        record = {
            "format": FORMAT,
            "merl": merl.__version__,
            "task": config.task,
            "agent": config.agent_name,
            "preset": config.preset,
            "setting": config.setting,
            "seed": config.seed,
            "config": to_plain(config),
            "module_folder": _module_folder(config.task),
            "observation_space": {key: describe(s) for key, s in observation_space.items()},
            "action_space": describe(action_space) | {"own_bounds": bounds},
            "versions": package_versions(),
            "commit": commit(),
            "machine": machine(),
        }
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise MerlError(f"the run's folder {path} cannot be made: {error.strerror}") from None
        run = cls(path, config)
        try:
            run._write(record)
        except MerlError:
            shutil.rmtree(path, ignore_errors=True)
            raise
        return run

    @classmethod
    def open(cls, path: Path) -> Run:
        """A run that exists.

        Raises:
            MerlError: the folder is not a run's.
        """
        path = path.absolute()  # user code may change the working folder
        with _readable(path):
            record = _read(path)
            number = record["format"]
            if number != FORMAT:
                raise MerlError(f"it has format {number}, this merl reads {FORMAT}")
            config = _read_config(record["config"])
            observation_space, _ = _recorded_spaces(record)
            if config.own_env and "user_env" not in record["config"]:
                config = _naming_its_keys(config, observation_space)
            _last_machine(record)
            folder = record.get("module_folder")
            if folder is not None:  # so that the run works from wherever it is called
                search_first(Path(folder))
        return cls(path, dataclasses.replace(config, run_dir=path))

    def record_resumption(self, step: int) -> None:
        """Note that the run goes on from `step`, with what; from now on its config is this one."""
        record = _read(self.path)
        record["config"] = to_plain(self.config)
        record["module_folder"] = _module_folder(self.config.task)
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
        if any(path.name.isdigit() for path in self.checkpoints.glob("*")):
            return False
        metrics = self.path / METRICS_FILE
        has_rows = metrics.exists() and metrics.read_bytes().count(b"\n") > 1
        if has_rows or any(np.fromfile(f, "<i8").any() for f in self.replay.rglob("moment.bin")):
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

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep every other process from training in this folder; the lock dies with the process.

        Raises:
            MerlError: another process trains here.
        """
        path = self.path / LOCK_FILE
        with ExitStack() as stack:
            try:
                file = stack.enter_context(path.open("a+"))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise MerlError(
                    f"process {path.read_text().strip()} is training in {self.path}: stop it first"
                ) from None
            except OSError as error:
                raise MerlError(f"{path} cannot be locked: {error.strerror}") from None
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            yield

    def _write(self, record: Mapping[str, Any]) -> None:
        """Replace `config.json` whole."""
        part = self.path / f".{CONFIG_FILE}.part"
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


def run_path(config: TrainConfig, home: Path | None = None) -> Path:
    """Return the folder that a config names, or the first of the default ones that is free.

    Args:
        config: of the run.
        home: where a relative folder lies; the working folder if None.

    Returns:
        An absolute path.
    """
    home = Path.cwd() if home is None else home
    if config.run_dir is not None:
        return home / config.run_dir
    agent = config.agent_name if config.setting == "matched" else f"{config.agent_name}-published"
    task = re.sub(r"[^\w.-]+", "-", config.task)  # `module:function`, `namespace/Id-v0`
    name = f"{task}-{agent}-{config.preset}-s{config.seed}"
    runs = home / "runs"
    numbered = (runs / f"{name}-{number}" for number in itertools.count(2))
    return next(p for p in itertools.chain([runs / name], numbered) if not _exists(p))


def resume_line(folder: Path) -> str:
    """What to type to go on with a run."""
    return f"{_program()} resume {shlex.quote(str(folder))}"


def refuse_existing(path: Path) -> None:
    """Never write into a folder that holds something.

    Raises:
        MerlError: the folder exists, or its name is refused by the system.
    """
    if _exists(path):
        raise MerlError(
            f"run folder {path} exists already: go on with `{resume_line(path)}`, or name another "
            "with --run-dir"
        )


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:  # too long a name, a folder that may not be searched
        raise MerlError(f"run folder {path} cannot be used: {error.strerror}") from None


def _read_config(plain: Mapping[str, Any]) -> TrainConfig:
    """A run's config; that of its agent is of the kind that the agent's name says."""
    name = plain.get("agent_name", "merl")
    check_choice("agent", name, tuple(AGENTS))
    return from_plain(TrainConfig, plain, agent=type(AGENTS[name]))


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
        raise MerlError(f"{path} is not a run: it has no {CONFIG_FILE}") from None
    except UnicodeDecodeError:
        raise MerlError(f"{file} cannot be read: it is no text") from None
    except KeyError as error:
        raise MerlError(f"{file} cannot be read: it has no {error}") from None
    except OSError as error:
        raise MerlError(f"{file} cannot be read: {error.strerror}") from None
    except (MerlError, ValueError, TypeError, AttributeError, IndexError) as error:
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


def _program() -> str:
    """What to type to call this program again: `merl` if the shell would find it."""
    found, called = shutil.which("merl"), Path(sys.argv[0])
    if found or called.name != "merl":
        return "merl"
    return shlex.quote(str(called))
