from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from rich.filesize import decimal
from safetensors.torch import load_file
from torch import Tensor
from worker_envs import WORK

from merl import cli
from merl.agents.ddpg import DDPG, Draws
from merl.core import Batch
from merl.report.curves import read_metrics
from merl.training.checkpoint import Checkpoint
from merl.training.run import Run
from merl.training.timing import Arithmetic, Timing

pytestmark = pytest.mark.timeout(120)
_FLAGS = {
    "--agent": "ddpg",
    "--preset": "smoke",
    "--random-steps": 20,
    "--seed-steps": 20,
    "--updates-per-step": 0.5,
    "--threads": 1,
    "--agent.precision": "fp32",
    "--agent.hidden-dim": 16,
    "--save-every": 0,
    "--eval.every": 1000,
    "--eval.episodes": 1,
    "--eval.video": "none",
}
SMALL = [str(part) for flag in _FLAGS.items() for part in flag]


@pytest.fixture(autouse=True)
def _findable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = str(Path(__file__).parent)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", folder)
    monkeypatch.setenv("TURNS", str(tmp_path))


def train(run: Path, which: str, *flags: str, steps: int = 100) -> int:
    line = ["train", f"worker_envs:{which}", *SMALL, "--steps", str(steps)]
    return cli.main([*line, "--run-dir", str(run), *flags])


def weights(run: Path) -> dict[str, object]:
    last = Checkpoint.find(Run.open(run).checkpoints)
    return {k: v.tolist() for k, v in load_file(last.path / "weights.safetensors").items()}


@pytest.mark.parametrize("flags", [("--num-envs", "3"), ("--no-synchronous",)])
def test_a_run_with_workers_is_reproducible_and_keeps_its_ratio(
    tmp_path: Path, flags: tuple[str, ...]
) -> None:
    for run in ("one", "other"):
        assert train(tmp_path / run, "plain", *flags, steps=120) == 0
    assert weights(tmp_path / "one") == weights(tmp_path / "other")
    state = Checkpoint.find(Run.open(tmp_path / "one").checkpoints).state()
    assert state["progress"]["updates"] == (120 - 20) // 2
    metrics = read_metrics(tmp_path / "one")
    assert np.nanmax(metrics["workers/restarts"]) == 0
    np.testing.assert_allclose(metrics["train/reward/first"], metrics["train/return"], rtol=1e-6)


def test_what_environments_tell_is_not_mixed(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "uneven", "--num-envs", "3") == 0
    metrics = read_metrics(tmp_path / "run")
    assert np.nanmin(metrics["train/return"]) > 0
    np.testing.assert_allclose(metrics["train/reward/first"], metrics["train/return"], rtol=1e-6)


def test_each_worker_meets_other_episodes_and_has_a_lane_of_its_own(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "plain", "--num-envs", "2") == 0
    seen = [
        np.fromfile(tmp_path / f"run/replay/{lane}/observation.state.bin", np.float32)
        for lane in (0, 1)
    ]
    assert all(np.count_nonzero(lane) >= 3 * 50 for lane in seen)
    assert not np.intersect1d(seen[0][seen[0] != 0], seen[1][seen[1] != 0]).size


@pytest.mark.parametrize("flags", [("--num-envs", "2", "--no-synchronous"), ("--no-synchronous",)])
def test_a_run_with_workers_goes_on_as_if_it_had_not_stopped(
    tmp_path: Path, flags: tuple[str, ...]
) -> None:
    """Its environments end their episodes together, so a checkpoint lies between episodes."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train(whole, "plain", *flags, steps=160) == 0
    line = ["train", "worker_envs:plain", *SMALL, "--steps", "160", "--run-dir", str(parts)]
    process = subprocess.Popen([sys.executable, "-m", "merl.cli", *line, *flags])
    while not any(name.name > "00000040" for name in parts.glob("checkpoints/0*")):
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert cli.main(["resume", str(parts)]) == 0
    assert weights(whole) == weights(parts)


@pytest.mark.parametrize("how", ["dies", "hangs", "stops"])
def test_a_worker_that_is_lost_is_started_again(
    tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TIMES", "1")
    flags = ["--num-envs", "2", "--worker-timeout", "2"]
    assert train(tmp_path / "run", how, *flags) == 0
    assert "starting the environments again (restart 1 of 10)" in " ".join(
        capfd.readouterr().out.split()
    )
    metrics = read_metrics(tmp_path / "run")
    assert np.nanmax(metrics["workers/restarts"]) == 1
    assert np.nanmax(metrics["train/length"]) == 10  # the episode that was cut is not counted
    assert not multiprocessing.active_children()


def test_workers_that_are_lost_too_often_end_the_run_with_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TIMES", "2")
    run = tmp_path / "run"
    assert train(run, "dies", "--no-synchronous", "--worker-restarts", "1") == 4
    said = " ".join(capfd.readouterr().err.split())
    assert "an environment's process died, after 1 restart: the run is saved at step 48" in said
    assert Checkpoint.find(Run.open(run).checkpoints).step == 48
    assert cli.main(["resume", str(run)]) == 0
    assert Checkpoint.find(Run.open(run).checkpoints).step == 100


def test_workers_that_die_before_the_first_step_leave_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert train(run, "stillborn", "--no-synchronous", "--worker-restarts", "0") == 4
    said = " ".join(capfd.readouterr().err.split())
    assert "after 0 restarts: the run ends before its first step" in said
    assert "Traceback" not in said
    assert not run.exists()


def test_workers_end_with_the_run_that_is_killed(tmp_path: Path) -> None:
    line = ["train", "worker_envs:slow", *SMALL, "--steps", "5000", "--num-envs", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "merl.cli", *line, "--run-dir", str(tmp_path / "run")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not list(tmp_path.glob("run/checkpoints/0*1*")) and process.poll() is None:
        time.sleep(0.05)
    children = psutil.Process(process.pid).children(recursive=True)
    assert len(children) >= 2
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_signal_to_all_processes_saves(tmp_path: Path, number: int) -> None:
    """A terminal or a batch system sends it to the workers too."""
    run = tmp_path / "run"
    line = ["train", "worker_envs:slow", *SMALL, "--steps", "5000", "--num-envs", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "merl.cli", *line, "--run-dir", str(run)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not list(run.glob("checkpoints/0*1*")) and process.poll() is None:
        time.sleep(0.05)
    os.killpg(process.pid, number)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "and saved: go on with" in out
    assert cli.main(["resume", str(run), "--minutes", "0.02"]) == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_workers_start_ends_it_at_once(tmp_path: Path, number: int) -> None:
    run = tmp_path / "run"
    line = ["train", "worker_envs:never_ready", *SMALL, "--num-envs", "2", "--run-dir", str(run)]
    process = subprocess.Popen(
        [sys.executable, "-m", "merl.cli", *line],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "waits").exists() and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 128 + number
    assert "stopped before training began: nothing was written" in out
    assert "Traceback" not in err
    assert not run.exists()


def test_other_processes_of_the_caller_are_left_alone(tmp_path: Path) -> None:
    bystander = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    bystander.start()
    assert train(tmp_path / "run", "stillborn", "--no-synchronous", "--worker-restarts", "1") == 4
    assert multiprocessing.active_children() == [bystander]
    bystander.kill()
    bystander.join()


@pytest.mark.parametrize("flags", [(), ("--no-synchronous",)])
@pytest.mark.parametrize("which", ["plain", "of_its_own"])
def test_who_cannot_be_resumed_exactly_is_told(
    tmp_path: Path, which: str, flags: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", which, *flags) == 0
    told = "a resumed run will meet other episodes" in " ".join(capsys.readouterr().out.split())
    assert told == (which == "of_its_own")


def test_of_several_environments_the_one_is_named_whose_reward_is_no_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "broken", "--num-envs", "3") == 3
    error = capsys.readouterr().err
    assert "the environment's reward is nan at step 74 of environment 1" in error


def test_a_signal_is_heeded_between_the_updates_of_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learn, made = DDPG.learn, 0

    def signalled(*given: Any) -> Any:
        nonlocal made
        made += 1
        if made == 10:
            os.kill(os.getpid(), signal.SIGTERM)
        return learn(*given)

    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(DDPG, "learn", signalled)
        patch.setattr(
            "merl.training.parts.measure", lambda *_: Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
        )
        flags = ("--updates-per-step", "50", "--replay.batch-size", "8")
        assert train(run, "plain", *flags, steps=22) == 128 + signal.SIGTERM
    state = Checkpoint.find(Run.open(run).checkpoints).state()["progress"]
    assert (state["step"], state["updates"]) == (21, 10)
    assert cli.main(["resume", str(run)]) == 0
    state = Checkpoint.find(Run.open(run).checkpoints).state()["progress"]
    assert (state["step"], state["updates"]) == (22, 100)


def test_what_several_environments_keep_is_told_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "plain", "--num-envs", "3") == 0
    taken = sum(file.stat().st_size for file in (tmp_path / "run" / "replay").rglob("*.bin"))
    assert f"the replay takes {decimal(taken)} for" in capsys.readouterr().out


def test_an_error_in_another_process_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "fails", "--num-envs", "2") == 4
    error = capsys.readouterr().err.strip()
    assert "step raised LocalError: the gripper is gone (worker_envs.py, line" in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()  # it had not begun


def test_environments_step_while_the_learner_learns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An environment that waits 20 ms a step costs little beside updates that wait 20 ms more."""
    learn = DDPG.learn

    def slowly(self: DDPG, batch: Batch, draws: Draws) -> dict[str, Tensor]:
        time.sleep(WORK)
        return learn(self, batch, draws)

    monkeypatch.setattr(DDPG, "learn", slowly)
    seconds = {}
    for name, flags in {"waits": [], "overlaps": ["--no-synchronous"]}.items():
        assert train(tmp_path / name, "slow", "--updates-per-step", "1", *flags) == 0
        rates = read_metrics(tmp_path / name)["time/steps_per_second"]
        seconds[name] = 1 / np.nanmedian(rates[-5:])
    assert seconds["overlaps"] < 0.8 * seconds["waits"]
