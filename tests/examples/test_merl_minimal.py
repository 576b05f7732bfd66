"""The example learns, and forms its n-step returns as the replay of merl does.

`tests/bench/test_bench_update.py` compares its update with that of merl's agent.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from merl.bench.update import load_example

FILE = Path(__file__).parents[2] / "examples/merl_minimal.py"
STANDING_STILL, OPTIMUM = 10.0, 18.7  # mean returns (docs/explanation/small_tasks.md)


def test_example_has_at_most_180_lines_and_uses_only_an_environment_of_merl() -> None:
    lines = FILE.read_text().splitlines()
    assert len(lines) <= 180
    assert [line for line in lines if "import" in line and "merl" in line] == [
        "from merl.envs import dot"
    ]


@pytest.mark.parametrize("terminated", [False, True])
def test_n_step_returns_are_cut_at_the_end_of_an_episode(terminated: bool) -> None:
    example = load_example(N=3, GAMMA=0.5)
    seen = [(f"image {t}", f"joints {t}") for t in range(5)]
    episode = [
        (seen[t], f"action {t}", 2.0**t, seen[t + 1], terminated and t == 3, False)
        for t in range(4)
    ]
    found = list(example.n_step(episode))
    assert [row[:3] for row in found] == [(*seen[t], f"action {t}") for t in range(4)]
    assert [float(row[3][0]) for row in found] == [3.0, 6.0, 8.0, 8.0]
    ends = [0.0] * 3 if terminated else [0.125, 0.25, 0.5]
    assert [float(row[4][0]) for row in found] == [0.125, *ends]
    assert [row[5:] for row in found] == [seen[3], seen[4], seen[4], seen[4]]
    assert {row[i].dtype for row in found for i in (3, 4)} == {np.dtype(np.float32)}


def test_short_training_yields_evaluations() -> None:
    example = load_example(B=8)
    results = list(example.train(steps=60, wait=40, every=20))
    assert [step for step, _, _ in results] == [0, 20, 40, 60]
    for _, total, success in results:
        assert 0 < total < 20
        assert 0 <= success <= 1


@pytest.mark.long
def test_example_learns_the_dot() -> None:
    command = [sys.executable, str(FILE)]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    returns = [float(line.split()[3].rstrip(",")) for line in output.splitlines()]
    assert len(returns) == 9
    assert returns[0] < STANDING_STILL + 2
    assert returns[-1] > 0.9 * OPTIMUM
