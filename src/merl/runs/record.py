"""The record of a run, `config.json`: config, spaces, versions, machine, and each resume."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from gymnasium import spaces

import merl
from merl.agents import AGENTS
from merl.agents.config import ObservationConfig, UnloadedConfig
from merl.config import TrainConfig
from merl.core import CONFIG_FILE, MerlError, check_choice
from merl.core.files import cause, read_json, replace_file, reporting, sealed
from merl.core.user_code import module_folder
from merl.runs import trust
from merl.runs.plain import box, describe, from_plain, to_plain, told
from merl.runs.provenance import commit, machine, package_versions
from merl.runs.run_folder import holds_nothing, program

FORMAT = 2
Bounds = tuple[list[float], list[float]]
"""Lower and upper bounds of the environment's actions before rescaling."""


def describe_config(config: TrainConfig, left_open: tuple[str, ...]) -> dict[str, Any]:
    """Return the part of a record that a resume replaces."""
    plain = to_plain(config)
    folders = {name: module_folder(name) for name in trust.names(plain).values()}
    return {
        "config": plain,
        "left_open": list(left_open),
        "module_folders": {name: str(at) for name, at in folders.items() if at is not None},
    }


def describe_spaces(
    observation: spaces.Dict, action: spaces.Box, bounds: Bounds | None
) -> dict[str, Any]:
    """Return the part of a record that describes the environment."""
    return {
        "observation_space": {key: describe(space) for key, space in observation.items()},
        "action_space": describe(action) | {"own_bounds": bounds},
    }


def describe_origin() -> dict[str, Any]:
    """Return the part of a record that describes the versions and the machine."""
    return {
        "merl": merl.__version__,
        "versions": package_versions(),
        "commit": commit(),
        "machine": machine(),
    }


def read(folder: Path) -> dict[str, Any]:
    """Return the record of a run.

    Raises:
        MerlError: it cannot be read, or its format is not that of this version.
    """
    with readable(folder):
        record: dict[str, Any] = read_json(folder / CONFIG_FILE)
        number = record["format"]
        if number != FORMAT:
            raise MerlError(
                f"it has format {number}, but this version of merl reads format {FORMAT}"
            )
        return record


def write(folder: Path, record: Mapping[str, Any]) -> None:
    """Replace the record of a run atomically.

    Raises:
        MerlError: the folder cannot be written.
    """
    with reporting(f"{folder} is not writable"):
        replace_file(folder / CONFIG_FILE, json.dumps(sealed(record), indent=1).encode())


def config_of(record: Mapping[str, Any]) -> TrainConfig:
    """Return the config; the agent's name selects the class of the agent's config.

    That of a user's own agent is an `UnloadedConfig`.
    """
    plain, name = record["config"], record["config"]["agent_name"]
    if isinstance(name, str) and ":" in name:
        values = plain["agent"]
        keys = {field.name: values[field.name] for field in fields(ObservationConfig)}
        plain = {**plain, "agent": {**keys, "values": values}}
        return from_plain(TrainConfig, plain, agent=UnloadedConfig)
    check_choice("agent", name, tuple(AGENTS))
    return from_plain(TrainConfig, plain, agent=type(AGENTS[name].config))


def spaces_of(record: Mapping[str, Any]) -> tuple[spaces.Dict, spaces.Box]:
    """Return the observation and action space."""
    observation: dict[str, spaces.Space[Any]] = {
        key: box(described) for key, described in record["observation_space"].items()
    }
    return spaces.Dict(observation), box(record["action_space"])


def machine_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the machine on which the run was last trained."""
    last: dict[str, Any] = record.get("resumed", [record])[-1]["machine"]
    return last


def changed_spaces(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the differences between two results of `describe_spaces` as text."""
    was, is_ = _told(before), _told(now)
    return [
        f"{name} was {was.get(name, 'missing')} and is {is_.get(name, 'missing')}"
        for name in was | is_
        if was.get(name) != is_.get(name)
    ]


def _told(described: Mapping[str, Any]) -> dict[str, str]:
    action = described["action_space"]
    words = {f"observation {k!r}": told(s) for k, s in described["observation_space"].items()}
    words["action"] = told(action)
    if action["own_bounds"] is not None:
        words["the actions' bounds"] = "low {}, high {}".format(*action["own_bounds"])
    return words


@contextmanager
def readable(folder: Path) -> Iterator[None]:
    """Convert an error inside the block into a one-line error about the record of the run."""
    file = folder / CONFIG_FILE
    try:
        yield
    except FileNotFoundError:
        way = ""
        if holds_nothing(folder):
            way = (
                " and no other files: start it with the original command, "
                f"{program()} train ... --run-dir {shlex.quote(str(folder))}"
            )
        raise MerlError(f"{folder} is not a run: it has no {CONFIG_FILE}{way}") from None
    except Exception as error:  # the file may come from anyone
        reason = str(error)
        if isinstance(error, KeyError):
            reason = f"it has no {error}"
        elif isinstance(error, OSError):
            reason = cause(error)
        raise MerlError(f"{file} cannot be read: {reason}") from error
