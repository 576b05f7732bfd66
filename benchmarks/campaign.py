"""Kill runs at each of their file operations and at random times; compare what they end with.

    python benchmarks/campaign.py                             # over a thousand kills
    python benchmarks/campaign.py --kills 6 --variants merl   # a short form
    python benchmarks/campaign.py --python ~/py312/bin/python # other Python for every second start

A run of a few seconds is killed (SIGKILL) just before its k-th file operation; its resumption at
an operation or a time drawn at random, and the next one too; then it runs to its end. Weights,
learner, replay and metrics must be those of a run that nobody killed, bit for bit; no output may
contain a traceback, and `merl check` must find the folder sound. Every start draws other numbers
from the global random generators first, and uses one core or all of them. results/campaign.csv gets
a row for each variant.

A run takes about a second: the processes are forks of this one, which has imported everything, and
neither time the machine nor draw curves.
"""

from __future__ import annotations

import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium import spaces
from safetensors.torch import load_file

import merl.report.figures
import merl.training.setup
from faults import Ended, Faults, with_faults
from merl.cli import main as run_merl
from merl.demos.recorder import Recorder
from merl.envs.dot import SteerDot
from merl.evaluation.demonstrating import record_episodes
from merl.report.curves import read_metrics
from merl.runs.checking import check_run
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.training.timing import Arithmetic, Timing

OUTPUT = Path(__file__).resolve().parent.parent / "results/campaign.csv"
DOT = "merl.envs.dot:whole"
SMALL = (
    *("--preset", "smoke", "--threads", "1", "--agent.precision", "fp32"),
    *("--random-steps", "40", "--seed-steps", "40", "--updates-per-step", "0.1"),
    *("--save-every", "0", "--eval.every", "40", "--eval.episodes", "1", "--eval.video", "none"),
    *("--eval.no-references", "--steps", "120", "--replay.batch-size", "8"),
    *("--replay.capacity", "60"),  # the ring wraps
)
"""A run of six episodes, with a checkpoint after each."""
NARROW = ("--agent.hidden-dim", "32")
VARIANTS: dict[str, tuple[str, ...]] = {
    "merl": (DOT, *NARROW),
    "drqv2": (DOT, *NARROW, "--agent", "drqv2"),
    "proprio": (DOT, *NARROW, "--agent", "proprio"),
    "merl_state": ("campaign:Joints", *NARROW, "--agent", "merl_state"),
    "ddpg": ("campaign:Joints", *NARROW, "--agent", "ddpg"),
    "sac": ("campaign:Joints", *NARROW, "--agent", "sac"),
    "bc": (DOT, *NARROW, "--agent", "bc", "--demos", "{demos}"),
    "demonstrations": (DOT, *NARROW, "--demos", "{demos}", "--agent.clone-weight", "1"),
    "compressed": (DOT, *NARROW, "--replay.compress"),
    "three environments": (DOT, *NARROW, "--num-envs", "3"),
    "every modality": ("campaign:Senses", *NARROW),
    "whole replay": (DOT, *NARROW, "--replay.capacity", "120"),
}
"""Arguments of `merl train` for each kind of run."""
STARTING = 4.0
"""Seconds that another interpreter needs before its run begins."""


@dataclass
class Row:
    """The result of one variant."""

    variant: str
    operations: int = 0
    at_operation: int = 0
    at_time: int = 0
    ends: int = 0
    failures: list[str] = field(default_factory=list)


class Senses(gymnasium.Env[Any, Any]):
    """An environment with an image, depth, a history of forces and joints, all of them random."""

    boxes: ClassVar[dict[str, spaces.Box]] = {
        "image": spaces.Box(0, 255, (24, 24, 3), np.uint8),
        "depth": spaces.Box(0.1, 2.0, (24, 24), np.float32),
        "force": spaces.Box(-50, 50, (16, 6), np.float32),
        "joints": spaces.Box(-1, 1, (2,), np.float32),
    }
    observation_space = spaces.Dict({key: box for key, box in boxes.items()})  # noqa: C416
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        self._steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        """See `gymnasium.Env.step`; an episode has 20 steps."""
        self._steps += 1
        return self._observe(), float(action[0]), False, self._steps == 20, {}

    def _observe(self) -> dict[str, Any]:
        return {
            key: (box.low + self.np_random.random(box.shape) * (box.high - box.low)).astype(
                box.dtype
            )
            for key, box in self.boxes.items()
        }


class Joints(gymnasium.ObservationWrapper[Any, Any, Any]):
    """The joints of `Senses` alone, as one vector."""

    def __init__(self) -> None:
        super().__init__(Senses())
        self.observation_space = Senses.boxes["joints"]

    def observation(self, observation: dict[str, Any]) -> Any:
        """Return the joints."""
        return observation["joints"]


def main(
    kills: int = 60,
    variants: tuple[str, ...] = tuple(VARIANTS),
    each: tuple[str, ...] = ("merl",),
    python: Path | None = None,
    seed: int = 0,
    output: Path | None = OUTPUT,
) -> int:
    """Run the campaign; print and write a row for each variant. Return 1 if anything differed.

    Args:
        kills: number of kills for each variant.
        variants: which of `VARIANTS`.
        each: variants that are killed at every one of their operations, whatever `kills` says.
        python: another interpreter with merl, perhaps of another version, in which every second
            process of a run runs.
        seed: of the random times, operations and numbers.
        output: the CSV file for the rows; None: only print.
    """
    _make_runs_short()
    os.chdir(Path(__file__).parent)  # where `campaign:Senses` is found
    rows = []
    with tempfile.TemporaryDirectory() as name:
        demos = _record(Path(name) / "demos")
        for variant in variants:
            given = [part.format(demos=demos) for part in VARIANTS[variant]]
            folder, most = (
                Path(name) / variant.replace(" ", "-"),
                None if variant in each else kills,
            )
            begun, rng = time.monotonic(), random.Random(f"{seed} {variant}")
            row = attack(variant, [*given[:1], *SMALL, *given[1:]], folder, most, rng, python)
            rows.append(row)
            seconds = round(time.monotonic() - begun)
            print(
                f"{variant}: {row.operations} operations, {row.at_operation} kills at one and "
                f"{row.at_time} between, {row.ends} runs compared, {len(row.failures)} differences "
                f"({seconds} s)",
                flush=True,
            )
            for failure in row.failures:
                print(f"  {failure}", flush=True)
            if output is not None:
                _write(output, rows)
    count = sum(row.at_operation + row.at_time for row in rows)
    failed = sum(len(row.failures) for row in rows)
    print(f"{count} kills, {failed} differences")
    return int(failed > 0)


def attack(
    variant: str,
    arguments: list[str],
    folder: Path,
    kills: int | None,
    rng: random.Random,
    python: Path | None,
) -> Row:
    """Kill runs, and compare them with one that nobody killed.

    Args:
        variant: name of the variant.
        arguments: of `merl train`, without the run's folder.
        folder: place of the runs; does not exist.
        kills: number of kills; None: the run is killed at every operation once, and its two next
            processes at random.
        rng: draws operations and times.
        python: see `main`.
    """
    row, whole = Row(variant), folder / "whole"
    folder.mkdir(parents=True)
    begun = time.monotonic()
    ended = _start(arguments, whole, rng, Faults(whole))
    if ended.code != 0:
        row.failures.append(f"the run without a kill ended with {ended.code}: {ended.err}")
        return row
    row.operations, lasts = len(ended.names), time.monotonic() - begun
    points = list(range(1, row.operations + 1))
    if kills is not None:
        points = rng.sample(points, min(len(points), max(1, kills // 3)))
    for point in points:
        run, printed = folder / f"run-{point}", ""
        left = 1 - point / row.operations  # of the run, when it resumes
        for attempt in range(4):
            if python is not None and rng.random() < 0.5:
                seconds = STARTING + rng.uniform(-1.0, left * lasts) if attempt < 3 else None
                ended = _start_other(python, arguments, run, seconds)
            elif attempt == 0 or (attempt < 3 and rng.random() < 0.5):
                at = rng.randint(1, 20 + int(left * row.operations)) if attempt else point
                ended = _start(arguments, run, rng, Faults(run, at))
            else:
                seconds = rng.uniform(1e-3, left * lasts + 0.2) if attempt < 3 else None
                ended = _start(arguments, run, rng, seconds=seconds)
            printed += ended.out + ended.err
            row.at_operation += ended.code == -signal.SIGKILL
            row.at_time += ended.code == -signal.SIGALRM
            if ended.code >= 0:
                break
        row.ends += 1
        found = [f"it ended with {ended.code}"] if ended.code else list(differences(whole, run))
        if "Traceback" in printed:
            found.append("its output has a traceback")
        row.failures += [f"killed at operation {point}: {each}" for each in found]
        if found:
            print(*printed.splitlines()[-30:], sep="\n", file=sys.stderr)
        shutil.rmtree(run)
    shutil.rmtree(folder)
    return row


def differences(one: Path, other: Path) -> Iterator[str]:
    """Yield what differs between two runs, except for times, and what is damaged in the second."""
    ends = [Checkpoint.find(run / "checkpoints").path for run in (one, other)]
    if ends[0].name != ends[1].name:
        yield f"it ended at step {ends[1].name}, not {ends[0].name}"
        return
    weights, learners = (
        [read(end / name) for end in ends]
        for read, name in (
            (load_file, "weights.safetensors"),
            (lambda path: torch.load(path, weights_only=True), "learner.pt"),
        )
    )
    if not _equal(*weights):
        yield "its weights differ"
    if not _equal(*learners):
        yield "the state of its learner differs"
    files = [
        sorted(p.relative_to(run) for p in (run / "replay").rglob("*.bin")) for run in (one, other)
    ]
    if files[0] != files[1]:
        yield f"its replay has {len(files[1])} files, not {len(files[0])}"
    for file in files[0]:
        if files[0] == files[1] and (one / file).read_bytes() != (other / file).read_bytes():
            yield f"{file} differs"
    metrics = [read_metrics(run) for run in (one, other)]
    if metrics[0].keys() != metrics[1].keys():
        yield "its metrics have other columns"
        return
    for name, values in metrics[0].items():
        if not name.startswith("time/") and not np.array_equal(
            values, metrics[1][name], equal_nan=True
        ):
            yield f"the metrics differ in {name}"
    yield from (each.text for each in check_run(Run.open(other)) if not each.sound)


def _equal(one: Any, other: Any) -> bool:
    """Compare nested states that contain tensors, bit for bit."""
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return bool(one == other)


def _start(
    arguments: list[str],
    run: Path,
    rng: random.Random,
    faults: Faults | None = None,
    seconds: float | None = None,
) -> Ended:
    """Train or resume a run in a fork of this process.

    Args:
        arguments: of `merl train`, without the run's folder.
        run: the run's folder.
        rng: draws the numbers that the process draws first, and whether it may use all cores.
        faults: counts the process' operations, or kills it at one of them.
        seconds: time after which the system ends the process (SIGALRM), wherever it is.
    """
    number, one_core = rng.getrandbits(31), rng.random() < 0.5

    def train() -> int:
        if seconds is not None:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, seconds)
        if one_core:
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        random.seed(number)
        np.random.seed(number)  # noqa: NPY002 (the global generator of a user's code)
        torch.manual_seed(number)
        return run_merl(_line(arguments, run))

    return with_faults(train, faults)


def _start_other(python: Path, arguments: list[str], run: Path, seconds: float | None) -> Ended:
    """Train or resume a run in another interpreter; end it after `seconds`, as `_start` does."""
    command = [str(python), "-m", "merl.cli", *_line(arguments, run)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            out, err = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGALRM)
            out, err = process.communicate()
    return Ended(process.returncode, out, err, [])


def _line(arguments: list[str], run: Path) -> list[str]:
    return ["train", *arguments, "--run-dir", str(run), "--resume"]


def _record(folder: Path) -> Path:
    """Record demonstrations of the dot."""
    env = SteerDot()
    both = cast(Any, (env.observation_space, env.action_space))
    recorder = Recorder(folder, DOT, "the best policy", *both)
    act = lambda _: env.best_action()  # noqa: E731
    for episode in record_episodes(act, env, episodes=3):
        recorder.add(episode)
    return folder


def _make_runs_short() -> None:
    """Import what a run imports, so that its fork need not; leave out timing and drawing."""
    torch.set_num_threads(1)
    import_module("merl.cli.train")
    timing = Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
    vars(merl.training.setup)["measure"] = lambda *_: timing
    vars(merl.report.figures)["learning_curve"] = lambda _, to, **__: to


def _write(output: Path, rows: list[Row]) -> None:
    with output.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "variant",
                "operations",
                "kills_at_operations",
                "kills_at_times",
                "runs",
                "differences",
            ]
        )
        for row in rows:
            counts = row.operations, row.at_operation, row.at_time, row.ends, len(row.failures)
            writer.writerow([row.variant, *counts])


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
