"""A run that is killed again and again, and whether it loses anything or grows.

    python benchmarks/measure_soak.py                                  # two hours
    python benchmarks/measure_soak.py --minutes 10 --flags="--num-envs 2"  # flags of `merl train`

It trains with the environment in a process of its own, is killed (SIGKILL) every one to five
minutes, and goes on with the same line. A row for each stretch is written to results/soak.csv.
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
    """Soak, tell of each stretch, and sum up.

    Args:
        minutes: in all.
        least: seconds until a kill.
        most: seconds until a kill.
        task: what is trained on.
        flags: of `merl train`, after those of a laptop.
        output: where the rows go.
    """
    with tempfile.TemporaryDirectory() as folder, output.open("w", newline="") as file:
        run = Path(folder) / "run"
        line = ["train", task, *FLAGS, *shlex.split(flags), "--run-dir", str(run), "--resume"]
        writer = csv.writer(file)
        writer.writerow(["seconds", "step", "lost_steps", "memory_begin_mb", "memory_end_mb"])

        def tell(stretch: Stretch) -> None:
            begin, end = (round(size / 1e6, 1) for size in stretch.memory)
            row = (round(stretch.seconds), stretch.step, stretch.lost_steps, begin, end)
            writer.writerow(row)
            file.flush()
            print(*row, flush=True)

        stretches = soak(line, run, 60 * minutes, (least, most), tell)
        steps = read_metrics(run)["step"]
    if (np.diff(steps) < 0).any():
        raise SystemExit("steps in the metrics go back")
    ends = [stretch.memory[1] / 1e6 for stretch in stretches]
    print(
        f"{len(stretches)} kills, {stretches[-1].step:,} steps, at most "
        f"{max(stretch.lost_steps for stretch in stretches)} steps lost at once, "
        f"memory {min(ends):.0f} to {max(ends):.0f} MB"
    )


@dataclass(frozen=True)
class Stretch:
    """From one start to the next kill.

    Attributes:
        seconds: that it lasted.
        step: of the last checkpoint at its end.
        lost_steps: logged after that checkpoint, and taken again in the next stretch.
        memory: resident bytes of the process and its children that are no shared file pages, at
            the beginning and at the end of training.
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
    tell: Callable[[Stretch], None],
) -> list[Stretch]:
    """Train for so many seconds with a kill -9 at random moments, then to the end of an episode.

    Args:
        line: of `merl`, with `--resume` and the run's folder; of a run too long to come to its end.
        run: the folder.
        seconds: in all.
        between: the least and the most seconds until a kill.
        tell: is told each stretch.

    Raises:
        SystemExit: the run ended by itself, or lost what a checkpoint had.
    """
    moment, stretches = random.Random(0), list[Stretch]()
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        begun, lasts = time.monotonic(), moment.uniform(*between)
        process = subprocess.Popen(
            [sys.executable, "-m", "merl.cli", *line],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        memory: list[int] = []
        while time.monotonic() - begun < lasts:
            if process.poll() is not None:
                _, said = process.communicate()
                raise SystemExit(f"the run ended by itself with {process.returncode}: {said}")
            memory.append(_private_bytes(process.pid))
            time.sleep(min(1.0, lasts / 20))
        _kill_all(process)
        step = _saved(run)
        if stretches and step < stretches[-1].step:
            raise SystemExit(f"step {stretches[-1].step} was saved, but now it stands at {step}")
        logged = read_metrics(run)["step"] if (run / METRICS_FILE).exists() else np.array([step])
        reached = int(np.max(logged, initial=step))
        half = memory[len(memory) // 2 :]  # after the start, with its measurements
        first, last = half[: len(half) // 4 + 1], half[-(len(half) // 4 + 1) :]
        stretches.append(
            Stretch(
                time.monotonic() - begun,
                step,
                max(0, reached - step),
                (int(np.median(first)), int(np.median(last))),
            )
        )
        tell(stretches[-1])
    return stretches


def _saved(run: Path) -> int:
    """The step of the last checkpoint; 0 of a run that was killed before its first one."""
    try:
        return Checkpoint.find(Run.open(run).checkpoints).step
    except MerlError:
        return 0


def _kill_all(process: subprocess.Popen[str]) -> None:
    """The process alone is killed; its workers are to end by themselves."""
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(children, timeout=30)
    if alive:
        raise SystemExit(f"processes {[child.pid for child in alive]} outlived the run")


def _private_bytes(pid: int) -> int:
    """Resident memory that is no page of a mapped file: the replay's are the system's to drop."""
    try:
        whole = psutil.Process(pid)
        infos = [p.memory_info() for p in (whole, *whole.children(recursive=True))]
    except psutil.NoSuchProcess:
        return 0
    return sum(info.rss - info.shared for info in infos)


if __name__ == "__main__":
    tyro.cli(main)
