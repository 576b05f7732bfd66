"""merl sweep with real runs: in processes, on a local Ray cluster, and as a script for Slurm."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from helpers import flat, wait_for
from merl.cli import main
from merl.config import TrainConfig
from merl.experiments.experiment import PlannedRun
from merl.experiments.sweep import Settings, execute

TESTS = Path(__file__).parent.parent
STEPS = 1000
SWEEP = """
tasks = ["sweep_env:make"]
preset = "smoke"
[values]
threads = 1
steps = 1_000
random_steps = 100
seed_steps = 100
updates_per_step = 0.02
save_every = 1.0
eval.every = 1_000
eval.episodes = 2
eval.video = "none"
eval.references = false
replay.batch_size = 16
agent.precision = "fp32"
agent.hidden_dim = 16
agent.keys = ["joint"]
[variants.one]
[variants.two]
agent.tau = 0.02
"""
ENVIRONMENT = """
import os
import time
from pathlib import Path
from toy import DotEnv

class Env(DotEnv):
    def step(self, action):
        time.sleep(0.002)
        if Path("broken").exists():
            raise ValueError("the gripper is gone")
        return super().step(action)

def make():
    return Env()
"""
RUNS = [f"sweep_env-make-{variant}-s{seed}" for variant in ("one", "two") for seed in (0, 1)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with an environment and a sweep, and work in it."""
    (tmp_path / "sweep_env.py").write_text(ENVIRONMENT)
    (tmp_path / "mine.toml").write_text(SWEEP)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(tmp_path)]))
    return tmp_path


def start(*options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "merl.cli", "sweep", "mine.toml", "--episodes", "3", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    out, _ = process.communicate(timeout=300)
    assert "Traceback" not in out
    return process.returncode, flat(out)


def process_of(run: Path) -> int | None:
    """Return the process that trains a run and has finished an episode."""
    try:
        lines = (run / "metrics.csv").read_text().count("\n")
        return int((run / "lock").read_text()) if lines > 3 else None
    except (OSError, ValueError):
        return None


def kill(run: Path, process: subprocess.Popen[str], number: int = signal.SIGKILL) -> None:
    wait_for(lambda: process_of(run), process)
    os.kill(process_of(run) or 0, number)


def evaluated(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob("sweeps/smoke/*/evaluation.json"))


def last_step(run: Path) -> int:
    return int((run / "metrics.csv").read_text().splitlines()[-1].partition(",")[0])


@pytest.mark.parametrize(
    ("seeds", "engine"),
    [(1, ("--jobs", "1")), (2, ("--ray", "--cpus", "1"))],
    ids=["here", "ray"],
)
def test_a_killed_run_is_resumed_and_a_failing_one_stops_no_other(
    folder: Path, seeds: int, engine: tuple[str, ...]
) -> None:
    runs = folder / "sweeps/smoke"
    names = [name for name in RUNS if int(name[-1]) < seeds]
    options = ("--seeds", str(seeds), *engine)
    sweep = start("--retries", "1", *options)
    kill(runs / RUNS[0], sweep)
    wait_for(lambda: RUNS[0] in evaluated(folder), sweep)
    (folder / "broken").touch()  # for the last run at least
    code, out = finish(sweep)
    assert code == 1
    done = evaluated(folder)
    assert RUNS[0] in done
    assert len(done) < len(names)
    for name in {*names} - {*done}:
        assert f"{name}: failed after" in out
    assert "the gripper is gone" in out
    assert "(log: " in out
    assert last_step(runs / RUNS[0]) == STEPS
    assert len(json.loads((runs / RUNS[0] / "evaluation.json").read_text())["episodes"]) == 3

    (folder / "broken").unlink()
    code, again = finish(start(*options))
    assert code == 0
    assert f"{len(names)} runs in {runs}, {len(done)} done" in again
    assert evaluated(folder) == sorted(names)
    assert again.count("return ") == 2 * len(names) - len(done)  # when it ends, and in the table
    assert not any(f"{name}: done" in again for name in done)


def test_a_run_reports_its_own_time(folder: Path) -> None:
    command = ("nothing", "--run-dir", "mine")
    run = PlannedRun("mine", folder / "mine", "one", TrainConfig("nothing"), command)
    begin = time.monotonic()
    outcome = execute(run, Settings(retries=0))
    assert outcome.name == "mine"
    assert "task 'nothing' is unknown" in (outcome.error or "")
    assert 0.1 < outcome.seconds <= time.monotonic() - begin
    (folder / "file").touch()
    outcome = execute(replace(run, folder=folder / "file/mine"), Settings())
    assert "it cannot be started" in (outcome.error or "")


def test_a_signal_saves_all_runs_and_the_same_command_continues(folder: Path) -> None:
    run = folder / "sweeps/smoke" / RUNS[0]
    sweep = start("--seeds", "1", "--jobs", "2")
    wait_for(lambda: process_of(run), sweep)
    sweep.terminate()
    code, out = finish(sweep)
    assert code == 128 + signal.SIGTERM
    assert "stopped: the same command continues" in out
    saved = last_step(run)
    assert saved < STEPS
    assert any((run / "checkpoints").iterdir())
    code, out = finish(start("--seeds", "1"))
    assert code == 0
    assert f"{RUNS[0]}: continues at step {saved:,}" in out


def test_runs_save_when_the_sweep_itself_is_killed(folder: Path) -> None:
    run = folder / "sweeps/smoke" / RUNS[0]
    sweep = start("--seeds", "1")
    wait_for(lambda: process_of(run), sweep)
    trainer = process_of(run)
    sweep.kill()
    sweep.communicate()
    wait_for(lambda: not Path(f"/proc/{trainer}").exists())
    assert "stopped at step" in run.with_name(f"{run.name}.log").read_text()


def test_on_ray_a_run_whose_machine_is_lost_resumes_on_another(folder: Path) -> None:
    from ray.cluster_utils import Cluster

    run = folder / "sweeps/smoke" / RUNS[0]
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        first = cluster.add_node(num_cpus=1)
        sweep = start("--seeds", "1", "--ray", "--address", cluster.address)
        wait_for(lambda: process_of(run), sweep)
        trainer = process_of(run)
        cluster.remove_node(first, allow_graceful=False)
        wait_for(lambda: process_of(run) != trainer or not Path(f"/proc/{trainer}").exists())
        cluster.add_node(num_cpus=1)
        code, out = finish(sweep)
    finally:
        cluster.shutdown()
    assert code == 0, out
    assert evaluated(folder) == [RUNS[0], RUNS[2]]
    assert last_step(run) == STEPS


def test_the_script_for_slurm_trains_and_requeues(folder: Path) -> None:
    code, out = finish(start("--seeds", "1", "--slurm", "sweep.sh", "--cpus", "2"))
    assert (code, "sbatch sweep.sh" in out) == (0, True)
    script = (folder / "sweep.sh").read_text()
    assert "--array=0-1" in script
    assert "--cpus-per-task=2" in script
    tools = folder / "bin"
    tools.mkdir()
    (tools / "scontrol").write_text(f'#!/bin/sh\necho "$@" > {folder}/requeued\n')
    (tools / "merl").write_text(f'#!/bin/sh\nexec {sys.executable} -m merl.cli "$@"\n')
    for tool in tools.iterdir():
        tool.chmod(0o755)
    slurm = {"SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_JOB_ID": "7"}
    env = os.environ | slurm | {"PATH": f"{tools}:{os.environ['PATH']}"}
    run = folder / "sweeps/smoke" / RUNS[2]

    def task() -> subprocess.Popen[str]:
        return subprocess.Popen(["bash", "sweep.sh"], env=env, text=True)

    job = task()
    wait_for(lambda: process_of(run), job)
    job.send_signal(signal.SIGUSR1)
    assert job.wait(timeout=120) == 0
    assert (folder / "requeued").read_text() == "requeue 7_1\n"
    assert last_step(run) < STEPS
    assert task().wait(timeout=120) == 0
    assert evaluated(folder) == [RUNS[2]]


def test_the_folder_of_another_experiment_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    train = ["train", "reach_duplo", "--preset", "smoke", "--steps", "260", "--threads", "1"]
    train += ["--eval.every", "0", "--run-dir", "sweeps/smoke/reach_duplo-no_norm-s0"]
    assert main(train) == 0
    capsys.readouterr()
    sweep = ["sweep", "fig3c", "--preset", "smoke", "--tasks", "reach_duplo", "--seeds", "1"]
    assert main([*sweep, "--steps", "260"]) == 2
    error = capsys.readouterr().err
    assert "holds a run of another experiment (agent.fusion_norm True, not False)" in error


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["fig22"], "experiment 'fig22' is unknown: did you mean 'fig2'"),
        (["fig2", "--tasks", "reach_duplos"], "did you mean 'reach_duplo'?"),
        (["fig2", "--preset", "fast"], "preset 'fast' is unknown"),
        (["fig2", "--seeds", "0"], "--seeds must be at least 1"),
        (["fig2", "--address", "10.0.0.1:6379"], "is for --ray"),
        (["none.toml"], "none.toml cannot be read"),
        (["fig2", "--slurm", "no/where.sh"], "no/where.sh cannot be written"),
        (["occluded", "--tasks", "reach_duplo"], "reach_duplo has no occluded form"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    options: Sequence[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "sweeps").exists()


def test_a_dry_run_lists_the_runs_with_their_cost(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["fig3c", "--preset", "smoke", "--tasks", "reach_duplo", "--dry-run", "--seeds", "2"]
    assert main(["sweep", *options]) == 0
    out = flat(capsys.readouterr().out)
    assert out.count("missing 0.0") == 4
    assert "--agent.no-fusion-norm --seed 1 --run-dir" in out
    assert "hours are left" in out
    assert not (tmp_path / "sweeps").exists()
