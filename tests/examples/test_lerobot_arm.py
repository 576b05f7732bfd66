"""The arm's environment keeps its limits, and merl learns in it; the arm is simulated."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from merl.cli import main
from merl.demos.demonstrations import Demonstrations

EXAMPLES = Path(__file__).parents[2] / "examples"


class SimulatedArm:
    """A robot with LeRobot's interface: each joint moves a third of the way to its target."""

    def __init__(self, at: dict[str, float]) -> None:
        self.at, self.sent, self.connected = dict(at), list[dict[str, float]](), True

    def get_observation(self) -> dict[str, Any]:
        assert self.connected
        pan = int(self.at["shoulder_pan"]) + 100
        return {f"{name}.pos": value for name, value in self.at.items()} | {
            "front": np.full((48, 64, 3), pan, np.uint8),
            "wrist": np.zeros((48, 64, 3), np.uint8),
        }

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        assert self.connected
        self.sent.append(action)
        for name in self.at:
            self.at[name] += (action[f"{name}.pos"] - self.at[name]) / 3
        return action

    def disconnect(self) -> None:
        self.connected = False


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Import the example; its pauses take no time."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import lerobot_arm

    monkeypatch.setattr(lerobot_arm.time, "sleep", lambda seconds: None)
    return lerobot_arm


def arm(module: types.ModuleType, **options: Any) -> tuple[Any, SimulatedArm]:
    start = dict.fromkeys(module.REST, 7.0)
    robot = SimulatedArm(start)
    return module.LeRobotArm(robot, lambda: None, lambda: False, **options), robot


def test_observations_fit_their_space(module: types.ModuleType) -> None:
    env, robot = arm(module)
    observation, _ = env.reset()
    assert observation in env.observation_space
    assert set(observation) == {"front", "wrist", "joints"}
    robot.at["shoulder_pan"] = 50.0
    observation, reward, terminated, truncated, info = env.step(np.zeros(6, np.float32))
    assert observation in env.observation_space
    assert observation["front"].mean() in range(105, 150)  # the image shows the arm where it is
    assert (reward, terminated, truncated, info) == (0.0, False, False, {"success": False})


def test_targets_keep_their_limits(module: types.ModuleType) -> None:
    env, robot = arm(module)
    env.reset()
    rest = [module.REST[name] for name in module.REST]
    assert list(robot.sent[-1].values()) == rest
    path = [[7.0] * 6, *(list(sent.values()) for sent in robot.sent)]
    assert np.abs(np.diff(path, axis=0)).max() <= module.STEP + 1e-9
    robot.sent.clear()
    for sign in (1.0, -1.0):
        for _ in range(80):
            before = np.array([robot.at[name] for name in module.REST])
            env.step(np.full(6, sign * 5.0))  # beyond the action space
            target = np.array(list(robot.sent[-1].values()))
            assert np.abs(target - before).max() <= module.LEAD + module.STEP + 1e-9
        bound = module.HIGH if sign > 0 else module.LOW
        assert list(robot.sent[-1].values()) == [bound[name] for name in module.REST]
    env.close()
    assert not robot.connected


def test_a_reset_begins_where_the_arm_is_and_notices_when_it_is_stuck(
    module: types.ModuleType,
) -> None:
    env, robot = arm(module)
    robot.at["shoulder_pan"] = 110.0  # out of bounds
    env.reset()
    path = [110.0, *(sent["shoulder_pan.pos"] for sent in robot.sent)]
    assert np.abs(np.diff(path)).max() <= module.STEP + 1e-9
    env, robot = arm(module)
    robot.send_action = lambda action: robot.sent.append(action)  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="does not reach its rest position"):
        env.reset()
    targets = np.array([list(sent.values()) for sent in robot.sent])
    assert np.abs(targets - 7.0).max() <= module.LEAD + module.STEP + 1e-9


def test_the_whole_way_runs(
    module: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Train, run with a log, clone the log, and train from the clone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "connect", lambda: SimulatedArm(dict.fromkeys(module.REST, 0.0)))
    monkeypatch.setattr("builtins.input", lambda prompt: "")
    monkeypatch.setattr(module, "_enter_pressed", lambda: False)
    monkeypatch.setattr(module, "EPISODE", 20)
    monkeypatch.setitem(sys.modules, "lerobot_arm", module)
    small = ["--preset", "laptop", "--eval.every", "0", "--threads", "1", "--replay.batch-size"]
    small += ["8", "--random-steps", "1", "--seed-steps", "10", "--agent.precision", "fp32"]
    train = ["train", "lerobot_arm:make_env", *small, "--steps", "40"]
    assert main([*train, "--run-dir", "first"]) == 0
    command = ["run", "first", "--env", "lerobot_arm:make_unpaced", "--hz", "200"]
    assert main([*command, "--log", "log", "--max-late", "1000"]) == 0
    assert Demonstrations.open(tmp_path / "log").steps == 20
    index = tmp_path / "log" / "demos.json"
    index.write_text(index.read_text().replace("make_unpaced", "make_env"))
    assert main([*train, "--agent", "bc", "--demos", "log", "--run-dir", "cloned"]) == 0
    start = ["--agent.start-from", "cloned", "--demos", "log", "--run-dir", "second"]
    assert main([*train, *start]) == 0
