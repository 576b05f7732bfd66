"""Train on the small tasks with several seeds; write one row per evaluation.

    python benchmarks/measure_small_tasks.py [SEEDS]

Runs that are complete in `results/small_tasks.csv` are not repeated.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path

import numpy as np

from merl.core.statistics import bootstrap_interval
from merl.report.curves import read_metrics
from small_tasks import CASES, WHOLE, Case, learn, optimum, returns_of

EVALUATIONS = 10  # per run; the last one is at its end
OUTPUT = Path(__file__).resolve().parent.parent / "results/small_tasks.csv"
COLUMNS = {"step": "step", "return": "eval/return"} | {
    end: f"eval/return_{end}" for end in ("low", "high")
}
FIELDS = ("task", "agent", "precision", "seed", *COLUMNS)


def main() -> None:
    """Train the missing runs, then print the means."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    rows = _read()
    for case in CASES:
        for seed in range(seeds):
            this = _named(case) | {"seed": str(seed)}
            if any(row == row | this | {"step": str(case.steps)} for row in rows):
                continue
            rows += [this | row for row in measured(case, seed)]
            _write(rows)
            print(*rows[-1].values(), flush=True)
    best, still = optimum(WHOLE), np.mean(returns_of(lambda env: 0 * env.best_action(), WHOLE))
    print(f"the dot: straight to the mark {best:.2f}, standing still {still:.2f}")
    for case in CASES:
        this = _named(case) | {"step": str(case.steps)}
        returns = [float(row["return"]) for row in rows if row == row | this]
        mean, low, high = bootstrap_interval(returns)
        print(
            f"{' '.join(map(str, case))} steps: {mean:.2f} [{low:.2f}, {high:.2f}]", sorted(returns)
        )


def _named(case: Case) -> dict[str, str]:
    return {"task": case.task, "agent": case.agent, "precision": case.precision}


def measured(case: Case, seed: int) -> list[dict[str, str]]:
    """Train one run; return a row for each of its evaluations."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        learn(case, seed=seed, run_dir=run, evaluations=EVALUATIONS)
        metrics = read_metrics(run)
    return [
        {field: f"{metrics[column][row]:.7g}" for field, column in COLUMNS.items()}
        for row in np.flatnonzero(~np.isnan(metrics["eval/return"]))
    ]


def _read() -> list[dict[str, str]]:
    if not OUTPUT.exists():
        return []
    with OUTPUT.open() as file:
        return list(csv.DictReader(file))


def _write(rows: list[dict[str, str]]) -> None:
    with OUTPUT.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
