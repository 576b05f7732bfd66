"""An action held for some steps: rewards are summed, an episode's end is not passed over."""

from __future__ import annotations

import numpy as np
import pytest

from merl.envs.action_repeat import ActionRepeat
from toy import DotEnv

ACTION = np.array([0.1], np.float32)


@pytest.mark.parametrize(("repeat", "decisions"), [(1, 10), (2, 5), (3, 4), (20, 1)])
def test_it_is_the_same_episode(repeat: int, decisions: int) -> None:
    plain, held = DotEnv(), ActionRepeat(DotEnv(), repeat)
    plain.reset(seed=3)
    held.reset(seed=3)
    paid = np.array([plain.step(ACTION)[1] for _ in range(10)])
    told, near, over = [], 0.0, False
    while not over:
        observation, reward, terminated, truncated, info = held.step(ACTION)
        told.append(float(reward))
        near += info["reward_terms"]["near"]
        over = terminated or truncated
    assert len(told) == decisions
    assert told[0] == pytest.approx(paid[:repeat].sum())
    assert sum(told) == pytest.approx(near) == pytest.approx(paid.sum())
    assert observation["joint"][1] == 10
    assert truncated


def test_a_true_end_stays_one() -> None:
    held = ActionRepeat(DotEnv(ends_truly=True), 4)
    held.reset(seed=0)
    ends = [held.step(ACTION)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (True, False)]


def test_films_stay_in_real_time() -> None:
    assert ActionRepeat(DotEnv(), 2).metadata["render_fps"] == 12.5
    assert DotEnv().metadata["render_fps"] == 25
