"""Kill a run repeatedly; check that its checkpoints stay, record lost steps and memory.

    python benchmarks/measure_soak.py                                  # two hours
    python benchmarks/measure_soak.py --minutes 10 --flags="--num-envs 2"  # flags of `merl train`

The run trains with the environment in a worker process, is killed (SIGKILL) every one to five
minutes, and resumes with the same command. results/soak.csv gets a row for each segment between two
kills.
"""

from __future__ import annotations

import csv
import random
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import tyro

from merl.core import METRICS_FILE, MerlError
from merl.report.curves import read_metrics
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run

OUTPUT = Path(__file__).resolve().parent.parent / "results/soak.csv"
FLAGS = ("--preset", "laptop", "--no-synchronous", "--threads", "1", "--save-every", "30")


def main(
    minutes: float = 120.0,
    least: float = 60.0,
    most: float = 300.0,
    task: str = "reach_duplo",
    flags: str = "",
    output: Path = OUTPUT,
) -> None:
    """Run the test; write and print a row for each segment, then print a summary.

    Args:
        minutes: total duration.
        least: smallest number of seconds until a kill.
        most: largest number of seconds until a kill.
        task: the task to train on.
        flags: further flags of `merl train`, after `FLAGS`.
        output: the CSV file for the rows.
    """
    with tempfile.TemporaryDirectory() as folder, output.open("w", newline="") as file:
        run = Path(folder) / "run"
        line = ["train", task, *FLAGS, *shlex.split(flags), "--run-dir", str(run), "--resume"]
        writer = csv.writer(file)
        writer.writerow(["seconds", "step", "lost_steps", "memory_begin_mb", "memory_end_mb"])

        def report(segment: Segment) -> None:
            begin, end = (round(size / 1e6, 1) for size in segment.memory)
            row = (round(segment.seconds), segment.step, segment.lost_steps, begin, end)
            writer.writerow(row)
            file.flush()
            print(*row, flush=True)

        segments = soak(line, run, 60 * minutes, (least, most), report)
        steps = read_metrics(run)["step"]
    if (np.diff(steps) < 0).any():
        raise SystemExit("the steps in the metrics are not ascending")
    ends = [segment.memory[1] / 1e6 for segment in segments]
    print(
        f"{len(segments)} kills, {segments[-1].step:,} steps, at most "
        f"{max(segment.lost_steps for segment in segments)} steps lost per kill, "
        f"memory {min(ends):.0f} to {max(ends):.0f} MB"
    )


@dataclass(frozen=True)
class Segment:
    """The part of a run from a start to the next kill.

    Attributes:
        seconds: duration.
        step: step of the last checkpoint at the kill.
        lost_steps: steps that were logged after that checkpoint; the next segment repeats them.
        memory: resident bytes of the process and its children without shared file pages, at the
            beginning and at the end of training.
    """

    seconds: float
    step: int
    lost_steps: int
    memory: tuple[int, int]


def soak(
    line: Sequence[str],
    run: Path,
    seconds: float,
    between: tuple[float, float],
    report: Callable[[Segment], None],
) -> list[Segment]:
    """Train for `seconds`, and kill the process (SIGKILL) at random times.

    Args:
        line: arguments of `merl`, with `--resume` and the run's folder, for a run that does not end
            within this time.
        run: the run's folder.
        seconds: total duration.
        between: smallest and largest number of seconds until a kill.
        report: called with each segment.

    Raises:
        SystemExit: the run ended by itself, or lost steps that were in a checkpoint.
    """
    rng, segments = random.Random(0), list[Segment]()
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        start, lasts = time.monotonic(), rng.uniform(*between)
        process = subprocess.Popen(
            [sys.executable, "-m", "merl.cli", *line],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        memory: list[int] = []
        while time.monotonic() - start < lasts:
            if process.poll() is not None:
                _, error = process.communicate()
                raise SystemExit(f"the run ended by itself with {process.returncode}: {error}")
            memory.append(_private_bytes(process.pid))
            time.sleep(min(1.0, lasts / 20))
        _kill_all(process)
        step = _saved(run)
        if segments and step < segments[-1].step:
            raise SystemExit(f"step {segments[-1].step} was saved, but the run is at step {step}")
        logged = read_metrics(run)["step"] if (run / METRICS_FILE).exists() else np.array([step])
        reached = int(np.max(logged, initial=step))
        half = memory[len(memory) // 2 :]  # without the start, which takes measurements
        first, last = half[: len(half) // 4 + 1], half[-(len(half) // 4 + 1) :]
        segments.append(
            Segment(
                time.monotonic() - start,
                step,
                max(0, reached - step),
                (int(np.median(first)), int(np.median(last))),
            )
        )
        report(segments[-1])
    return segments


def _saved(run: Path) -> int:
    """Return the step of the last checkpoint; 0 if there is none yet."""
    try:
        return Checkpoint.find(Run.open(run).checkpoints).step
    except MerlError:
        return 0


def _kill_all(process: subprocess.Popen[str]) -> None:
    """Kill the process, and check that its workers end by themselves within 30 s."""
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(children, timeout=30)
    if alive:
        raise SystemExit(f"processes {[child.pid for child in alive]} outlived the run")


def _private_bytes(pid: int) -> int:
    """Return resident bytes without mapped files, such as the replay: the system may drop them."""
    try:
        whole = psutil.Process(pid)
        infos = [p.memory_info() for p in (whole, *whole.children(recursive=True))]
    except psutil.NoSuchProcess:
        return 0
    return sum(info.rss - info.shared for info in infos)


if __name__ == "__main__":
    tyro.cli(main)
