"""The small tasks over seeds: python docs/measure_small_tasks.py [SEEDS]. Writes a row per run.

Rows that `docs/data/small_tasks.csv` has already are not measured again.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from merl.experiments.small_tasks import CASES, WHOLE, learn, optimum, returns_of

OUTPUT = Path(__file__).parent / "data" / "small_tasks.csv"
FIELDS = ("task", "agent", "seed", "steps", "return", "low", "high")


def main() -> None:
    """Measure what is missing, then print the means."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    rows = _read()
    known = {(row["task"], row["agent"], row["seed"], row["steps"]) for row in rows}
    for task, agent, steps in CASES:
        for seed in range(seeds):
            if (task, agent, str(seed), str(steps)) in known:
                continue
            with tempfile.TemporaryDirectory() as folder:
                result = learn(task, agent, seed=seed, steps=steps, run_dir=Path(folder) / "run")
            mean, low, high = (f"{value:.2f}" for value in result.returns)
            row = dict(zip(FIELDS, (task, agent, seed, steps, mean, low, high), strict=True))
            rows.append({key: str(value) for key, value in row.items()})
            _write(rows)
            print(*row.values(), flush=True)
    best, still = optimum(WHOLE), np.mean(returns_of(lambda env: 0 * env.best_action(), WHOLE))
    print(f"the dot: straight to the mark {best:.2f}, standing still {still:.2f}")
    for task, agent, steps in CASES:
        told = [float(r["return"]) for r in rows if (r["task"], r["agent"]) == (task, agent)]
        print(f"{task} {agent}, {steps} steps, {len(told)} seeds: mean {np.mean(told):.2f}", told)


def _read() -> list[dict[str, Any]]:
    if not OUTPUT.exists():
        return []
    with OUTPUT.open() as file:
        return list(csv.DictReader(file))


def _write(rows: list[dict[str, Any]]) -> None:
    with OUTPUT.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
