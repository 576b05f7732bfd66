"""What may change when a run goes on, and what makes it another run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

from merl.config import TrainConfig
from merl.core import MerlError

HARMLESS = (
    "steps",
    "measure",
    "minutes",
    "worker_restarts",
    "worker_timeout",
    "save_every",
    "keep",
    "device",
    "threads",
    "env.render_size",
    "eval.every",
    "eval.episodes",
    "eval.max_episode_steps",
    "eval.video",
    "eval.references",
    "agent.precision",
    "agent.torch_compile",
)
"""Fields that may change: they decide how long, how fast and how closely watched, not what."""
_LEFT_OPEN = {
    "device": "auto",
    "threads": None,
    "agent.precision": "auto",
    "agent.torch_compile": "auto",
    "agent.images": None,
    "agent.vectors": None,
    "agent.critic_high": None,
}
"""Values that leave a field open: the machine decides, and what it has decided is recorded."""
REOPENED = ("threads", "agent.precision", "agent.torch_compile")
"""Fields that another machine decides anew, if they were left open."""
_NAMES = ("run_dir", "preset", "setting")
"""Fields that only say where the others are from."""


def left_open(config: TrainConfig) -> tuple[str, ...]:
    """Names of the fields that a config leaves for the machine to decide."""
    values = dict(_flat(config))
    return tuple(name for name, value in _LEFT_OPEN.items() if values[name] == value)


def reopened(config: TrainConfig, names: Iterable[str] = REOPENED) -> TrainConfig:
    """A config with fields left open again."""
    for name in names:
        config = _replaced(config, name, _LEFT_OPEN[name])
    return config


def decided(config: TrainConfig) -> TrainConfig:
    """A config that leaves nothing open, with any values."""
    values = {
        "device": "cpu",
        "threads": 1,
        "agent.precision": "fp32",
        "agent.torch_compile": "no",
    }
    for name, value in values.items():
        config = _replaced(config, name, value)
    return config


def merge_resume_config(
    recorded: TrainConfig, asked: TrainConfig, given_open: Iterable[str] = ()
) -> tuple[TrainConfig, list[str]]:
    """The config with which a run goes on.

    Args:
        recorded: what it was trained with so far.
        asked: what it is to be trained with; a field that is left open keeps its recorded value.
        given_open: names of fields that are to be decided anew, since the user asks for that.

    Returns:
        The recorded config with the harmless changes, and these in words.

    Raises:
        MerlError: what is asked for would be another run; it names the fields.
    """
    before, after = dict(_flat(recorded)), dict(_flat(asked))
    open_fields = left_open(asked)
    changed = {
        name: (before.get(name), after.get(name))
        for name in {**before, **after}
        if before.get(name) != after.get(name)
        and name not in _NAMES
        and not (recorded.own_env and name.startswith("env."))  # of merl's own tasks alone
        and name != "minutes"  # those of the stretch that begins
        and (name in given_open or name not in open_fields)
    }
    in_words = {
        name: f"{name} {_told(old)} -> {_told(new)}" for name, (old, new) in changed.items()
    }
    refused = [words for name, words in in_words.items() if name not in HARMLESS]
    if refused:
        raise MerlError(
            f"run {recorded.run_dir} cannot go on with {', '.join(refused)}: that is another run; "
            "leave it as it was, or begin one with another --run-dir"
        )
    config = recorded
    for name in changed:
        config = _replaced(config, name, after[name])
    config = dataclasses.replace(config, minutes=asked.minutes)
    return config, list(in_words.values())


def _flat(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every field of a config and of the configs in it, by its dotted name."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", value


def _replaced(config: Any, name: str, value: Any) -> Any:
    first, _, rest = name.partition(".")
    if rest:
        value = _replaced(getattr(config, first), rest, value)
    return dataclasses.replace(config, **{first: value})


def _told(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
