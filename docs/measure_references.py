"""Measure what returns are compared with: random actions, no motion, the expert.

python docs/measure_references.py [EPISODES]

Writes src/merl/report/references.json. No picture is drawn, so the renderer does not matter.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from merl.envs import make_env
from merl.envs.expert import ExpertPolicy
from merl.report.references import OCCLUDED
from merl.tasks import BOX_TASKS, TASKS
from merl.training.evaluation import Evaluation, evaluate

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


def measure(task: str, occluded: bool, episodes: int) -> list[dict[str, object]]:
    """The rows of one task."""
    env = make_env(task, renderer="warp", observations=("proprio",), occluded=occluded)
    rng = np.random.default_rng(0)
    expert = ExpertPolicy(env)
    policies = {
        "random actions": (lambda _: rng.uniform(-1, 1, 9).astype(np.float32), lambda: None),
        "no motion": (lambda _: np.zeros(9, np.float32), lambda: None),
        "scripted expert": (expert, expert.reset),
    }
    rows = []
    for name, (act, reset) in policies.items():
        result = evaluate(act, env, episodes, reset=reset)
        print(task, "occluded" * occluded, name, result.metrics(), flush=True)
        rows.append(row(name, result))
    env.close()
    return rows


def row(name: str, result: Evaluation) -> dict[str, object]:
    """One policy's numbers, rounded to what their intervals allow."""
    assert result.success_end is not None
    return {
        "name": name,
        "return": [round(value, 1) for value in result.returns],
        "success_end": [round(value, 3) for value in result.success_end],
        "terms": {
            term: round(float(np.mean([e.terms[term] for e in result.episodes])), 1)
            for term in result.episodes[0].terms
        },
        "source": f"{len(result.episodes)} episodes",
    }


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    table = {task: measure(task, False, count) + PUBLISHED.get(task, []) for task in TASKS}
    table |= {task + OCCLUDED: measure(task, True, count) for task in BOX_TASKS}
    OUTPUT.write_text(json.dumps(table, indent=1) + "\n")
