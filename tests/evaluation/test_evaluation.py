from __future__ import annotations

import math
import random
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch

from merl.acting.generators import seed_global_generators
from merl.core import MerlError
from merl.envs.action_repeat import ActionRepeat
from merl.evaluation.evaluation import EVALUATION_SEED, evaluate
from merl.evaluation.video import VideoWriter
from toy import DotEnv


def zero_action(observation: Any) -> Any:
    return np.zeros(1, np.float32)


def test_every_evaluation_has_the_same_starts() -> None:
    env = DotEnv()
    first = evaluate(zero_action, env, 5)
    env.reset(seed=3)
    assert [e.total_reward for e in evaluate(zero_action, env, 5).episodes] == [
        e.total_reward for e in first.episodes
    ]
    starts = []
    for index in range(5):
        env.reset(seed=EVALUATION_SEED + index)
        starts.append(env.x)
    assert [e.total_reward for e in first.episodes] == pytest.approx(
        [10 * (1 - abs(x)) for x in starts]
    )


def test_success_at_the_end_and_at_any_step_are_distinguished() -> None:
    def pass_by(observation: Any) -> Any:
        """Move right through the goal to the end of the line."""
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
        return zero_action(observation)

    evaluate(act, DotEnv(), 3, reset=lambda: calls.append("reset"))
    assert calls == (["reset"] + ["act"] * 10) * 3


def test_the_video_shows_the_first_episode_in_real_time(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    evaluate(zero_action, DotEnv(), 2, video=film)
    with av.open(str(film)) as container:
        assert container.streams.video[0].average_rate == 25
        assert sum(1 for _ in container.decode(video=0)) == 10


def test_a_failed_video_does_not_end_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise MerlError("film.mp4 cannot be written: No space left on device")

    monkeypatch.setattr(VideoWriter, "add", full)
    plain = evaluate(zero_action, DotEnv(), 3)
    messages: list[str] = []
    result = evaluate(zero_action, DotEnv(), 3, video=tmp_path / "film.mp4", warn=messages.append)
    assert [e.total_reward for e in result.episodes] == [e.total_reward for e in plain.episodes]
    (message,) = messages
    assert "film.mp4 cannot be written: No space left on device" in message
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MerlError):
        evaluate(zero_action, DotEnv(), 3, video=tmp_path / "film.mp4")


@pytest.mark.parametrize(
    ("fps", "rate"),
    [
        (12.5, 12.5),
        (np.float32(50), 50),
        (np.int64(10), 10),
        (np.array(20), 20),
        (Fraction(25, 2), 12.5),
        *((bad, None) for bad in (None, 0, -5, math.nan, math.inf, 1e9, 1e-9, 10**400, "30", True)),
    ],
)
def test_the_frame_rate_is_a_usable_positive_number_or_25(
    tmp_path: Path, fps: Any, rate: float | None
) -> None:
    plain = DotEnv()
    plain.metadata = {"render_fps": fps}
    for repeat, env in ((1, plain), (2, ActionRepeat(plain, 2))):
        messages: list[str] = []
        evaluate(zero_action, env, 1, video=tmp_path / "film.mp4", warn=messages.append)
        with av.open(str(tmp_path / "film.mp4")) as container:
            shown = container.streams.video[0].average_rate
        assert shown == (25 if rate is None else rate / repeat)
        assert sum("has no usable render_fps" in message for message in messages) == (rate is None)


@pytest.mark.parametrize("metadata", [None, [], "none", {}])
def test_invalid_metadata_is_accepted(tmp_path: Path, metadata: Any) -> None:
    env = DotEnv()
    env.metadata = metadata
    messages: list[str] = []
    for each in (env, ActionRepeat(env, 2)):
        evaluate(zero_action, each, 1, video=tmp_path / "film.mp4", warn=messages.append)
        assert (tmp_path / "film.mp4").is_file()
    assert len(messages) == 2


@pytest.mark.parametrize(
    "frame",
    [
        None,
        np.zeros((32, 32, 3), np.float32),
        [np.zeros((32, 32, 3), np.uint8)] * 2,
        np.zeros((32, 32), np.uint8),
        np.zeros((0, 0, 3), np.uint8),
        "text",
        OSError("the display is gone"),
    ],
    ids=str,
)
def test_invalid_frames_end_only_the_video(
    tmp_path: Path, frame: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(self: DotEnv) -> Any:
        if isinstance(frame, Exception):
            raise frame
        return frame if self.steps > 3 else np.zeros((32, 32, 3), np.uint8)

    monkeypatch.setattr(DotEnv, "render", render)
    messages: list[str] = []
    result = evaluate(zero_action, DotEnv(), 2, video=tmp_path / "film.mp4", warn=messages.append)
    assert [episode.length for episode in result.episodes] == [10, 10]
    assert len(messages) == 1
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MerlError, match=r"film\.mp4 cannot be made"):
        evaluate(zero_action, DotEnv(), 2, video=tmp_path / "film.mp4")


def test_an_episode_is_truncated_at_the_limit() -> None:
    messages: list[str] = []
    result = evaluate(zero_action, DotEnv(), 3, warn=messages.append, max_steps=4)
    assert [episode.length for episode in result.episodes] == [4, 4, 4]
    assert set(messages) == {messages[0]}
    assert "cut after 4 steps" in messages[0]
    messages.clear()
    evaluate(zero_action, DotEnv(), 3, warn=messages.append, max_steps=10)
    assert messages == []


def test_evaluations_restore_random_generators_and_have_fixed_starts() -> None:
    class Global(DotEnv):
        def reset(self, **options: Any) -> Any:
            np.random.seed(options["seed"])  # noqa: NPY002
            super().reset(**options)
            self.x = random.uniform(-1, 1)
            return self._observe(), {}

    env = Global()
    env.reset(seed=0)
    seed_global_generators(0)
    drawn: list[float] = []
    totals = []
    for _ in range(3):
        drawn += [draw(env) for draw in DRAWS]
        totals.append([e.total_reward for e in evaluate(zero_action, env, 3).episodes])
    env.reset(seed=0)
    seed_global_generators(0)
    expected = [draw(env) for _ in range(3) for draw in DRAWS]
    assert drawn == expected
    assert totals[0] == totals[1] == totals[2]
    assert len(set(totals[0])) == 3


DRAWS: list[Any] = [
    lambda env: float(np.random.normal()),  # noqa: NPY002
    lambda env: random.random(),
    lambda env: float(torch.rand(())),
    lambda env: float(env.np_random.normal()),
]
