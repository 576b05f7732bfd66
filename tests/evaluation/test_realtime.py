"""A policy in real time: the rate, the limits, the deadlines, and what ends an episode."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from merl.core import NotFinite
from merl.demos.episode import EpisodeRecording
from merl.evaluation.realtime import Driven, Limits, drive


class Clock:
    """A time that passes only in `sleep` and in the environment's step."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


class Robot(gymnasium.Env[Any, Any]):
    """An environment whose steps take the given times, s."""

    observation_space = spaces.Dict({"joint": spaces.Box(-1, 1, (2,), np.float32)})
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, clock: Clock, takes: list[float], ends: int = 10**6) -> None:
        self.clock, self.takes, self.ends = clock, takes, ends
        self.begun: list[float] = []
        self.actions: list[np.ndarray[Any, Any]] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return {"joint": np.zeros(2, np.float32)}, {}

    def step(self, action: Any) -> Any:
        self.begun.append(self.clock.now - 100.0)
        self.actions.append(action)
        count = len(self.begun)
        self.clock.now += self.takes[(count - 1) % len(self.takes)]
        joint = np.full(2, count / 1000, np.float32)
        return {"joint": joint}, 0.5, count == self.ends, False, {"success": count == self.ends}


def run(robot: Robot, limits: Limits, **options: Any) -> tuple[Driven, EpisodeRecording]:
    values = {"act": lambda _: np.array([1.0, -1.0]), "stop": lambda: False} | options
    observation, _ = robot.reset()
    recording = EpisodeRecording(observation)
    found = drive(
        values["act"],
        robot,
        observation,
        10.0,
        limits,
        values["stop"],
        record=recording.add,
        sleep=robot.clock.sleep,
        clock=robot.clock,
    )
    return found, recording


def test_steps_begin_at_the_rate_and_a_late_one_shifts_the_schedule() -> None:
    clock = Clock()
    robot = Robot(clock, [0.03, 0.03, 0.25, 0.03], ends=6)
    found, recording = run(robot, Limits())
    assert robot.begun == pytest.approx([0.0, 0.1, 0.2, 0.45, 0.55, 0.65])
    assert found.end == "terminated"
    assert found.timing.lateness == pytest.approx([0, 0, 0.15, 0, 0, 0], abs=1e-9)
    assert found.timing.late == 1
    assert found.timing.env == pytest.approx([0.03, 0.03, 0.25, 0.03, 0.03, 0.03])
    episode = recording.finish(terminated=True)
    assert episode.success
    assert episode.observations["joint"].shape == (7, 2)


def test_actions_stay_within_the_limits() -> None:
    robot = Robot(Clock(), [0.01], ends=5)
    episode = run(robot, Limits(action=0.5, change=0.2))[1].finish(terminated=True)
    np.testing.assert_allclose([a[0] for a in robot.actions], [0.2, 0.4, 0.5, 0.5, 0.5])
    np.testing.assert_allclose([a[1] for a in robot.actions], [-0.2, -0.4, -0.5, -0.5, -0.5])
    np.testing.assert_array_equal(episode.actions, robot.actions)
    np.testing.assert_array_equal(episode.intended, [[1.0, -1.0]] * 5)


def test_what_ends_an_episode() -> None:
    assert run(Robot(Clock(), [0.01]), Limits(steps=7))[0].end == "time"
    late, recording = run(Robot(Clock(), [0.2]), Limits(late=4))
    assert (late.end, len(recording)) == ("late", 4)
    # Every other step is in time.
    assert run(Robot(Clock(), [0.2, 0.01]), Limits(late=2, steps=30))[0].end == "time"
    asked = iter([False, False, True])
    stopped, recording = run(Robot(Clock(), [0.01]), Limits(), stop=lambda: next(asked))
    assert (stopped.end, len(recording)) == ("stopped", 2)
    robot = Robot(Clock(), [0.01])
    assert len(run(robot, Limits(), stop=lambda: True)[1]) == 0
    assert robot.begun == []


def test_nan_from_the_robot_stops_it() -> None:
    robot = Robot(Clock(), [0.01])
    robot.step = lambda action: ({"joint": np.array([0, np.nan])}, 0.0, False, False, {})  # type: ignore[method-assign]
    with pytest.raises(NotFinite, match="'joint' is nan"):
        run(robot, Limits())
