from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil
import pytest
from rich.filesize import decimal
from safetensors.torch import load_file

from helpers import flat, wait_for
from merl import cli
from merl.acting.run_env import make_run_env, recipe
from merl.acting.workers import WorkerEnvs
from merl.agents.ddpg import DDPG
from merl.core.watcher import ENDING
from merl.experiments.presets import compose
from merl.report.curves import read_metrics
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.training.timing import Arithmetic, Timing

pytestmark = pytest.mark.timeout(600)
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
SMALL = [*(str(part) for flag in _FLAGS.items() for part in flag), "--eval.no-references"]
FOLDER = str(Path(__file__).parents[1])


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setenv("PYTHONPATH", FOLDER, prepend=os.pathsep)
    monkeypatch.setenv("TURNS", str(tmp_path))


@pytest.fixture(autouse=True)
def _the_log_level_of_gymnasium_is_restored() -> Iterator[None]:
    before = gymnasium.logger.min_level
    yield
    assert gymnasium.logger.min_level == before


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Train a run with three worker environments; return its folder and its output."""
    run, out = tmp_path_factory.mktemp("three") / "run", StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.syspath_prepend(FOLDER)
        patch.setenv("PYTHONPATH", FOLDER, prepend=os.pathsep)
        assert train(run, "plain", "--num-envs", "3", steps=150) == 0
    return run, flat(out.getvalue())


@contextmanager
def started(run: Path, which: str, *flags: str) -> Iterator[subprocess.Popen[str]]:
    """Start a run in a new process that ends with the test at the latest."""
    line = ["train", f"worker_envs:{which}", *SMALL, "--run-dir", str(run), *flags]
    process = subprocess.Popen(
        [sys.executable, "-m", "merl.cli", *line],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def saved(run: Path, beyond: int = 0) -> bool:
    return any(int(path.name) > beyond for path in run.glob("checkpoints/0*"))


def train(run: Path, which: str, *flags: str, steps: int = 100) -> int:
    line = ["train", f"worker_envs:{which}", *SMALL, "--steps", str(steps)]
    return cli.main([*line, "--run-dir", str(run), *flags])


def weights(run: Path) -> dict[str, object]:
    last = Checkpoint.find(Run.open(run).checkpoints)
    return {k: v.tolist() for k, v in load_file(last.path / "weights.safetensors").items()}


def test_a_run_with_workers_is_reproducible(
    tmp_path: Path, three: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = tmp_path / "hostile"  # a working folder from which no process may import
    hostile.mkdir()
    for name in ("multiprocessing", "pickle", "numpy", "gymnasium"):
        (hostile / f"{name}.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(hostile)
    assert train(tmp_path / "run", "plain", "--num-envs", "3", steps=150) == 0
    assert not (hostile / "imported").exists()
    assert weights(tmp_path / "run") == weights(three[0])


def test_a_worker_process_does_not_import_torch() -> None:
    config = compose("smoke", "merl.envs.dot:whole")
    before = {process.pid for process in psutil.Process().children()}
    with (
        closing(make_run_env(config)) as here,
        closing(WorkerEnvs(recipe(config), here, 1, 30.0)) as environments,
    ):
        assert environments.reset({0: 1})[0].keys() == here.observation_space.keys()
        started = [p for p in psutil.Process().children() if p.pid not in before]
        loaded = [file.path for p in started for file in p.memory_maps()]
        (state,) = environments.states()
    assert any("numpy" in path for path in loaded)
    assert not any("torch" in path for path in loaded)
    assert "torch" not in state["globals"]


def test_an_asynchronous_run_is_reproducible_and_keeps_its_update_ratio(tmp_path: Path) -> None:
    for run in ("one", "other"):
        assert train(tmp_path / run, "plain", "--no-synchronous", steps=120) == 0
        check_ratio(tmp_path / run, 120)
    assert weights(tmp_path / "one") == weights(tmp_path / "other")


def test_a_run_with_workers_keeps_its_update_ratio(three: tuple[Path, str]) -> None:
    check_ratio(three[0], 150)


def check_ratio(run: Path, steps: int) -> None:
    state = Checkpoint.find(Run.open(run).checkpoints).state()
    assert state["progress"]["updates"] == (steps - 20) // 2
    metrics = read_metrics(run)
    assert np.nanmax(metrics["workers/restarts"]) == 0
    np.testing.assert_allclose(metrics["train/reward/first"], metrics["train/return"], rtol=1e-6)


def test_infos_of_several_environments_are_not_mixed(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "mixed_types", "--num-envs", "2") == 0
    metrics = read_metrics(tmp_path / "run")
    assert np.nanmin(metrics["train/return"]) > 0
    np.testing.assert_allclose(metrics["train/reward/first"], metrics["train/return"], rtol=1e-6)


def test_each_worker_has_different_episodes_and_its_own_ring(
    three: tuple[Path, str],
) -> None:
    (file,) = (three[0] / "replay").rglob("observation.state.bin")
    states = np.fromfile(file, np.float32).reshape(3, -1)
    assert all(np.count_nonzero(ring) >= 3 * 50 for ring in states)
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert not np.intersect1d(
            states[one][states[one] != 0], states[other][states[other] != 0]
        ).size


@pytest.mark.parametrize(
    "flags",
    [
        ("--num-envs", "2", "--no-synchronous"),
        pytest.param(("--no-synchronous",), marks=pytest.mark.long),
    ],
)
def test_a_run_with_workers_resumes_bit_exactly(tmp_path: Path, flags: tuple[str, ...]) -> None:
    """All environments end their episodes at the same step, so a checkpoint is between episodes."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train(whole, "plain", *flags, steps=160) == 0
    with started(parts, "plain", "--steps", "160", *flags) as process:
        wait_for(lambda: saved(parts, beyond=40), process)
    assert cli.main(["resume", str(parts)]) == 0
    assert weights(whole) == weights(parts)


@pytest.mark.parametrize(
    "failure", ["dies", "hangs", pytest.param("stops", marks=pytest.mark.long)]
)
def test_a_lost_worker_is_restarted(
    tmp_path: Path, failure: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TIMES", "1")
    # On a busy machine a slow worker must not seem to hang.
    flags = ["--num-envs", "2", "--worker-timeout", "600" if failure == "dies" else "5"]
    assert train(tmp_path / "run", failure, *flags) == 0
    printed = flat(capfd.readouterr().out)
    assert "starting the environments again (restart 1 of 10)" in printed
    metrics = read_metrics(tmp_path / "run")
    assert np.nanmax(metrics["workers/restarts"]) == 1
    assert np.nanmax(metrics["train/length"]) == 10  # the interrupted episode is not counted
    assert not multiprocessing.active_children()


def test_too_many_lost_workers_end_the_run_with_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TIMES", "2")
    run = tmp_path / "run"
    assert train(run, "dies", "--no-synchronous", "--worker-restarts", "1") == 4
    printed = flat(capfd.readouterr().err)
    assert "an environment's process died, after 1 restart: the run is saved at step 48" in printed
    assert Checkpoint.find(Run.open(run).checkpoints).step == 48
    assert cli.main(["resume", str(run)]) == 0
    assert Checkpoint.find(Run.open(run).checkpoints).step == 100


def test_a_run_whose_workers_die_before_the_first_step_leaves_no_files(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert train(run, "dies_at_reset", "--no-synchronous", "--worker-restarts", "0") == 4
    printed = flat(capfd.readouterr().err)
    assert "after 0 restarts: the run ends before its first step" in printed
    assert "Traceback" not in printed
    assert not run.exists()


def test_nothing_is_left_when_the_run_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that hangs in C code ends, too; no shared memory and no message remain."""
    monkeypatch.setenv("TIMES", "1")
    with started(
        tmp_path / "run", "hangs_in_c", "--steps", "2000000", "--num-envs", "2"
    ) as process:
        wait_for((tmp_path / "0").exists, process)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 4  # with the watcher and the resource tracker
        maps = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
        shared = [line for line in maps if "/dev/shm/" in line]
        assert shared
        assert all(line.endswith("(deleted)") for line in shared)
        process.kill()
        deadline = time.monotonic() + 2.0
        wait_for(lambda: time.monotonic() > deadline or not any(map(lives, children)))
        assert not any(map(lives, children))
        _, err = process.communicate()
    assert err == ""


def lives(process: psutil.Process) -> bool:
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGUSR1,
        *(pytest.param(n, marks=pytest.mark.long) for n in sorted(ENDING - {signal.SIGUSR1})),
    ],
)
def test_a_signal_to_all_processes_saves(tmp_path: Path, number: int) -> None:
    """A terminal or a batch system sends it to the workers and the resource tracker, too."""
    run = tmp_path / "run"
    with started(run, "slow", "--steps", "2000000", "--num-envs", "2") as process:
        wait_for(lambda: saved(run), process)
        os.killpg(process.pid, number)
        out, err = process.communicate()
    assert process.returncode == 128 + number
    assert "and saved: resume with" in flat(out)
    assert "Traceback" not in err
    assert "resource_tracker" not in err
    assert cli.main(["resume", str(run), "--minutes", "0.02"]) == 0


@pytest.mark.parametrize("phase", ["import", "make"])
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        *(pytest.param(n, marks=pytest.mark.long) for n in sorted(ENDING - {signal.SIGINT})),
    ],
)
def test_a_signal_while_workers_start_ends_the_run_immediately(
    tmp_path: Path, number: int, phase: str
) -> None:
    def starting() -> bool:
        with suppress(OSError):  # a process that has ended
            lines = [Path(f"/proc/{child.pid}/cmdline").read_bytes() for child in main.children()]
            return any(b"spawn_main" in line for line in lines)
        return False

    run = tmp_path / "run"
    with started(run, "never_ready", "--steps", "100", "--num-envs", "2") as process:
        main = psutil.Process(process.pid)
        wait_for(starting if phase == "import" else (tmp_path / "waits").exists, process)
        os.killpg(process.pid, number)
        out, err = process.communicate()
    assert process.returncode == 128 + number
    assert "stopped before training began: nothing was written" in flat(out)
    assert "Traceback" not in err
    assert "resource_tracker" not in err
    assert not run.exists()


def test_other_child_processes_of_the_caller_are_not_killed(tmp_path: Path) -> None:
    bystander = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    bystander.start()
    assert (
        train(tmp_path / "run", "dies_at_reset", "--no-synchronous", "--worker-restarts", "1") == 4
    )
    assert multiprocessing.active_children() == [bystander]
    bystander.kill()
    bystander.join()


@pytest.mark.parametrize("flags", [(), ("--no-synchronous",)])
@pytest.mark.parametrize("which", ["plain", "own_generator"])
def test_an_inexact_resume_is_reported(
    tmp_path: Path, which: str, flags: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", which, *flags) == 0
    reported = "a resumed run will have other episodes" in flat(capsys.readouterr().out)
    assert reported == (which == "own_generator")


def test_a_nan_reward_names_the_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "nan_reward", "--num-envs", "2") == 3
    error = capsys.readouterr().err
    assert "the environment's reward is nan at step 50 of environment 1" in error


def test_a_signal_stops_between_the_updates_of_a_step(
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
            "merl.training.setup.measure", lambda *_: Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
        )
        flags = ("--updates-per-step", "50", "--replay.batch-size", "8")
        assert train(run, "plain", *flags, steps=22) == 128 + signal.SIGTERM
    state = Checkpoint.find(Run.open(run).checkpoints).state()["progress"]
    assert (state["step"], state["updates"]) == (21, 10)
    assert cli.main(["resume", str(run)]) == 0
    state = Checkpoint.find(Run.open(run).checkpoints).state()["progress"]
    assert (state["step"], state["updates"]) == (22, 100)


def test_the_replay_size_of_several_environments_is_reported(three: tuple[Path, str]) -> None:
    run, output = three
    size = sum(file.stat().st_size for file in (run / "replay").rglob("*.bin"))
    assert f"the replay takes {decimal(size)} for" in output


def test_an_error_in_a_worker_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "fails", "--num-envs", "2") == 4
    error = capsys.readouterr().err.strip()
    assert "step raised LocalError: the gripper is gone (worker_envs.py, line" in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()  # the run had not started


def test_environments_step_during_an_update(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step of the environment waits for an update that starts during the step."""
    plan = DDPG.plan

    def recording(self: DDPG, step: int) -> Any:
        (tmp_path / f"learns-{step + 1}").touch()
        return plan(self, step)

    monkeypatch.setattr(DDPG, "plan", recording)
    flags = ["--no-synchronous", "--updates-per-step", "1", "--worker-timeout", "600"]
    assert train(tmp_path / "run", "waits_for_update", *flags) == 0
    assert read_metrics(tmp_path / "run")["step"][-1] == 100
