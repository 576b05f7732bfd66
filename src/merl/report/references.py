"""What a return is to be compared with: acting at random, not acting, a scripted expert.

The numbers lie in `references.json`, which `benchmarks/measure_references.py` writes; those of
others are quoted with their source.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

from merl.core.statistics import Interval
from merl.envs.config import EnvConfig

RANDOM = "random actions"
"""The reference that acts at random."""
EXPERT = "scripted expert"
"""The reference that solves the task with the simulator's state."""


@dataclass(frozen=True)
class Reference:
    """How something else does on a task.

    Attributes:
        name: what it is, e.g. "random actions".
        returns: its mean return with a 95 % interval; without one both ends are the mean.
        success_end: its rate of success at the end of the episode, likewise; None if not known.
        source: where the number comes from.
        terms: the mean sum of each of the reward's terms over an episode; empty if not known.
    """

    name: str
    returns: Interval
    success_end: Interval | None
    source: str
    terms: dict[str, float] = field(default_factory=dict)


def references(task: str, env: EnvConfig | None = None) -> tuple[Reference, ...]:
    """The references of a task, from the least to the best; none where none were measured.

    Args:
        task: the task's name.
        env: its form; which are measured, `benchmarks/measure_references.py` says.
    """
    return tuple(
        Reference(
            row["name"],
            Interval(*row["return"]),
            None if row["success_end"] is None else Interval(*row["success_end"]),
            row["source"],
            row.get("terms", {}),
        )
        for row in _measured().get(form(task, env or EnvConfig()), [])
    )


def form(task: str, env: EnvConfig) -> str:
    """A task's name and what makes it another task, e.g. "move_box around+holding staged"."""
    plain = EnvConfig()
    parts = {
        "occluded": "occluded",
        "start": "+".join(env.start),
        "reward": env.reward,
    }
    changed = (told for name, told in parts.items() if getattr(env, name) != getattr(plain, name))
    return " ".join([task, *changed])


@cache
def _measured() -> dict[str, list[dict[str, Any]]]:
    text = (files("merl.report") / "references.json").read_text()
    table: dict[str, list[dict[str, Any]]] = json.loads(text)
    return table
