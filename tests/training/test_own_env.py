"""A user's environment on the command line, from training to a policy in Python."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import av
import numpy as np
import pytest

import merl
from helpers import flat
from merl.cli import main
from merl.evaluation.evaluation import EVALUATION_SEED
from toy import DotEnv

TWO_CAMERAS = '''
import gymnasium
import numpy as np
from gymnasium import spaces


class Arm(gymnasium.Env):
    """Two cameras of different sizes, joints and a key that agents cannot use; terminates."""

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
        over = np.bool_(self.steps == 12)  # like the result of comparing arrays
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


def test_a_user_environment_with_two_cameras(tmp_path: Path) -> None:
    """The module of the environment is in the folder where `merl` is called."""
    (tmp_path / "my_arm.py").write_text(TWO_CAMERAS)

    def call(*arguments: str, cwd: Path = tmp_path) -> str:
        command = [sys.executable, "-m", "merl.cli", *arguments]
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
        return flat(done.stdout + done.stderr)

    # d = 128: 42 for each of the three modalities
    printed = call("train", "my_arm:Arm", *SHORT, "--eval.references")
    assert "'gear' is not used" in printed
    assert "there will be no videos" in printed
    assert "random actions" in printed
    run = tmp_path / "runs" / "my_arm-Arm-merl-smoke-s0"
    record = json.loads((run / "config.json").read_text())
    assert list(record["observation_space"]) == ["arm.joints", "front", "wrist"]
    assert record["observation_space"]["wrist"]["shape"] == [24, 26, 1]
    call("resume", str(run), "--steps", "360")
    assert rows(run)[-1]["step"] == "360"
    (tmp_path / "elsewhere").mkdir()  # the run records the folder of the module
    call("evaluate", str(run), "--episodes", "2", cwd=tmp_path / "elsewhere")

    call(
        *("train", "my_arm:Arm", *SHORT, "--run-dir", "front"),
        *("--agent.keys", "front"),
    )
    record = json.loads((tmp_path / "front" / "config.json").read_text())
    assert list(record["observation_space"]) == ["front"]


def test_a_run_with_action_repeat_makes_a_video_and_resumes(tmp_path: Path) -> None:
    """The run has a noise schedule, an action repeat of 3, and camera images of 32 pixels."""
    run = tmp_path / "run"
    arguments = ["train", "merl.envs.dot:whole", "--agent", "drqv2", *SHORT, "--steps", "241"]
    assert main([*arguments, "--action-repeat", "3", "--run-dir", str(run)]) == 0
    config = json.loads((run / "config.json").read_text())["config"]
    assert (config["action_repeat"], config["agent"]["noise_steps"]) == (3, 500)
    with av.open(str(next((run / "videos").iterdir()))) as video:
        assert video.streams.video[0].codec_context.width == 512
        assert sum(1 for _ in video.decode(video=0)) == 7  # 20 steps, three for each action
    last = rows(run)[-1]["step"]
    assert int(last) >= 241
    assert main(["resume", str(run)]) == 0  # the run is done, with more steps than asked for
    assert rows(run)[-1]["step"] == last
    assert main(["resume", str(run), "--steps", "300"]) == 0
    assert int(rows(run)[-1]["step"]) >= 300
    assert main(["evaluate", str(run), "--renderer", "gl"]) == 2


@pytest.mark.parametrize(("limit", "warns"), [(10, True), (30, False)])
def test_a_long_episode_gives_a_warning(
    limit: int,
    warns: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The episodes of the task have 20 steps."""
    monkeypatch.setattr("merl.training.meters.LONG", limit)
    flags = [*SHORT, "--agent", "proprio", "--run-dir", str(tmp_path / "r")]
    assert main(["train", "merl.envs.dot:whole", *flags]) == 0
    assert main(["resume", str(tmp_path / "r"), "--steps", "280"]) == 0
    out = flat(capsys.readouterr().out)
    assert ("no episode has ended in" in out) == warns


class Logged(DotEnv):
    """An environment that logs every call that would move a robot."""

    calls: ClassVar[list[str]] = []

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__()
        self.render_mode = render_mode

    def reset(self, **options: Any) -> Any:
        self.calls.append("reset")
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        self.calls.append("step")
        return super().step(action)


def moves(tmp_path: Path, *flags: str) -> tuple[int, int]:
    """Train for 100 steps, ten per episode, evaluate two episodes; return resets and steps."""
    Logged.calls.clear()
    arguments = ["train", "test_own_env:Logged", "--agent", "proprio", *SHORT, "--steps", "100"]
    arguments += ["--eval.episodes", "2", "--agent.hidden-dim", "8", "--replay.batch-size", "8"]
    assert main([*arguments, *flags, "--run-dir", str(tmp_path / "-".join(["run", *flags]))]) == 0
    return Logged.calls.count("reset"), Logged.calls.count("step")


def test_only_training_and_evaluation_move_a_users_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    assert moves(tmp_path, "--eval.video", "none") == (10 + 2 + 3, 100 + 20)  # 3: comparing resets
    printed = " ".join(capsys.readouterr().out.split())
    assert "100 steps of test_own_env:Logged on cpu" in printed
    assert "nothing to compare with (--eval.references takes 20 episodes" in printed
    assert moves(tmp_path) == (10 + 2 + 3 + 1, 100 + 20)  # 1: does it render?
    assert moves(tmp_path, "--eval.video", "none", "--eval.references") == (15 + 40, 120 + 400)


@pytest.mark.parametrize("agent", ["ddpg", "sac", "merl_state"])
def test_a_policy_in_python_equals_the_evaluation_on_pendulum(
    agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    arguments = ["train", "Pendulum-v1", "--agent", agent, *SHORT, "--steps", "400"]
    assert main([*arguments, "--run-dir", str(run)]) == 0
    assert "raster images" not in capsys.readouterr().out
    record = json.loads((run / "config.json").read_text())
    assert (record["agent"], list(record["observation_space"])) == (agent, ["state"])
    assert main(["resume", str(run), "--steps", "600"]) == 0
    out = tmp_path / "evaluation.json"
    assert main(["evaluate", str(run), "--episodes", "2", "--json", str(out)]) == 0
    reported = [episode["return"] for episode in json.loads(out.read_text())["episodes"]]

    policy = merl.load_policy(run)
    env = policy.make_env()
    returns = []
    for index in range(2):
        policy.reset()
        observation, _ = env.reset(seed=EVALUATION_SEED + index)
        total, over = 0.0, False
        while not over:
            action = policy(observation)
            assert np.abs(action).max() <= 1
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    assert returns == reported


FAILING = """
import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

LIMIT = 1.5


class Arm(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = spaces.Dict({"joints": spaces.Box(-9, 9, (4,), np.float32)})
        self.action_space = spaces.Box(-LIMIT, LIMIT, (2,), np.float32)
        self.drawn = self.taken = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.see(), {}

    def step(self, action):
        self.taken += 1
        if WHEN == "step" and self.taken == 175:
            raise OSError("servo 3 does not answer")
        if WHEN == "evaluation" and self.taken == 40 and self.render_mode:
            return {"joints": np.full(4, np.nan, np.float32)}, 0.0, False, False, {}
        return self.see(), -float(np.square(action).sum()), False, False, {}

    def see(self):
        boxes = self.observation_space.spaces.items()
        return {key: self.np_random.normal(size=b.shape).astype(np.float32) for key, b in boxes}

    def render(self):
        self.drawn += 1
        if WHEN == "render" and self.drawn > 12:
            raise RuntimeError("the display is gone")
        return np.zeros((32, 32, 3), np.uint8)


def make(render_mode=None):
    return TimeLimit(Arm(render_mode), 20)
"""


def failing(folder: Path, when: str) -> str:
    """Write a module whose environment fails at `when`, with a unique name; return the task."""
    name = f"arm_that_fails_{when}"
    (folder / f"{name}.py").write_text(f"WHEN = {when!r}\n{FAILING}")
    return f"{name}:make"


def test_an_exception_of_the_users_code_is_reported_and_the_run_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    task = failing(tmp_path, "step")
    assert main(["train", task, *SHORT, "--eval.video", "none", "--run-dir", "run"]) == 4
    error = capsys.readouterr().err.strip()
    assert "step raised OSError: servo 3 does not answer (arm_that_fails_step.py, line 2" in error
    assert f"resume with `merl resume {tmp_path}/run`" in error
    assert len(error.splitlines()) == 1
    saved = max(int(path.name) for path in Path("run/checkpoints").iterdir())
    assert saved > 0
    module = Path("arm_that_fails_step.py")
    module.write_text(module.read_text().replace("self.taken == 175", "False"))
    sys.modules.pop("arm_that_fails_step")
    assert main(["resume", "run"]) == 0
    assert rows(Path("run"))[-1]["step"] == "240"


def test_a_failing_video_does_not_stop_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", failing(tmp_path, "render"), *SHORT, "--run-dir", "run"]) == 0
    assert "render raised RuntimeError: the display is gone" in flat(capsys.readouterr().out)


def test_a_nan_in_an_evaluation_stops_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", failing(tmp_path, "evaluation"), *SHORT, "--run-dir", "run"]) == 3
    assert "'joints' is nan at index 0 at step" in capsys.readouterr().err


def test_resume_and_evaluate_refuse_an_environment_with_other_spaces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    task = failing(tmp_path, "never")
    flags = [*SHORT, "--eval.video", "none"]
    assert main(["train", task, *flags, "--run-dir", "run"]) == 0
    assert "there is nothing to compare with" in flat(capsys.readouterr().out)
    module = Path("arm_that_fails_never.py")
    source = module.read_text()
    for change, message in {
        ("LIMIT = 1.5", "LIMIT = 9.5"): "bounds was low [-1.5, -1.5], high [1.5, 1.5] and is low",
        ("(4,)", "(5,)"): "'joints' was float32 (4,) and is float32 (5,)",
        (
            '"joints": spaces',
            '"more": spaces.Box(0, 1, (1,)), "joints": spaces',
        ): "'more' was missing",
        ("(2,), np", "(3,), np"): "action was float32 (2,) and is float32 (3,)",
    }.items():
        module.write_text(source.replace(*change))
        for line in (["resume", "run", "--steps", "300"], ["evaluate", "run"]):
            sys.modules.pop("arm_that_fails_never")
            assert main(line) == 2, (change, line)
            error = capsys.readouterr().err.strip()
            assert message in error.splitlines()[-1]
    # A module of the same name in another working folder is not used.
    module.write_text(source)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / module).write_text(source.replace("(4,)", "(7,)"))
    monkeypatch.chdir(tmp_path / "elsewhere")
    sys.modules.pop("arm_that_fails_never")
    assert main(["evaluate", "../run"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["CartPole-v1"], "actions are Discrete(2)"),
        (["Pendulum-v1", "--agent", "drqv2"], "or use --agent merl_state, ddpg or sac"),
        (
            ["merl.envs.dot:whole", "--agent", "sac", "--agent.keys", "state"],
            "agent.keys names 'state', but the observation has ['image', 'joints']",
        ),
        (["reach_duplo", "--env.image-layout", "chw"], "for your own environment"),
        (["reach_duplo", "--env.allow-wide-actions"], "for your own environment"),
        (["Pendulum-v1", "--agent", "ddgp"], "did you mean 'ddpg'"),
        (["Pendulum-v1", "--agent", "ddpg", "--renderer", "gl"], "--renderer is for merl's own"),
        (["Pendulm-v1", "--agent", "ddpg"], "did you mean 'Pendulum-v1'"),
        (["Reachr-v4"], "did you mean 'Reacher-v4'"),
        (["Kitchen-v7"], "is unknown: choose from reach_duplo, move_box, lift_box, or name a"),
        (["FetchReach-v4"], "package gymnasium-robotics: pip install 'gymnasium-robotics', then"),
        (["FetchReach-v4"], "use the task gymnasium_robotics:FetchReach-v4"),
        (["panda_gym:PandaReach-v3"], "it comes with the package panda-gym: pip install"),
        (["AdroitHandDoor-v1"], "package gymnasium-robotics"),
        (["AntMaze_UMaze-v4"], "package gymnasium-robotics"),
        (["PandaReach-v3"], "use the task panda_gym:PandaReach-v3"),
        (["dm_control/cheetah-run-v0"], "pip install 'shimmy[dm-control]'"),
        (["os:getcwd"], "returned str"),
        (["./my_robot.py:make"], "use module:function, for example my_robot:make_env"),
        ([":Foo"], "use module:function, for example my_robot:make_env"),
        (["gymnasium:make"], "takes no arguments"),
        (["merl/MoveBox-v0"], "use its name, move_box"),
        (["merl:merl/MoveBox-v0"], "use its name, move_box"),
        (["merl.envs.dot:whole", "--agent", "ddpg", "--agent.keys", "x"], "or add 'x' to the"),
    ],
)
def test_bad_input_is_reported_in_one_line_and_leaves_no_files(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", *arguments, "--preset", "smoke"]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_newest_version_of_an_outdated_environment_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["train", "Ant-v3", "--agent", "sac", "--preset", "smoke"]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]  # after warnings of Gymnasium
    assert last.endswith("use its newest version, Ant-v5")
