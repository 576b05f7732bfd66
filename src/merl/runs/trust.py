"""Records of the runs that this user has trained: only their code may be imported.

A run folder can come from anyone, and importing the environment, the agent or an encoder that it
names would run code. Those of merl and Gymnasium are always allowed. Others are imported only if a
record outside of the run folder shows that this user trained the run. The record is a file whose
name is the random id of the run; it holds the names and the folders of their modules. The names and
folders in `config.json` are not trusted.
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
from merl.core.files import replace_file
from merl.envs.user_env import imports_code

ENVIRONMENT = "environment"
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Origin:
    """The origin of the code of a run.

    Attributes:
        names: see `names`.
        folders: the folder of the module of each name; none for a module that is installed.
    """

    names: Mapping[str, str]
    folders: Mapping[str, str]

    def code(self) -> dict[str, str]:
        """Describe the code that would be imported, with control characters escaped.

        Returns:
            Descriptions with the keys of `names`; only of code that is not merl's or Gymnasium's.
        """
        return {
            what: _describe(name, self.folders.get(name))
            for what, name in self.names.items()
            if (imports_code(name) if what == ENVIRONMENT else ":" in name)
        }

    def __str__(self) -> str:
        """Return the descriptions of `code`."""
        return " and ".join(self.code().values())


def identity(known: Any = None) -> str:
    """Return `known` if it is a valid run id, else a new random id."""
    return known if _is_identity(known) else uuid.uuid4().hex


def names(config: Mapping[str, Any]) -> dict[str, str]:
    """Return what a recorded config names: its "environment", "agent", and "encoder of KEY".

    Raises:
        TypeError: a name is not a string.
    """
    found = {ENVIRONMENT: config["task"], "agent": config["agent_name"]}
    encoders = config["agent"].get("encoders")  # another agent may have no such field
    if isinstance(encoders, dict):
        found |= {f"encoder of {key!r}": name for key, name in encoders.items()}
    _check_strings(found)
    return found


def origin(record: Mapping[str, Any]) -> Origin:
    """Read the origin of a run's code from the record of the run (`config.json`).

    Raises:
        TypeError: a name or a folder is not a string.
    """
    folders = record["module_folders"]
    _check_strings(folders)
    return Origin(names(record["config"]), folders)


def _check_strings(values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        if not isinstance(value, str):
            raise TypeError(f"{key} is {value!r}, not a string")


def remember(record: Mapping[str, Any]) -> None:
    """Record that this user trains a run, if the run imports code.

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
        replace_file(folder / name, json.dumps(asdict(stated)).encode())
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
        if recorded is not None and recorded.names == stated.names:
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
