"""Which runs this user has trained: their environments may be imported again.

The folder of a run can come from anybody, and importing the environment that it names would run
code. Unless the environment is merl's or Gymnasium's, it is imported only where a record outside of
the folder says that this user trained the run: a file with the run's random id as its name, which
holds the task and the folder of its module. What `config.json` says of them is not believed.
"""

from __future__ import annotations

import json
import logging
import os
import re
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from merl.core import MerlError
from merl.envs.user_env import imports_code

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Origin:
    """Where the environment of a run comes from.

    Attributes:
        task: `module:function` or `module:Id-v0`, or the id of a Gymnasium environment.
        folder: that the module lies in; None where it is installed.
    """

    task: str
    folder: str | None

    def __str__(self) -> str:
        """The code that would be run, with control characters escaped."""
        module, colon, name = self.task.partition(":")
        if not colon:
            return f"Gymnasium environment {self.task!r}"
        where = "installed" if self.folder is None else f"in folder {self.folder!r}"
        return f"{name!r} of module {module!r}, {where}"


def identity(known: Any = None) -> str:
    """The id of a run: what is known, if it is one, else a new random one."""
    return known if _is_identity(known) else uuid.uuid4().hex


def origin(record: Mapping[str, Any]) -> Origin:
    """What a `config.json` says of the environment of its run.

    Raises:
        TypeError: it is not of the form that merl writes.
    """
    task, folder = record["config"]["task"], record.get("module_folder")
    if not isinstance(task, str) or not isinstance(folder, str | None):
        raise TypeError(f"task is {task!r} and module_folder {folder!r}")
    return Origin(task, folder)


def remember(record: Mapping[str, Any]) -> None:
    """Record that this user trains a run, if its environment is code that `check` asks about.

    A record that cannot be written is a warning.

    Args:
        record: what `config.json` holds.
    """
    told, name = origin(record), record["id"]
    if not imports_code(told.task):
        return
    try:
        folder = _folder()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        part = folder / f".{name}.{os.getpid()}.part"
        part.write_text(json.dumps(asdict(told)))
        part.replace(folder / name)
    except OSError as error:
        _LOG.warning(
            "that you trained this run is not recorded (%s): to resume or evaluate it, "
            "--trust will be needed",
            error,
        )


def check(run: Path, record: Mapping[str, Any]) -> Origin:
    """The recorded origin of a run that this user has trained.

    Args:
        run: the run's folder, for the message.
        record: what its `config.json` holds.

    Raises:
        MerlError: there is no such record, or it is of another environment.
    """
    told = origin(record)
    try:
        recorded = _recorded(record.get("id"))
    except OSError as error:
        reason = f"your records of runs cannot be read ({error})"
    else:
        if recorded is not None and recorded.task == told.task:
            return recorded
        reason = "you have no record of training it here"
        if recorded is not None:
            reason = f"it was trained here with {recorded}, and its config.json was changed since"
    raise MerlError(
        f"{run} names code as its environment: {told}. It is not imported, for {reason}: read "
        "that code, then add --trust (in Python: make_env(trust=True))"
    )


def _is_identity(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{32}", value) is not None


def _folder() -> Path:
    """Where the records are.

    Raises:
        OSError: there is no home.
    """
    state = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not state.is_absolute():  # a relative one is to be ignored, says its specification
        with suppress(RuntimeError):
            state = Path("~/.local/state").expanduser()
    if not state.is_absolute():
        raise OSError("there is no home folder: set HOME")
    return state / "merl" / "runs"


def _recorded(identity: Any) -> Origin | None:
    if not _is_identity(identity):
        return None
    try:
        return Origin(**json.loads((_folder() / identity).read_text()))
    except (FileNotFoundError, ValueError, TypeError):
        return None
