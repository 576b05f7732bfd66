"""Train the runs of the learning curves.

    python benchmarks/measure_runs.py GROUP ... [--seeds 0 1 2] [--jobs 2]

Trains the missing runs of the named groups, `--jobs` at a time, each on one thread at the lowest
priority. Copies their metrics to results/runs/NAME.csv every two minutes; at a run's end, writes 50
evaluation episodes to NAME-evaluation.json. Finished runs are not repeated. SIGTERM or Ctrl-C saves
the runs; the same command resumes them. `--list` lists the runs and their progress. Start it in a
clone that nobody edits: an edit would change the runs.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "results/runs"
RUNS = ROOT / "runs/measured"
COPY_EVERY = 120.0
"""Seconds."""
BOXES = ("move_box", "lift_box")
STATE_AGENTS = ("merl_state", "ddpg", "sac")
LAPTOP = "--preset laptop --num-envs 1 --synchronous --agent.precision bf16"
"""One environment in turn with the learner, so that a run can be repeated bit for bit."""
STATE = "--preset state"
REACH_STEPS, BOX_STEPS = 300_000, 1_000_000


def figure2() -> Iterator[tuple[str, str]]:
    """Yield every agent on reach_duplo; agents that observe the state have preset state."""
    for agent in ("merl", "drqv2", "proprio", *STATE_AGENTS):
        preset = STATE if agent in STATE_AGENTS else LAPTOP
        noise = f" --agent.noise-steps {REACH_STEPS // 2}" if agent == "drqv2" else ""
        yield (
            f"reach_duplo-{agent}",
            f"reach_duplo {preset} --agent {agent} --steps {REACH_STEPS}{noise}",
        )


def figures3and5() -> Iterator[tuple[str, str]]:
    """Yield MERL on reach_duplo with one change each; figure2 has MERL without a change."""
    changes = {
        "shared": "--agent.fusion shared",
        "shared-by-both": "--agent.fusion shared_by_both",
        "d64": "--agent.latent-dim 64",
        "d256": "--agent.latent-dim 256",
        "no-norm": "--agent.no-fusion-norm",
        "scheduled": "--agent.noise-std 1.0 --agent.noise-std-end 0.1 "
        f"--agent.noise-steps {REACH_STEPS // 2}",
        "mlp64": "--agent.encoders.proprio mlp --agent.mlp-dim 64",
        "mlp128": "--agent.encoders.proprio mlp --agent.mlp-dim 128",
        "mlp256": "--agent.encoders.proprio mlp --agent.mlp-dim 256",
    }
    for name, flags in changes.items():
        yield f"reach_duplo-merl-{name}", f"reach_duplo {LAPTOP} --steps {REACH_STEPS} {flags}"


def boxes() -> Iterator[tuple[str, str]]:
    """Yield MERL (six layers, camera and joints) on the box tasks; starts as in the paper."""
    for reward in ("staged", "paper"):
        for task in BOXES:
            yield (
                f"{task}-merl-{reward}",
                f"{task} {LAPTOP} --agent.head-layers 6 --reward {reward} --steps {BOX_STEPS}",
            )


def boxes_state() -> Iterator[tuple[str, str]]:
    """Yield the agents that observe the state on the box tasks, a million steps each."""
    for reward in ("staged", "paper"):
        for task in BOXES:
            for agent in STATE_AGENTS:
                layers = " --agent.head-layers 6" if agent == "merl_state" else ""
                yield (
                    f"{task}-{agent}-{reward}",
                    f"{task} {STATE} --agent {agent} --reward {reward} --steps {BOX_STEPS}{layers}",
                )


def boxes_mixed() -> Iterator[tuple[str, str]]:
    """Yield runs whose starts mix three or all stages; their evaluations start above the box."""
    for agent, preset in (("merl_state", STATE), ("merl", LAPTOP)):
        layers = 3 if agent == "merl_state" else 6
        for stages in ("above around holding carrying", "above around holding"):
            for task in BOXES:
                yield (
                    f"{task}-{agent}-{stages.split()[-1]}",
                    f"{task} {preset} --agent {agent} --reward staged --start {stages} "
                    f"--eval.start above --agent.head-layers {layers} --steps {BOX_STEPS}",
                )


GROUPS = {
    "figure2": figure2,
    "figures3and5": figures3and5,
    "boxes": boxes,
    "boxes_state": boxes_state,
    "boxes_mixed": boxes_mixed,
}


class Queue:
    """Missing runs, started in order; `stop` ends the active ones."""

    def __init__(self, runs: list[tuple[str, str]]) -> None:
        self._runs = [run for run in runs if not evaluation(run[0]).exists()]
        self._lock = threading.Lock()
        self._processes: list[subprocess.Popen[bytes]] = []
        self.stopping = False

    def work(self) -> None:
        """Train and evaluate runs, one after the other, until none is left."""
        while True:
            with self._lock:
                if self.stopping or not self._runs:
                    return
                name, arguments = self._runs.pop(0)
            if self._call(name, "train", *arguments.split(), "--resume"):
                copy(name)
                self._call(name, "evaluate", RUNS / name, "--episodes", "50")

    def stop(self) -> None:
        """Let all active runs save and end."""
        self.stopping = True
        for process in self._processes:
            process.terminate()

    def _call(self, name: str, command: str, *arguments: object) -> bool:
        """Run merl at the lowest priority; return whether it succeeded."""
        RUNS.mkdir(parents=True, exist_ok=True)
        given = [str(argument) for argument in arguments]
        if command == "train":
            given += ["--threads", "1", "--run-dir", str(RUNS / name), "--eval.video", "none"]
        else:
            given += ["--json", str(evaluation(name))]
        with (RUNS / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                ["nice", "-n", "19", sys.executable, "-m", "merl.cli", command, *given],
                cwd=ROOT,
                stdout=log,
                stderr=log,
            )
        with self._lock:
            self._processes.append(process)
            if self.stopping:
                process.terminate()
        while process.poll() is None:
            wait_for_end(process)
            copy(name)
        with self._lock:
            self._processes.remove(process)
        print(f"{name}: {command} ended with {process.returncode}", flush=True)
        return process.returncode == 0 and not self.stopping


def wait_for_end(process: subprocess.Popen[bytes]) -> None:
    """Wait until a process ends, for at most COPY_EVERY seconds."""
    try:
        process.wait(COPY_EVERY)
    except subprocess.TimeoutExpired:
        return


def evaluation(name: str) -> Path:
    """Return the file for the evaluation at the end of a run."""
    return DATA / f"{name}-evaluation.json"


def copy(name: str) -> None:
    """Copy the metrics of a run to the results."""
    metrics = RUNS / name / "metrics.csv"
    if metrics.exists():
        DATA.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(metrics, DATA / f"{name}.csv")


def steps(name: str) -> int:
    """Return the number of steps that a run has logged."""
    path = DATA / f"{name}.csv"
    if not path.exists():
        return 0
    with path.open() as file:
        return max((int(row["step"]) for row in csv.DictReader(file)), default=0)


def main() -> None:
    """Train the missing runs, or list all runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("groups", nargs="*", choices=[*GROUPS, []], help="default: all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--list", action="store_true", help="list the runs and their progress")
    options = parser.parse_args()
    runs = [
        (f"{name}-s{seed}", f"{arguments} --seed {seed}")
        for seed in options.seeds
        for group in options.groups or GROUPS
        for name, arguments in GROUPS[group]()
    ]
    if options.list:
        for name, arguments in runs:
            state = "done" if evaluation(name).exists() else f"{steps(name):,} steps"
            print(f"{name:40} {state:>16}  merl train {arguments}")
        return
    queue = Queue(runs)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: queue.stop())
    threads = [threading.Thread(target=queue.work) for _ in range(options.jobs)]
    for thread in threads:
        thread.start()
        time.sleep(1)
    while any(thread.is_alive() for thread in threads):
        time.sleep(0.5)  # Python handles signals here


if __name__ == "__main__":
    main()
