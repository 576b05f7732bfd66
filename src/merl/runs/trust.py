"""Records of the runs that this user has trained: only their code may be imported.

A run folder can come from anyone, and importing the environment or the agent that it names would
run code. Those of merl and Gymnasium are always allowed. Others are imported only if a record
outside of the run folder shows that this user trained the run. The record is a file whose name is
the random id of the run; it holds the names and the folders of their modules. The names and folders
in `config.json` are not trusted.
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
    """The origin of the environment and the agent of a run.

    Attributes:
        task: `module:function` or `module:Id-v0`, or the id of a Gymnasium environment.
        folder: the folder of its module; None if the module is installed.
        agent: `module:Class`, or the name of one of merl's agents.
        agent_folder: the folder of its module; None if the module is installed.
    """

    task: str
    folder: str | None
    agent: str = "merl"
    agent_folder: str | None = None

    def code(self) -> dict[str, str]:
        """Describe the code that would be imported, with control characters escaped.

        Returns:
            Descriptions by "environment" and "agent"; none of these if it is merl's or Gymnasium's.
        """
        described = {}
        if imports_code(self.task):
            described["environment"] = _describe(self.task, self.folder)
        if ":" in self.agent:
            described["agent"] = _describe(self.agent, self.agent_folder)
        return described

    def __str__(self) -> str:
        """Return the descriptions of `code`."""
        return " and ".join(self.code().values())


def identity(known: Any = None) -> str:
    """Return `known` if it is a valid run id, else a new random id."""
    return known if _is_identity(known) else uuid.uuid4().hex


def origin(record: Mapping[str, Any]) -> Origin:
    """Read the origin of environment and agent from the record of a run (`config.json`).

    Raises:
        TypeError: a name or a folder is not a string.
    """
    config = record["config"]
    task, agent = config["task"], config.get("agent_name", "merl")
    folder, agent_folder = record.get("module_folder"), record.get("agent_folder")
    if not (isinstance(task, str) and isinstance(agent, str)):
        raise TypeError(f"task is {task!r} and agent_name {agent!r}")
    if not (isinstance(folder, str | None) and isinstance(agent_folder, str | None)):
        raise TypeError(f"module_folder is {folder!r} and agent_folder {agent_folder!r}")
    return Origin(task, folder, agent, agent_folder)


def remember(record: Mapping[str, Any]) -> None:
    """Record that this user trains a run, if its environment or its agent imports code.

    If the record cannot be written, log a warning.

    Args:
        record: the content of the run's `config.json`.
    """
    stated, name = origin(record), record["id"]
    if not stated.code():
        return
    try:
        folder = _folder()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        part = folder / f".{name}.{os.getpid()}.part"
        part.write_text(json.dumps(asdict(stated)))
        part.replace(folder / name)
    except OSError as error:
        _LOG.warning(
            "merl could not record that you trained this run (%s): to resume or evaluate it, "
            "--trust will be needed",
            error,
        )


def check(run: Path, record: Mapping[str, Any]) -> Origin:
    """Return the recorded origin of a run that this user has trained.

    Args:
        run: the folder of the run, for the message.
        record: the content of its `config.json`.

    Raises:
        MerlError: this user has no record of the run, or the record names other code.
    """
    stated = origin(record)
    try:
        recorded = _recorded(record.get("id"))
    except OSError as error:
        reason = f"your records of runs cannot be read ({error})"
    else:
        if recorded is not None and (recorded.task, recorded.agent) == (stated.task, stated.agent):
            return recorded
        reason = "you have no record of training it here"
        if recorded is not None:
            reason = f"you trained it with {recorded}, and its config.json was changed since then"
    raise MerlError(
        f"{run} names code as its {' and '.join(stated.code())}: {stated}. It is not imported, "
        f"because {reason}: read that code, then add --trust (in Python: trust=True)"
    )


def _describe(named: str, folder: str | None) -> str:
    module, colon, name = named.partition(":")
    if not colon:
        return f"Gymnasium environment {named!r}"
    where = "installed" if folder is None else f"in folder {folder!r}"
    return f"{name!r} of module {module!r}, {where}"


def _is_identity(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{32}", value) is not None


def _folder() -> Path:
    """Return the folder of the records.

    Raises:
        OSError: there is no home folder.
    """
    state = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not state.is_absolute():  # the XDG specification says to ignore a relative path
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
