"""Reference returns of merl's tasks: random actions, no motion, a scripted expert.

The numbers are in `references.json`, which `benchmarks/measure_references.py` writes. Published
numbers are quoted with their source.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from merl.core.statistics import Interval
from merl.envs.config import EnvConfig

RANDOM = "random actions"
"""Name of the reference with random actions."""
EXPERT = "scripted expert"
"""Name of the reference that solves the task with the simulator's state."""
EPISODE = 250
"""Environment steps of an episode over which all returns are measured."""


@dataclass(frozen=True)
class Reference:
    """Result of a policy on a task, for comparison.

    Attributes:
        name: name of the policy, e.g. "random actions".
        returns: mean return with a 95 % interval; if the interval is unknown, both ends are the
            mean.
        success_end: rate of success at the end of the episode, in the same form; None if unknown.
        source: origin of the numbers.
    """

    name: str
    returns: Interval
    success_end: Interval | None
    source: str


def references(
    task: str, env: EnvConfig | None = None, limit: int = EPISODE
) -> tuple[Reference, ...]:
    """Return the references of a task, from the lowest to the highest; empty if not measured.

    Args:
        task: the task's name.
        env: the form of the task; `benchmarks/measure_references.py` lists the measured forms.
        limit: environment steps after which an evaluation cuts an episode off: shorter episodes
            have no references.
    """
    if limit < EPISODE:
        return ()
    return tuple(
        Reference(
            row["name"],
            Interval(*row["return"]),
            None if row["success_end"] is None else Interval(*row["success_end"]),
            row["source"],
        )
        for row in _measured().get(form(task, env or EnvConfig()), [])
    )


def form(task: str, env: EnvConfig) -> str:
    """Return a task's name and the options that change it: "move_box around+holding staged"."""
    plain = EnvConfig()
    parts = {
        "occluded": "occluded",
        "start": "+".join(env.start),
        "reward": env.reward,
    }
    changed = (text for name, text in parts.items() if getattr(env, name) != getattr(plain, name))
    return " ".join([task, *changed])


@cache
def _measured() -> dict[str, list[dict[str, Any]]]:
    text = (files("merl.report") / "references.json").read_text()
    table: dict[str, list[dict[str, Any]]] = json.loads(text)
    return table
