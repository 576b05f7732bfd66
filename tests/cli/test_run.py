"""merl run: a policy drives an environment, is checked against it, and leaves a log."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from helpers import flat
from merl.cli import main
from merl.demos.demonstrations import Demonstrations

POLICY = "pretrained/reach_duplo"
ROBOT = """
import merl

def arm():
    return merl.make_env("reach_duplo", renderer="raster", image_size=24, samples=3)

def small():
    return merl.make_env("reach_duplo", renderer="raster", image_size=16)

def blind():
    return merl.make_env("reach_duplo", observations=("proprio",))
"""


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a module that makes environments, in the working folder."""
    name = f"robot_{abs(hash(tmp_path)) % 10**9}"
    (tmp_path / f"{name}.py").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    return name


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


def test_an_exported_policy_runs_or_is_named(
    robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxruntime")
    assert main(["export", POLICY, "--out", "p.onnx"]) == 0
    command = ["run", "p.onnx", "--env", f"{robot}:arm", "--hz", "500", "--max-steps", "30"]
    assert main([*command, "--max-late", "1000", "--log", "log"]) == 0
    assert Demonstrations.open(Path("log")).steps == 30
    assert main(["run", "p.onnx"]) != 0
    assert "name the environment with --env" in flat(capsys.readouterr().err)
    card = tmp_path / "p.onnx.json"
    told = json.loads(card.read_text())
    for damage, words in [
        ("[]", "holds no object"),
        ("{}", "is damaged"),
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


def test_a_key_stops_it() -> None:
    """Press space in a terminal, after the first line is shown."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "merl.cli", "run", POLICY, "--hz", "20"]
    with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "Space or Ctrl-C stops" in process.stdout.readline()
        time.sleep(1.0)
        os.write(ours, b" ")
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "stopped" in out
