"""Runs that are killed and resume: separate processes, on a task that takes seconds."""

from __future__ import annotations

import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from helpers import flat, wait_for
from merl.cli import main
from merl.report.curves import read_metrics

MERL = [sys.executable, "-m", "merl.cli"]
EPISODE = 20
"""Steps of an episode of the dot environment."""
STEPS = 600


def line(folder: Path, *more: str) -> list[str]:
    """Return a command that trains the dot and saves at the end of every episode."""
    small = {
        "--preset": "smoke",
        "--threads": 1,
        "--agent.precision": "fp32",
        "--agent.hidden-dim": 32,
        "--random-steps": 100,
        "--seed-steps": 100,
        "--updates-per-step": 0.25,
        "--save-every": 0,
        "--eval.every": 200,
        "--eval.episodes": 2,
        "--eval.video": "none",
        "--steps": STEPS,
        "--run-dir": folder,
    }
    flags = [str(part) for flag in small.items() for part in flag]
    return ["train", "merl.envs.dot:whole", *flags, *more]


def saved(folder: Path) -> list[int]:
    checkpoints = folder / "checkpoints"
    names = [p.name for p in checkpoints.iterdir()] if checkpoints.is_dir() else []
    return sorted(int(name) for name in names if name.isdigit())


def wait_until_saved(folder: Path, process: subprocess.Popen[str], beyond: int = 0) -> None:
    wait_for(lambda: any(step > beyond for step in saved(folder)), process)


def start(arguments: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*MERL, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@contextmanager
def started(arguments: list[str]) -> Iterator[subprocess.Popen[str]]:
    """Start a process that ends with the test at the latest."""
    process = start(arguments)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def assert_same(one: Path, other: Path) -> None:
    """Check that weights, replay and metrics are equal, bit for bit, except columns of times."""
    assert saved(one)[-1] == saved(other)[-1]
    weights = [load_file(run / f"checkpoints/{saved(run)[-1]:08d}/weights.safetensors")
               for run in (one, other)]  # fmt: skip
    for name, tensor in weights[0].items():
        assert tensor.equal(weights[1][name]), name
    files = sorted(path.relative_to(one / "replay") for path in (one / "replay").rglob("*.bin"))
    assert len(files) == 7 + ("observation.image.span" in [path.stem for path in files])
    for name in files:
        assert (one / "replay" / name).read_bytes() == (other / "replay" / name).read_bytes(), name
    metrics = [read_metrics(run) for run in (one, other)]
    assert metrics[0].keys() == metrics[1].keys()
    for name, values in metrics[0].items():
        if not name.startswith("time/"):
            np.testing.assert_array_equal(values, metrics[1][name], err_msg=name)


def check_killed_run_resumes_exactly(
    tmp_path: Path, kills: int, more: tuple[str, ...] = (), at: int = 0
) -> None:
    """Compare a complete run with one that is killed `kills` times, first after step `at`."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main(line(whole, *more)) == 0
    delay = random.Random(kills)
    done, first = at, line(parts, *more)
    while kills:
        with started(first if not saved(parts) else ["resume", str(parts)]) as process:
            wait_until_saved(parts, process, done)
            time.sleep(delay.uniform(0.0, 0.3))
        reached, before = int(read_metrics(parts)["step"][-1]), done
        done = saved(parts)[-1]
        assert done > before
        assert reached - done <= EPISODE, "more than one checkpoint interval is lost"
        kills -= 1
        if done == STEPS:
            break
    assert main(["resume", str(parts)]) == 0
    assert_same(whole, parts)


def test_a_killed_run_resumes_bit_exactly(tmp_path: Path) -> None:
    check_killed_run_resumes_exactly(tmp_path, 2)


@pytest.mark.parametrize("more", [(), pytest.param(("--replay.compress",), marks=pytest.mark.long)])
def test_a_killed_run_resumes_bit_exactly_after_the_ring_has_wrapped(
    tmp_path: Path, more: tuple[str, ...]
) -> None:
    check_killed_run_resumes_exactly(tmp_path, 1, ("--replay.capacity", "200", *more), at=240)


@pytest.mark.long
@pytest.mark.parametrize("more", [(), ("--replay.compress",)])
def test_a_killed_run_resumes_bit_exactly_while_the_ring_wraps(
    tmp_path: Path, more: tuple[str, ...]
) -> None:
    check_killed_run_resumes_exactly(tmp_path, 4, ("--replay.capacity", "200", *more))


@pytest.mark.long
def test_a_run_killed_twenty_times_resumes_bit_exactly(tmp_path: Path) -> None:
    check_killed_run_resumes_exactly(tmp_path, 20, ("--steps", "4000"))


@pytest.mark.parametrize("number", [signal.SIGUSR1])
def test_a_signal_saves_during_any_work(tmp_path: Path, number: int) -> None:
    check_signals_save(tmp_path, [number])


@pytest.mark.long
def test_many_signals_save_during_any_work(tmp_path: Path) -> None:
    check_signals_save(tmp_path, [signal.SIGTERM, signal.SIGUSR1, signal.SIGINT] * 4)


def check_signals_save(tmp_path: Path, numbers: list[int]) -> None:
    """Signal a run that acts, learns, and often evaluates and makes videos."""
    folder, delay = tmp_path / "run", random.Random(len(numbers))
    often = ["--eval.every", "20", "--eval.video", "each", "--steps", "100000"]
    for number in numbers:
        done = saved(folder)[-1] if saved(folder) else 0
        with started(["resume", str(folder)] if done else line(folder, *often)) as process:
            wait_until_saved(folder, process, done)
            time.sleep(delay.uniform(0.0, 1.0))
            process.send_signal(number)
            out, err = process.communicate()
        assert process.returncode == 128 + number, err
        assert "Traceback" not in err
        assert f"merl resume {folder}" in flat(out)
    assert main(["resume", str(folder), "--steps", str(saved(folder)[-1] + 100)]) == 0
    steps = read_metrics(folder)["step"]
    assert (np.diff(steps) > 0).all()


def test_a_folder_that_is_moved_away_is_not_created_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started(line(folder, "--steps", "100000")) as process:
        wait_until_saved(folder, process)
        folder.rename(tmp_path / "elsewhere")
        _, err = process.communicate()
    assert process.returncode == 2
    assert "is gone" in err
    assert "Traceback" not in err
    assert not folder.exists()
    further = str(saved(tmp_path / "elsewhere")[-1] + EPISODE)
    assert main(["resume", str(tmp_path / "elsewhere"), "--steps", further]) == 0


def test_one_command_starts_resumes_and_completes_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, short = tmp_path / "run", ["--resume", "--steps", "200"]
    assert main(line(folder, *short)) == 0
    assert main(line(folder, *short)) == 0
    assert "is done: 200 of 200 steps" in capsys.readouterr().out

    assert main(line(folder, "--resume", "--steps", "300", "--eval.episodes", "1")) == 0
    out = flat(capsys.readouterr().out)
    assert "resumes at step 200 with steps 200 -> 300, eval.episodes 2 -> 1:" in out

    before = (folder / "config.json").read_bytes()
    assert main(line(folder, "--resume", "--seed", "1", "--agent.latent-dim", "64")) == 2
    err = capsys.readouterr().err
    assert "seed 0 -> 1" in err
    assert "agent.latent_dim 128 -> 64" in err
    assert (folder / "config.json").read_bytes() == before

    assert main(line(folder, "--steps", "400")) == 2
    assert "already exists" in capsys.readouterr().err
    shutil.rmtree(folder / "checkpoints")
    assert main(line(folder, "--resume", "--steps", "400")) == 2
    assert "no complete checkpoint" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "resume"])
def test_a_run_killed_before_its_first_checkpoint_starts_again(
    tmp_path: Path, command: str
) -> None:
    folder = tmp_path / "run"
    assert main(line(folder, "--steps", "100")) == 0
    shutil.rmtree(folder / "checkpoints")
    (folder / "metrics.csv").write_text("step\n")
    assert main(["resume", str(folder)]) == 2  # there are steps in its replay
    (timesteps,) = (folder / "replay").rglob("timestep.bin")
    # State after a kill before the first checkpoint: an empty replay.
    timesteps.write_bytes(bytes(8 * 200))
    (folder / "checkpoints" / ".part-00000000").mkdir(parents=True)
    train = line(folder, "--resume", "--steps", "200")
    assert main(train if command == "train" else ["resume", str(folder)]) == 0
    steps = read_metrics(folder)["step"]
    assert steps[0] == EPISODE
    assert steps[-1] == saved(folder)[-1] == (200 if command == "train" else 100)
    assert main(["resume", str(folder), "--steps", "220"]) == 0


@pytest.mark.long
def test_a_soak_for_three_minutes(tmp_path: Path) -> None:
    """Run `benchmarks/measure_soak.py`, which takes two hours by default."""
    without_end = ["--steps", "100000000", "--updates-per-step", "0.1"]
    flags = [*line(tmp_path)[2:-4], *without_end]  # the script adds --run-dir
    script = Path(__file__).parents[2] / "benchmarks" / "measure_soak.py"
    rows = tmp_path / "soak.csv"
    command = [sys.executable, script, "--minutes", "3", "--least", "40", "--most", "60"]
    command += ["--task", "merl.envs.dot:whole", "--output", rows, f"--flags={' '.join(flags)}"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    values = np.loadtxt(rows, delimiter=",", skiprows=1)
    assert len(values) >= 2
    assert values[-1, 1] > values[0, 1] > 0
    assert (values[:, 2] <= EPISODE).all()


def campaign(*options: str) -> str:
    """Run `benchmarks/campaign.py`, which takes an hour by default; return its last line."""
    script = Path(__file__).parents[2] / "benchmarks" / "campaign.py"
    command = [sys.executable, str(script), *options, "--output", "None"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3000)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()[-1]


def test_a_short_campaign_of_kills_finds_no_difference() -> None:
    last = campaign("--variants", "compressed", "--kills", "9", "--each")
    assert re.fullmatch(r"\d+ kills, 0 differences", last)
    assert int(last.split()[0]) >= 3


@pytest.mark.long
def test_a_campaign_over_every_kind_of_run_finds_no_difference() -> None:
    assert campaign("--kills", "6", "--each").endswith(" kills, 0 differences")
