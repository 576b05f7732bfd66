"""Agents learn small tasks whose best return is known; see docs/explanation/small_tasks.md."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from merl.core.statistics import bootstrap_interval
from merl.report.curves import read_metrics
from small_tasks import (
    CASES,
    PENDULUM,
    SPLIT,
    WHOLE,
    Case,
    Precision,
    learn,
    optimum,
    returns_of,
)

STEPS = {(case.task, case.agent): case.steps for case in CASES}


def mean_return(task: str, agent: str, seed: int, folder: Path, steps: int | None = None) -> float:
    case = Case(task, agent, steps or STEPS[task, agent])
    return learn(case, seed=seed, run_dir=folder / f"{agent}-{seed}").returns.mean


@pytest.mark.long
@pytest.mark.parametrize(("agent", "seed"), [*product(("ddpg", "sac"), range(3))])
def test_agent_swings_up_the_pendulum(agent: str, seed: int, tmp_path: Path) -> None:
    assert mean_return(PENDULUM, agent, seed, tmp_path) > -250


@pytest.mark.parametrize(("agent", "steps"), [("ddpg", 2500), ("sac", 3000)])
def test_short_training_on_pendulum_beats_zero_actions(
    agent: str, steps: int, tmp_path: Path
) -> None:
    still = returns_of(lambda env: env.action_space.low * 0, PENDULUM)
    early = mean_return(PENDULUM, agent, 0, tmp_path, steps=steps)
    assert early > sum(still) / len(still) / 2


def test_short_training_on_dot_beats_zero_actions(tmp_path: Path) -> None:
    still = returns_of(lambda env: 0 * env.best_action(), WHOLE)
    early = mean_return(WHOLE, "merl", 0, tmp_path, steps=2000)
    assert early > (sum(still) / len(still) + optimum(WHOLE)) / 2


@pytest.mark.long
@pytest.mark.parametrize("agent", ["merl", "drqv2"])
def test_agent_solves_dot(agent: str, tmp_path: Path) -> None:
    assert mean_return(WHOLE, agent, 0, tmp_path) > 0.9 * optimum(WHOLE)


@pytest.mark.long
def test_split_task_needs_both_modalities(tmp_path: Path) -> None:
    intervals = {
        agent: bootstrap_interval([mean_return(SPLIT, agent, seed, tmp_path) for seed in range(5)])
        for agent in ("merl", "drqv2", "proprio")
    }
    assert intervals["merl"].mean > 0.85 * optimum(SPLIT)
    for alone in ("drqv2", "proprio"):
        assert intervals[alone].high < intervals["merl"].low


@pytest.mark.long
def test_agent_learns_in_bf16_as_in_fp32(tmp_path: Path) -> None:
    """The mean curve in bf16 is within two standard deviations of the seeds in fp32."""
    steps = STEPS[SPLIT, "merl"]

    def curves(precision: Precision, seeds: int) -> NDArray[np.float64]:
        found = []
        for seed in range(seeds):
            run = tmp_path / f"{precision}-{seed}"
            learn(Case(SPLIT, "merl", steps, precision), seed=seed, run_dir=run, evaluations=4)
            curve = read_metrics(run)["eval/return"]
            found.append(curve[~np.isnan(curve)])
        return np.stack(found)  # (seeds, evaluations)

    single, half = curves("fp32", 5), curves("bf16", 3)
    difference = abs(half.mean(axis=0) - single.mean(axis=0))
    assert (difference < 2 * single.std(axis=0, ddof=1)).all()
