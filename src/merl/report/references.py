"""What a return is to be compared with: acting at random, not acting, a scripted expert.

The numbers lie in `references.json`, which `docs/measure_references.py` writes; those of others are
quoted with their source.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from merl.envs.config import EnvConfig
from merl.statistics import Interval


@dataclass(frozen=True)
class Reference:
    """How something else does on a task.

    Attributes:
        name: what it is, e.g. "random actions".
        returns: its mean return with a 95 % interval; without one both ends are the mean.
        success_end: its rate of success at the end of the episode, likewise; None if not known.
        source: where the number comes from.
    """

    name: str
    returns: Interval
    success_end: Interval | None
    source: str


def references(task: str, env: EnvConfig | None = None) -> tuple[Reference, ...]:
    """The references of a task, from the least to the best; none where none were measured.

    Args:
        task: the task's name.
        env: its form: occluded or not; of the others none were measured.
    """
    form, plain = env or EnvConfig(), EnvConfig()
    if any(getattr(form, name) != getattr(plain, name) for name in UNMEASURED):
        return ()
    rows = _measured().get(task + OCCLUDED * form.occluded, [])
    return tuple(
        Reference(
            row["name"],
            Interval(*row["return"]),
            None if row["success_end"] is None else Interval(*row["success_end"]),
            row["source"],
        )
        for row in rows
    )


OCCLUDED = " occluded"
"""What is added to a task's name for its occluded form."""


UNMEASURED = ("start", "goal_reward", "floor")
"""Fields of `EnvConfig` that make a task another one, for which there are no references."""


@cache
def _measured() -> dict[str, list[dict[str, Any]]]:
    text = (files("merl.report") / "references.json").read_text()
    table: dict[str, list[dict[str, Any]]] = json.loads(text)
    return table
