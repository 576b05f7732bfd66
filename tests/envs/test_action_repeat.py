"""Action repeat: rewards are summed, and the repetition stops at the end of an episode."""

from __future__ import annotations

import numpy as np
import pytest

from merl.envs.action_repeat import ActionRepeat
from toy import DotEnv

ACTION = np.array([0.1], np.float32)


@pytest.mark.parametrize(("repeat", "decisions"), [(1, 10), (2, 5), (3, 4), (20, 1)])
def test_repeated_actions_give_the_same_episode(repeat: int, decisions: int) -> None:
    plain, held = DotEnv(), ActionRepeat(DotEnv(), repeat)
    plain.reset(seed=3)
    held.reset(seed=3)
    expected = np.array([plain.step(ACTION)[1] for _ in range(10)])
    rewards, near_terms, done = [], 0.0, False
    while not done:
        observation, reward, terminated, truncated, info = held.step(ACTION)
        rewards.append(float(reward))
        near_terms += info["reward_terms"]["near"]
        done = terminated or truncated
    assert len(rewards) == decisions
    assert rewards[0] == pytest.approx(expected[:repeat].sum())
    assert sum(rewards) == pytest.approx(near_terms) == pytest.approx(expected.sum())
    assert observation["joint"][1] == 10
    assert truncated


def test_a_true_end_of_an_episode_is_reported() -> None:
    held = ActionRepeat(DotEnv(ends_truly=True), 4)
    held.reset(seed=0)
    ends = [held.step(ACTION)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (True, False)]


def test_videos_keep_real_time() -> None:
    assert ActionRepeat(DotEnv(), 2).metadata["render_fps"] == 12.5
    assert DotEnv().metadata["render_fps"] == 25
