"""Measure the reference returns: random actions, no motion, the expert.

    python benchmarks/measure_references.py [EPISODES [FORM ...]]

Writes src/merl/report/references.json: all forms of the tasks, or the named ones ("lift_box
occluded"). No image is rendered, so the renderer does not matter.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from merl.envs import EnvConfig, make_env
from merl.envs.expert_policy import ExpertPolicy
from merl.evaluation.evaluation import Evaluation, evaluate
from merl.report.references import form
from merl.tasks import BOX_TASKS, TASKS

OUTPUT = Path(__file__).parent.parent / "src/merl/report/references.json"
PUBLISHED = {
    "reach_duplo": [
        {
            "name": "best known: DrQ-v2",
            "return": [224.6, 224.6, 224.6],
            "success_end": None,
            "source": "published, 2.98M frames, 10 seeds",
        }
    ]
}


FORMS: list[tuple[str, dict[str, Any]]] = [
    *((task, {}) for task in TASKS),
    *((task, {"reward": "staged"}) for task in BOX_TASKS),
    *((task, {"occluded": True}) for task in BOX_TASKS),
]


def measure(task: str, settings: dict[str, Any], episodes: int) -> list[dict[str, object]]:
    """Measure one task in one form; return a row for each policy."""
    env = make_env(task, renderer="raster", observations=("proprio",), **settings)
    rng = np.random.default_rng(0)
    expert = ExpertPolicy(env)
    policies: dict[str, tuple[Callable[..., Any], Callable[[], None]]] = {
        "random actions": (lambda _: rng.uniform(-1, 1, 9).astype(np.float32), lambda: None),
        "no motion": (lambda _: np.zeros(9, np.float32), lambda: None),
        "scripted expert": (expert, expert.reset),
    }
    rows = []
    for name, (act, reset) in policies.items():
        result = evaluate(act, env, episodes, reset=reset)
        print(form(task, env.config), name, result.metrics(), flush=True)
        rows.append(row(name, result))
    env.close()
    return rows


def row(name: str, result: Evaluation) -> dict[str, object]:
    """Return one policy's numbers, rounded in proportion to their intervals."""
    assert result.success_end is not None
    return {
        "name": name,
        "return": [round(value, 1) for value in result.returns],
        "success_end": [round(value, 3) for value in result.success_end],
        "source": f"{len(result.episodes)} episodes",
    }


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    table = json.loads(OUTPUT.read_text())
    for task, settings in FORMS:
        name = form(task, EnvConfig(**settings))
        if name in (sys.argv[2:] or [name]):
            table[name] = measure(task, settings, count) + PUBLISHED.get(name, [])
    OUTPUT.write_text(json.dumps(table, indent=1) + "\n")
