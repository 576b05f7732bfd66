"""Config changes that are allowed when a run resumes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from merl.config import TrainConfig, flat, override
from merl.core import HARMLESS, MerlError

_LEFT_OPEN = {
    "device": "auto",
    "threads": None,
    "agent.precision": "auto",
    "agent.torch_compile": "auto",
    "agent.keys": None,
    "agent.critic_high": None,
    "demos_hash": None,
}
"""Values that leave a field open: merl chooses a value for this machine and records its choice."""
_DECIDED = {
    "device": "cpu",
    "threads": 1,
    "agent.precision": "fp32",
    "agent.torch_compile": "no",
}
REOPENED = ("threads", "agent.precision", "agent.torch_compile")
"""Fields that are chosen again on another machine if the user left them open."""


def left_open(config: TrainConfig) -> tuple[str, ...]:
    """Return the names of the fields that a config leaves open."""
    values = flat(config)
    return tuple(
        name for name, value in _LEFT_OPEN.items() if name in values and values[name] == value
    )


def reopened(config: TrainConfig, names: Iterable[str] = REOPENED) -> TrainConfig:
    """Return a config in which the named fields are open again."""
    return _with_known(config, {name: _LEFT_OPEN[name] for name in names})


def decided(config: TrainConfig) -> TrainConfig:
    """Return a config in which device, threads, precision and compilation are not left open."""
    return _with_known(config, _DECIDED)


def _with_known(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """Return a config with other values of the fields that it has; a user's agent lacks some."""
    known = flat(config)
    return override(config, {name: value for name, value in values.items() if name in known})


def resume_request(
    recorded: TrainConfig, steps: int | None, minutes: float | None, device: Any = None
) -> TrainConfig:
    """Return the config that asks to resume a run with other values; None keeps the recorded one.

    Raises:
        MerlError: a value is out of its range.
    """
    return dataclasses.replace(
        reopened(recorded),
        steps=recorded.steps if steps is None else steps,
        minutes=minutes,
        device=device or recorded.device,
    )


def merge_resume_config(
    recorded: TrainConfig, asked: TrainConfig, given_open: Iterable[str] = ()
) -> tuple[TrainConfig, list[str]]:
    """Return the config of a run that resumes.

    Args:
        recorded: the config so far.
        asked: the requested config; a field that it leaves open keeps its recorded value.
        given_open: names of fields to choose again, because the user left them open explicitly.

    Returns:
        The recorded config with the allowed changes, and a list of these changes as text.

    Raises:
        MerlError: a change is not allowed on resume; the message names the fields.
    """
    before, after = flat(recorded), flat(asked)
    open_fields = left_open(asked)
    changed = {
        name: (before.get(name), after.get(name))
        for name in {**before, **after}
        if before.get(name) != after.get(name)
        and name != "run_dir"
        and not (recorded.has_user_env and name.startswith("env."))  # only for merl's own tasks
        and name != "minutes"  # counted since the resume
        and (name in given_open or name not in open_fields)
    }
    as_text = {
        name: f"{name} {_format(old)} -> {_format(new)}" for name, (old, new) in changed.items()
    }
    refused = [text for name, text in as_text.items() if name not in HARMLESS]
    if refused:
        raise MerlError(
            f"run {recorded.run_dir} cannot resume with {', '.join(refused)}: keep the recorded "
            "value, or start a new run with another --run-dir"
        )
    applied = {name: after[name] for name in changed} | {"minutes": asked.minutes}
    return override(recorded, applied), list(as_text.values())


def _format(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
