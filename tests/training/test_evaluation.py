from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from merl.core import MerlError
from merl.training import evaluation
from merl.training.evaluation import EVALUATION_SEED, evaluate
from toy import DotEnv


def still(observation: Any) -> Any:
    return np.zeros(1, np.float32)


def test_every_evaluation_has_the_same_starts_whatever_came_before() -> None:
    env = DotEnv()
    first = evaluate(still, env, 5)
    env.reset(seed=3)
    assert [e.total_reward for e in evaluate(still, env, 5).episodes] == [
        e.total_reward for e in first.episodes
    ]
    starts = []
    for index in range(5):
        env.reset(seed=EVALUATION_SEED + index)
        starts.append(env.x)
    assert [e.total_reward for e in first.episodes] == pytest.approx(
        [10 * (1 - abs(x)) for x in starts]
    )


def test_success_at_the_end_and_at_any_time_are_told_apart() -> None:
    def pass_by(observation: Any) -> Any:
        """Through the middle, and out at the other end."""
        return np.ones(1, np.float32)

    result = evaluate(pass_by, DotEnv(), 20)
    assert result.success_end is not None
    assert result.success_any is not None
    assert result.success_end.mean == 0.0
    assert 0.0 < result.success_any.mean < 1.0
    assert result.success_share is not None
    assert 0.0 < result.success_share.mean < result.success_any.mean
    metrics = result.metrics()
    assert metrics["success_end_low"] <= metrics["success_end"] <= metrics["success_end_high"]
    assert metrics["episodes"] == 20
    assert metrics["reward/near"] == pytest.approx(metrics["return"])


def test_the_policy_is_reset_before_each_episode() -> None:
    calls: list[str] = []

    def act(observation: Any) -> Any:
        calls.append("act")
        return still(observation)

    evaluate(act, DotEnv(), 3, reset=lambda: calls.append("reset"))
    assert calls == (["reset"] + ["act"] * 10) * 3


def test_the_first_episode_is_filmed_in_real_time(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    evaluate(still, DotEnv(), 2, video=film)
    with av.open(str(film)) as container:
        assert container.streams.video[0].average_rate == 25
        assert sum(1 for _ in container.decode(video=0)) == 10


def test_a_video_that_cannot_be_made_does_not_cost_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise MerlError("film.mp4 cannot be written: No space left on device")

    monkeypatch.setattr(evaluation.VideoWriter, "add", full)
    plain = evaluate(still, DotEnv(), 3)
    told: list[str] = []
    result = evaluate(still, DotEnv(), 3, video=tmp_path / "film.mp4", warn=told.append)
    assert [e.total_reward for e in result.episodes] == [e.total_reward for e in plain.episodes]
    assert told == ["film.mp4 cannot be written: No space left on device"]
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MerlError):
        evaluate(still, DotEnv(), 3, video=tmp_path / "film.mp4")
