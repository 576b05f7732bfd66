"""merl run: a policy drives an environment, is checked against it, and leaves a log."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import termios
from pathlib import Path

import numpy as np
import pytest

from helpers import flat
from merl.cli import main
from merl.cli.run import Stop
from merl.demos.demonstrations import Demonstrations
from merl.runs import record
from merl.runs.run_folder import PRETRAINED

POLICY = "pretrained/reach_duplo"
ROBOT = """
import os
import signal
import time

import gymnasium
import numpy as np

import merl

def arm():
    return merl.make_env("reach_duplo", renderer="raster", image_size=24, samples=3)

def small():
    return merl.make_env("reach_duplo", renderer="raster", image_size=16)

def blind():
    return merl.make_env("reach_duplo", observations=("proprio",))

class Slow(gymnasium.Wrapper):
    def reset(self, **options):
        print("WAITING", flush=True)
        time.sleep(60)  # for a person; the signal ends it

    def close(self):
        print("CLOSED", flush=True)

def slow():
    return Slow(arm())

class Failing(gymnasium.Wrapper):
    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps > 3:
            raise RuntimeError("servo 3 does not answer")
        return self.env.step(action)

def failing():
    return Failing(arm())

def strong():
    return gymnasium.wrappers.RescaleAction(arm(), np.float32(-50), np.float32(50))

class Counting(gymnasium.Wrapper):
    def step(self, action):
        with open("steps", "a") as file:
            file.write(".")
        return self.env.step(action)

def counting():
    return Counting(arm())

class Deaf(Counting):
    def step(self, action):
        result = super().step(action)
        if os.path.getsize("steps") == 3:
            os.kill(os.getpid(), signal.SIGINT)
        signal.signal(signal.SIGINT, lambda *_: None)  # as some drivers do
        return result

def deaf():
    return Deaf(arm())
"""


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a module that makes environments, in the working folder."""
    name = f"robot_{abs(hash(tmp_path)) % 10**9}"
    (tmp_path / f"{name}.py").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    return name


def quickly(policy: str, env: str, steps: int) -> list[str]:
    return f"run {policy} --env {env} --hz 500 --max-late 1000 --max-steps {steps}".split()


def test_the_log_holds_what_was_done(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", POLICY, "--env", f"{robot}:arm", "--hz", "500", "--log", "log"]
    limits = ["--max-steps", "20", "--rate-limit", "0.25", "--max-late", "1000"]
    assert main([*command, *limits, "--episodes", "2"]) == 0
    shown = flat(capsys.readouterr().out)
    assert "500 steps per second" in shown
    assert "episode 2: return" in shown
    found = Demonstrations.open(Path("log"))
    assert found.task == f"{robot}:arm"
    assert [line.steps for line in found.lines] == [20, 20]
    for episode in found.episodes():
        before = np.concatenate([np.zeros((1, 9), np.float32), episode.actions[:-1]])
        change = np.abs(episode.actions - before)
        assert change.max() <= 0.25 + 1e-6
        assert np.abs(episode.intended).max() > 0.5  # the limit had an effect


def test_actions_are_repeated_as_in_training(robot: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(PRETRAINED / "reach_duplo", run)
    recorded = record.read(run)
    recorded["config"]["action_repeat"] = 2
    record.write(run, recorded)
    assert main(quickly("run", f"{robot}:counting", 10)) == 0
    assert len(Path("steps").read_text()) == 20


def test_ctrl_c_stops_an_environment_that_handles_it_itself(robot: str) -> None:
    assert main(quickly(POLICY, f"{robot}:deaf", 50)) == 128 + 2
    assert len(Path("steps").read_text()) == 3


def test_an_exported_policy_runs_or_is_named(
    robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxruntime")
    assert main(["export", POLICY, "--out", "p.onnx"]) == 0
    command = ["run", "p.onnx", "--env", f"{robot}:arm", "--hz", "500", "--max-steps", "30"]
    assert main([*command, "--max-late", "1000", "--log", "log"]) == 0
    assert Demonstrations.open(Path("log")).steps == 30
    assert main(quickly("p.onnx", "reach_duplo", 5)) == 0
    assert main(["run", "p.onnx"]) != 0
    assert "name the environment with --env" in flat(capsys.readouterr().err)
    card = tmp_path / "p.onnx.json"
    told = json.loads(card.read_text())
    card.write_text(json.dumps(told | {"action_repeat": 2}))
    assert main(quickly("p.onnx", f"{robot}:counting", 5)) == 0
    assert len(Path("steps").read_text()) == 10
    for damage, words in [
        ("[]", "holds no object"),
        ("{}", "is damaged"),
        (json.dumps(told | {"action_repeat": 0}), "is damaged"),
        (json.dumps(told | {"env": {"image_size": 1}}), "is damaged"),
        (json.dumps(told | {"inputs": {"x": told["inputs"]["proprio"]}}), "cannot be run as its"),
        ("{", "cannot be read"),
    ]:
        card.write_text(damage)
        assert main(command) != 0
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
    card.unlink()
    assert main(command) != 0
    assert "has no card p.onnx.json beside it" in flat(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "small",
            "is uint8 (16, 16, 3) from 0 to 255, and the policy was trained with uint8 (24, 24,",
        ),
        ("blind", "no observation 'image', which the policy uses: it has proprio"),
    ],
)
def test_another_environment_is_refused(
    name: str, words: str, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", POLICY, "--env", f"{robot}:{name}"]) != 0
    assert words in flat(capsys.readouterr().err)


def test_late_steps_end_the_run(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", POLICY, "--env", f"{robot}:arm", "--hz", "10000", "--max-late", "5"]
    assert main(command) == 1
    assert "stopped: 5 steps in a row missed the deadline" in flat(capsys.readouterr().out)


def in_terminal(command: list[str], after: str, keys: bytes, folder: Path) -> tuple[int, str, bool]:
    """Run a command in a terminal, and send keys after a line with these words.

    Returns:
        Its exit code, its output, and whether the terminal is afterwards as before.
    """
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    with subprocess.Popen(
        [sys.executable, "-m", "merl.cli", "run", *command],
        stdin=theirs,
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(theirs, termios.TIOCSCTTY, 0),
    ) as process:
        assert process.stdout is not None
        shown = line = process.stdout.readline()
        while line and after not in line:
            shown += (line := process.stdout.readline())
        os.write(ours, keys)
        out, _ = process.communicate(timeout=60)
    return process.returncode, shown + out, termios.tcgetattr(theirs) == before


@pytest.mark.parametrize("keys", [b" ", b"xq", b"\x1b"])
def test_a_key_stops_it(keys: bytes, tmp_path: Path) -> None:
    command = [POLICY, "--hz", "20", "--episodes", "3"]
    code, out, restored = in_terminal(command, "Space or Ctrl-C stops", keys, tmp_path)
    assert code == 0
    assert "stopped" in out
    assert "episode 2" not in out
    assert restored


def test_a_signal_ends_a_reset_that_waits(robot: str, tmp_path: Path) -> None:
    """The environment is closed, and the terminal is as before."""
    command = [POLICY, "--env", f"{robot}:slow", "--hz", "20"]
    code, out, restored = in_terminal(command, "WAITING", b"\x03", tmp_path)
    assert code == 128 + 2
    assert "CLOSED" in out
    assert restored


def test_the_episode_of_a_failure_is_kept(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", POLICY, "--env", f"{robot}:failing", "--hz", "500", "--log", "log"]
    assert main([*command, "--max-late", "1000"]) != 0
    assert "servo 3" in flat(capsys.readouterr().err)
    assert [line.steps for line in Demonstrations.open(Path("log")).lines] == [3]


def test_actions_in_other_units_are_refused(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", POLICY, "--env", f"{robot}:strong", "--log", "log"]) != 0
    assert "an action would be another movement" in flat(capsys.readouterr().err)
    assert not Path("log").exists()


def test_a_stop_before_the_first_reset_moves_nothing(
    robot: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Stop, "asked", lambda self: True)
    assert main(["run", POLICY, "--env", f"{robot}:failing"]) == 0
    assert "stopped before the first step" in flat(capsys.readouterr().out)


def test_ignored_signals_stay_ignored_and_a_keyboard_may_lack(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdin", None)  # as after <&-
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as by nohup
    try:
        with Stop.listening() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.asked()
            assert stop.keys == "Ctrl-C"
    finally:
        signal.signal(signal.SIGHUP, before)


BACKGROUND = """
import os
from merl.cli.run import Stop
child = os.fork()
if child == 0:
    os.setpgid(0, 0)  # as after &
    with Stop.listening() as stop:
        print(stop.keys, flush=True)
    os._exit(0)
print("suspended" if os.WIFSTOPPED(os.waitpid(child, os.WUNTRACED)[1]) else "ended")
"""


def test_in_the_background_it_leaves_the_keyboard_alone() -> None:
    _, theirs = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", BACKGROUND],
        stdin=theirs,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(theirs, termios.TIOCSCTTY, 0),
    )
    assert done.stdout.split() == ["Ctrl-C", "ended"]
