"""Measure the scripted experts with noise on their actions: success, and the time to it.

    python benchmarks/measure_expert.py [--episodes 100] [--jobs 2]

Gaussian noise of the given standard deviation is added to every action, in [-1, 1], before it is
clipped. Prints a table, and writes a row for each task and noise to results/expert.csv.
"""

from __future__ import annotations

import argparse
import csv
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from merl.core.statistics import wilson_interval
from merl.envs import make_env
from merl.envs.expert_policy import ExpertPolicy
from merl.evaluation.evaluation import EVALUATION_SEED

OUTPUT = Path(__file__).resolve().parent.parent / "results/expert.csv"
TASKS = (("reach_duplo", False), ("move_box", False), ("lift_box", False))
OCCLUDED = (("move_box", True), ("lift_box", True))
NOISE = (0.0, 0.1, 0.2)


def measure(task: str, occluded: bool, noise: float, episodes: int) -> dict[str, Any]:
    """Return the results of the expert of a task with noise."""
    env = make_env(task, occluded=occluded, observations=("state",))
    policy = ExpertPolicy(env)
    ends, returns, times = [], [], []
    for index in range(episodes):
        observation, _ = env.reset(seed=EVALUATION_SEED + index)
        policy.reset()
        generator = np.random.default_rng(index)
        total, first, over, success, step = 0.0, None, False, False, 0
        while not over:
            action = policy(observation)
            noisy = np.clip(action + generator.normal(0.0, noise, action.shape), -1.0, 1.0)
            observation, reward, terminated, truncated, info = env.step(noisy.astype(np.float32))
            step += 1
            total, over, success = total + reward, terminated or truncated, bool(info["success"])
            first = step if success and first is None else first
        ends.append(success)
        returns.append(total)
        times += [] if first is None else [first]
    env.close()
    end = wilson_interval(sum(ends), episodes)
    return {
        "task": f"{task} occluded" if occluded else task,
        "noise": noise,
        "episodes": episodes,
        "success_end": end.mean,
        "success_end_low": end.low,
        "success_end_high": end.high,
        "success_any": len(times) / episodes,
        "steps_to_success": round(fmean(times), 1) if times else "",
        "return": round(fmean(returns), 1),
    }


def main() -> None:
    """Measure all tasks and noises."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    cases = [(*task, noise) for task, noise in product(TASKS, NOISE)]
    cases += [(*task, 0.0) for task in OCCLUDED]
    with ProcessPoolExecutor(options.jobs) as pool:
        rows = list(pool.map(measure, *zip(*cases, strict=True), [options.episodes] * len(cases)))
    with OUTPUT.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0]])
        writer.writeheader()
        writer.writerows(rows)
    print("| task | noise | success at the end | at any time | steps to success | return |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        success = "{success_end:.0%} [{success_end_low:.0%}, {success_end_high:.0%}]".format(**row)
        numbers = "{success_any:.0%} | {steps_to_success} | {return}".format(**row)
        print(f"| `{row['task']}` | {row['noise']} | {success} | {numbers} |")


if __name__ == "__main__":
    main()
