"""An agent that imitates trains without a movement of its environment."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from merl.acting.still import EPISODE, StillEnvs
from merl.cli import main
from merl.demos.recorder import Recorder
from merl.evaluation.demonstrating import record_episodes
from toy import DotEnv


def test_episodes_of_zeros_have_a_length() -> None:
    space = spaces.Dict({"joint": spaces.Box(-1, 1, (2,), np.float32)})
    still = StillEnvs(space, spaces.Box(-1, 1, (3,), np.float32), 2)
    for _ in range(2):
        observations = still.reset({0: 5, 1: None})
        assert observations[1]["joint"].tolist() == [0.0, 0.0]
        for step in range(1, EPISODE + 1):
            still.send(np.ones((2, 3), np.float32))
            ended = [result.truncated for result in still.receive()]
            assert ended == [step == EPISODE] * 2


class Robot(DotEnv):
    """An environment that must not move."""

    def reset(self, **options: Any) -> Any:
        raise AssertionError("the robot moved")

    def step(self, action: Any) -> Any:
        raise AssertionError("the robot moved")


def test_cloning_moves_no_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "still_robot.py").write_text(
        "from test_still import Robot\n\ndef make_env():\n    return Robot()\n"
    )
    monkeypatch.chdir(tmp_path)
    env = DotEnv()
    assert isinstance(env.observation_space, spaces.Dict)
    assert isinstance(env.action_space, spaces.Box)
    recorder = Recorder(
        tmp_path / "demos",
        "still_robot:make_env",
        "a test",
        env.observation_space,
        env.action_space,
    )
    for episode in record_episodes(lambda _: np.ones(1), env, 2, failures=True):
        recorder.add(episode)
    run = ["train", "still_robot:make_env", "--agent", "bc", "--demos", "demos"]
    run += ["--eval.every", "0", "--steps", "600", "--run-dir", "run", "--threads", "1"]
    assert main([*run, "--replay.batch-size", "8"]) == 0
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert "train/return" not in rows[0]
    assert float(rows[-1]["learn/actor_loss"]) < float(rows[0]["learn/actor_loss"])
    # With several environments too: none of them is made.
    run[run.index("run")] = "two"
    assert main([*run, "--replay.batch-size", "8", "--num-envs", "2"]) == 0
