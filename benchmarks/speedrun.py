"""Print the results of the runs of benchmarks/speedrun.sh: python benchmarks/speedrun.py.

A row for each form and length: the mean over seeds of return and of success at the end, over 50
episodes each, with the least and the greatest seed, and after how many minutes the training
evaluations' success, averaged over the seeds, has reached 50 and 80 %.
"""

from __future__ import annotations

import csv
import json
import re
from collections import defaultdict
from pathlib import Path
from statistics import fmean

DATA = Path(__file__).resolve().parent.parent / "results/speedrun"


def main() -> None:
    """Print the table."""
    groups: dict[str, list[str]] = defaultdict(list)
    for path in sorted(DATA.glob("*-evaluation.json")):
        name = path.name.removesuffix("-evaluation.json")
        groups[re.sub(r"-s\d+$", "", name)].append(name)
    print("| runs | seeds | steps | return | success at the end | 50 % after | 80 % after |")
    print("|---|---|---|---|---|---|---|")
    for group, names in groups.items():
        evaluated = [json.loads((DATA / f"{name}-evaluation.json").read_text()) for name in names]
        returns = [fmean(episode["return"] for episode in run["episodes"]) for run in evaluated]
        success = [
            100 * fmean(episode["success_end"] for episode in run["episodes"]) for run in evaluated
        ]
        curves = [evaluations(DATA / f"{name}.csv") for name in names]
        cells = [
            group,
            str(len(names)),
            f"{fmean(run['step'] for run in evaluated):,.0f}",
            f"{fmean(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})",
            f"{fmean(success):.0f} % ({min(success):.0f} to {max(success):.0f})",
            *(minutes(curves, share) for share in (0.5, 0.8)),
        ]
        print(f"| {' | '.join(cells)} |")


def evaluations(path: Path) -> list[tuple[float, float]]:
    """Return minutes and success at the end of each evaluation during training."""
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row["eval/success_end"]]
    return [(float(row["time/seconds"]) / 60, float(row["eval/success_end"])) for row in rows]


def minutes(curves: list[list[tuple[float, float]]], share: float) -> str:
    """Return when the mean over the runs of each one's latest success first reaches a share."""
    for now in sorted(time for curve in curves for time, _ in curve):
        latest = [[success for time, success in curve if time <= now][-1:] for curve in curves]
        if all(latest) and fmean(success for (success,) in latest) >= share:
            return f"{now:.0f} min"
    return "not reached"


if __name__ == "__main__":
    main()
