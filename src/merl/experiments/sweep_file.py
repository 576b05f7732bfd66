"""A sweep of the user's own: a TOML file.

title = "Size of the image"
tasks = ["reach_duplo"]
preset = "laptop"

[values]                  # of all runs
steps = 100_000

[variants.small]          # values of one variant, and its agent, preset and setting
env.image_size = 16
[variants.large]
env.image_size = 48

[grid]                    # in place of variants: all combinations
agent.latent_dim = [64, 128]
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from merl.core import MerlError, check_choice
from merl.core.files import cause, read_file
from merl.experiments.experiment import Experiment, Variant, variants_of

KEYS = ("title", "tasks", "preset", "values", "variants", "grid")
TABLES = ("values", "variants", "grid")


def read_experiment(path: Path) -> Experiment:
    """Return the experiment in a TOML file.

    Raises:
        MerlError: the file cannot be read, or a part of it is missing, unknown or of another kind.
    """
    try:
        content = tomllib.loads(read_file(path).decode())
    except OSError as error:
        raise MerlError(f"{path} cannot be read: {cause(error)}") from None
    except ValueError as error:  # also text that is not UTF-8
        raise MerlError(f"{path} is not TOML: {error}") from None
    for key, value in content.items():
        check_choice(f"{path}: key", key, KEYS)
        kind = dict if key in TABLES else list if key == "tasks" else str
        if not isinstance(value, kind):
            what = {dict: "a table", list: "a list", str: "a text"}[kind]
            raise MerlError(f"{path}: {key} must be {what}, not {value!r}")
    tasks = content.get("tasks", [])
    if not tasks or not all(isinstance(task, str) for task in tasks):
        raise MerlError(f'{path} names no tasks: add a line like tasks = ["reach_duplo"]')
    if bool(content.get("variants")) == bool(content.get("grid")):
        raise MerlError(f"{path} needs one of [variants.NAME], a table each, and [grid]")
    common = dict(_flat(content.get("values", {})))
    agent = _agent(path, common)
    if content.get("grid"):
        grid = variants_of(_grid(path, content["grid"]))
        variants = tuple(
            replace(each, values=(own := dict(each.values)), agent=_agent(path, own))
            for each in grid
        )
    else:
        variants = tuple(_variant(path, *item) for item in content["variants"].items())
    variants = tuple(replace(each, agent=each.agent or agent) for each in variants)
    return Experiment(
        content.get("title", path.stem),
        variants,
        tuple(tasks),
        common,
        content.get("preset"),
    )


def _grid(path: Path, table: Mapping[str, Any]) -> dict[str, list[Any]]:
    grid = dict(_flat(table))
    for name, values in grid.items():
        if not isinstance(values, tuple) or not values:
            raise MerlError(f"{path}: [grid] needs a list of values for {name}, not {values!r}")
    return grid


def _variant(path: Path, name: str, table: Any) -> Variant:
    if not isinstance(table, dict):
        raise MerlError(f"{path}: variants.{name} must be a table, not {table!r}")
    own = {key: table[key] for key in ("preset", "setting") if key in table}
    values = dict(_flat({key: value for key, value in table.items() if key not in own}))
    return Variant(name, _agent(path, values), values, **own)


def _agent(path: Path, values: dict[str, Any]) -> str | None:
    """Take the agent's name out of the values."""
    agent = values.pop("agent_name", None)
    if not (agent is None or isinstance(agent, str)):
        raise MerlError(f"{path}: agent_name must be a text, not {agent!r}")
    return agent


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables by their dotted names; lists as tuples."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, _as_tuple(value)


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value
