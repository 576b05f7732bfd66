"""Check that two commits learn the same weights, bit for bit.

    python benchmarks/compare_weights.py BEFORE [AFTER] [--presets laptop state] [--agents merl sac]

Train every agent for a few updates with every preset, once with the code of commit BEFORE and once
with that of AFTER (default: the working tree), and compare all tensors of their last checkpoints.
The exit code is 1 if any tensor differs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

import torch
from safetensors.torch import load_file

ROOT = Path(__file__).resolve().parent.parent
PRESETS = ("paper", "laptop", "state", "smoke")
AGENTS = ("merl", "drqv2", "ddpg", "sac")
SHORT = (
    "--steps 320 --random-steps 260 --seed-steps 260 --updates-per-step 0.2 --replay.batch-size 16 "
    "--num-envs 1 --synchronous --threads 1 --agent.precision fp32 --agent.torch-compile no "
    "--eval.every 1000 --eval.episodes 1 --eval.video none"
)
"""Flags for 12 updates, after the end of the first episode."""


def main() -> int:
    """Compare the weights; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", help="a commit")
    parser.add_argument("after", nargs="?", help="a commit (default: the working tree)")
    parser.add_argument("--task", default="lift_box")
    parser.add_argument("--presets", nargs="+", default=PRESETS, choices=PRESETS)
    parser.add_argument("--agents", nargs="+", default=AGENTS, choices=AGENTS)
    options = parser.parse_args()
    differing = 0
    with tempfile.TemporaryDirectory() as folder:
        trees = [
            tree(commit, Path(folder) / name)
            for name, commit in vars(options).items()
            if name in ("before", "after")
        ]
        for preset, agent in product(options.presets, options.agents):
            name = f"{preset}-{agent}"
            runs = [Path(folder) / f"{side}-{name}" for side in ("before", "after")]
            for source, run in zip(trees, runs, strict=True):
                train(source, [options.task, "--preset", preset, "--agent", agent], run)
            found = differences(*runs)
            differing += bool(found)
            print(f"{name:16} {'the same' if not found else f'DIFFERS in {found}'}", flush=True)
    return int(differing > 0)


def tree(commit: str | None, folder: Path) -> Path:
    """Return the repository at a commit, extracted into a folder; None: the working tree."""
    if commit is None:
        return ROOT
    folder.mkdir()
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "x"], cwd=folder, input=archive.stdout, check=True)
    return folder


def train(source: Path, arguments: list[str], run: Path) -> None:
    """Train with the code of the tree `source`; write the run to the folder `run`."""
    command = [sys.executable, "-m", "merl.cli", "train", *arguments, *SHORT.split()]
    env = os.environ | {"PYTHONPATH": str(source / "src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--run-dir", str(run)], cwd=run.parent, env=env, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\nfailed with {done.returncode}:\n{done.stderr}")


def differences(before: Path, after: Path) -> list[str]:
    """Return the names of the tensors that differ between the last checkpoints of two runs."""
    one, two = (
        load_file(max(run.glob("checkpoints/*")) / "weights.safetensors") for run in (before, after)
    )
    shared = one.keys() & two.keys()
    return sorted(
        (one.keys() ^ two.keys()) | {k for k in shared if not torch.equal(one[k], two[k])}
    )


if __name__ == "__main__":
    sys.exit(main())
