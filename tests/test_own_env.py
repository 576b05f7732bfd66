"""A user's own environment through the command line, from training to a policy in Python."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

import merl
from merl.cli import main
from merl.training.evaluation import EVALUATION_SEED

TWO_CAMERAS = '''
import gymnasium
import numpy as np
from gymnasium import spaces


class Arm(gymnasium.Env):
    """Two cameras of different sizes, joints, and a word that nobody can use; ends truly."""

    metadata = {"render_modes": []}

    def __init__(self):
        self.observation_space = spaces.Dict(
            {
                "front": spaces.Box(0, 255, (24, 28, 3), np.uint8),
                "wrist": spaces.Box(0, 255, (24, 26), np.uint8),
                "arm.joints": spaces.Box(-np.inf, np.inf, (3,), np.float64),
                "gear": spaces.Discrete(3),
            }
        )
        self.action_space = spaces.Box(np.array([-5.0, 0.0]), np.array([5.0, 1.0]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = self.np_random.uniform(-1, 1, 3), 0
        return self.see(), {}

    def step(self, action):
        self.x[:2] = np.clip(self.x[:2] + 0.1 * action, -1, 1)
        self.steps += 1
        over = np.bool_(self.steps == 12)  # as a comparison of arrays gives it
        return self.see(), 1 - abs(self.x[0]), over, False, {"is_success": False}

    def see(self):
        front = np.zeros((24, 28, 3), np.uint8)
        front[:, round((self.x[0] + 1) * 13.5)] = 255
        wrist = np.full((24, 26), round((self.x[1] + 1) * 127), np.uint8)
        return {"front": front, "wrist": wrist, "arm.joints": self.x.copy(), "gear": 1}
'''
SHORT = ["--preset", "smoke", "--threads", "1", "--steps", "240", "--random-steps", "60"]
SHORT += ["--seed-steps", "60", "--eval.every", "120", "--agent.precision", "fp32"]


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def test_two_cameras_of_ones_own(tmp_path: Path) -> None:
    """As a user would: the file lies in the folder where `merl` is called."""
    (tmp_path / "my_arm.py").write_text(TWO_CAMERAS)

    def call(*arguments: str, cwd: Path = tmp_path) -> str:
        command = [sys.executable, "-m", "merl.cli", *arguments]
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout + done.stderr

    # 128 does not split over three senses: the line says so, and what would.
    said = subprocess.run(
        [sys.executable, "-m", "merl.cli", "train", "my_arm:Arm", *SHORT],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert said.returncode == 2
    assert "128 does not split evenly over 3 modalities" in said.stderr
    assert not (tmp_path / "runs").exists()

    said_all = call("train", "my_arm:Arm", *SHORT, "--agent.latent-dim", "96")
    assert "'gear' is not used" in said_all
    assert "there will be no videos" in said_all
    assert "random actions" in said_all
    run = tmp_path / "runs" / "my_arm-Arm-merl-smoke-s0"
    record = json.loads((run / "config.json").read_text())
    assert list(record["observation_space"]) == ["arm.joints", "front", "wrist"]
    assert record["observation_space"]["wrist"]["shape"] == [24, 26, 1]
    call("resume", str(run), "--steps", "360")
    assert rows(run)[-1]["step"] == "360"
    (tmp_path / "elsewhere").mkdir()  # the run knows where the module lies
    call("evaluate", str(run), "--episodes", "2", cwd=tmp_path / "elsewhere")

    call(
        *("train", "my_arm:Arm", *SHORT, "--run-dir", "front"),
        *("--agent.images", "front", "--agent.vectors"),
    )
    record = json.loads((tmp_path / "front" / "config.json").read_text())
    assert list(record["observation_space"]) == ["front"]


def test_held_actions_are_filmed_resumed_and_told_apart(tmp_path: Path) -> None:
    """Noise that falls, actions held for three steps, a film of pictures as small as 32 pixels."""
    run = tmp_path / "run"
    arguments = ["train", "merl.envs.dot:whole", "--agent", "drqv2", *SHORT, "--steps", "241"]
    assert main([*arguments, "--action-repeat", "3", "--run-dir", str(run)]) == 0
    config = json.loads((run / "config.json").read_text())["config"]
    assert (config["action_repeat"], config["agent"]["noise_steps"]) == (3, 500)
    with av.open(str(next((run / "videos").iterdir()))) as video:
        assert video.streams.video[0].codec_context.width == 512
        assert sum(1 for _ in video.decode(video=0)) == 7  # of 20 steps
    last = rows(run)[-1]["step"]
    assert int(last) >= 241
    assert main(["resume", str(run)]) == 0  # it is done, though it went beyond
    assert rows(run)[-1]["step"] == last
    assert main(["resume", str(run), "--steps", "300"]) == 0
    assert int(rows(run)[-1]["step"]) >= 300
    assert main(["evaluate", str(run), "--renderer", "gl"]) == 2


@pytest.mark.parametrize("agent", ["ddpg", "sac", "merl_state"])
def test_pendulum(agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    arguments = ["train", "Pendulum-v1", "--agent", agent, *SHORT, "--steps", "400"]
    assert main([*arguments, "--run-dir", str(run)]) == 0
    assert "pictures" not in capsys.readouterr().out
    record = json.loads((run / "config.json").read_text())
    assert (record["agent"], list(record["observation_space"])) == (agent, ["state"])
    assert main(["resume", str(run), "--steps", "600"]) == 0
    out = tmp_path / "evaluation.json"
    assert main(["evaluate", str(run), "--episodes", "2", "--json", str(out)]) == 0
    told = [episode["return"] for episode in json.loads(out.read_text())["episodes"]]

    policy = merl.load_policy(run)
    env = policy.make_env()
    driven = []
    for index in range(2):
        policy.reset()
        observation, _ = env.reset(seed=EVALUATION_SEED + index)
        total, over = 0.0, False
        while not over:
            action = policy(observation)
            assert np.abs(action).max() <= 1
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        driven.append(total)
    env.close()
    assert driven == told


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["CartPole-v1"], "actions are Discrete(2)"),
        (["Pendulum-v1"], "take --agent merl_state, ddpg or sac"),
        (["Pendulum-v1", "--agent", "drqv2"], "it needs an image"),
        (["merl.envs.dot:whole", "--agent", "sac"], "agent.vectors names 'state'"),
        (["Pendulum-v1", "--agent", "ddgp"], "did you mean 'ddpg'"),
        (["Pendulum-v1", "--agent", "ddpg", "--renderer", "gl"], "--renderer is for merl's own"),
        (["Pendulm-v1", "--agent", "ddpg"], "did you mean 'Pendulum-v1'"),
        (["os:getcwd"], "gave str"),
        (["./my_robot.py:make"], "write it as my_robot:make_env"),
        ([":Foo"], "write it as my_robot:make_env"),
        (["gymnasium:make"], "takes no arguments"),
        (["merl/MoveBox-v0"], "call it move_box"),
        (["merl:merl/MoveBox-v0"], "call it move_box"),
        (["merl.envs.dot:whole", "--agent", "ddpg"], "or have it give 'state'"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", *arguments, "--preset", "smoke"]) == 2
    error = capsys.readouterr().err.strip()
    assert says in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
