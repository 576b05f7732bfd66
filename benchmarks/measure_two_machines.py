"""Measure `merl learner` and `merl actor` on this machine: throughput, and both delays.

    python benchmarks/measure_two_machines.py --actors 2
    python benchmarks/measure_two_machines.py --actors 2 --hz 25 --updates 1

The environment does nothing. Its observation is that of an arm with two cameras: two images
of 84 x 84 pixels and 24 numbers, 42 KB. The time of each step is one of these numbers, so that the
learner knows how long the step took to its replay; both sides note when a policy left and came.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
from gymnasium import spaces

import merl
from merl.callbacks import Callback
from merl.cli import main
from merl.config import override
from merl.link import weights
from merl.link.acting import Actor
from merl.training.loop import StepResult
from merl.training.trainer import Trainer

WRAP = 100.0
"""Times are sent modulo this, s: as float32 they are precise to 8 microseconds."""
ADDRESS = "127.0.0.1:7117"
POLICIES = "POLICIES"
"""Environment variable of an actor: the file for the times at which policies came."""


class TwoCameras(gymnasium.Env[Any, Any]):
    """An environment with the observations of an arm, in which nothing happens."""

    def __init__(self) -> None:
        image = spaces.Box(0, 255, (84, 84, 3), np.uint8)
        joints = spaces.Box(-np.inf, np.inf, (24,), np.float32)
        self.observation_space = spaces.Dict({"front": image, "wrist": image, "joints": joints})
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self._image = np.random.default_rng(0).integers(0, 256, (84, 84, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode of 250 steps."""
        super().reset(seed=seed)
        self._steps = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Do nothing."""
        self._steps += 1
        return self._observe(), 0.0, False, self._steps == 250, {}

    def _observe(self) -> dict[str, Any]:
        joints = np.zeros(24, np.float32)
        joints[0] = time.time() % WRAP
        return {"front": self._image, "wrist": self._image, "joints": joints}


class Arrivals(Callback):
    """Times of the steps that arrived in the replay."""

    def __init__(self, warm_up: int) -> None:
        self.delays: list[float] = []
        self.times: list[float] = []
        self._warm_up, self._seen = warm_up, 0

    def on_start(self, trainer: Trainer) -> None:
        """Keep the replay."""
        self._replay = trainer.replay

    def on_step(self, result: StepResult) -> None:
        """Note the newest step of each ring."""
        if result.step == self._seen:
            return
        self._seen, now = result.step, time.time()
        if result.step < self._warm_up:
            return
        self.times.append(now)
        slots, joints = self._replay.slots, self._replay.arrays["observation.joints"]
        sent = [
            float(joints[index * slots + (ring.timesteps - 1) % slots, 0])
            for index, ring in enumerate(self._replay.rings)
        ]
        self.delays.append(min((now - each) % WRAP for each in sent))


def act() -> int:
    """Run `merl actor`, and note when policies came."""
    load, came = Actor._load, {}

    def noting(actor: Actor) -> None:
        before = actor.policy
        load(actor)
        if actor.policy != before:
            came[actor.policy] = time.time()

    with patch.object(Actor, "_load", noting):
        code = main(sys.argv[2:])
    Path(os.environ[POLICIES]).write_text(json.dumps(came))
    return code


def start_actor(index: int, hz: float | None, folder: Path) -> subprocess.Popen[bytes]:
    """Start an actor that waits until the learner listens."""
    command = [sys.executable, __file__, "--act", "actor", "--connect", ADDRESS]
    command += [
        "--env",
        "measure_two_machines:TwoCameras",
        "--spool",
        str(folder / f"spool{index}"),
    ]
    command += [] if hz is None else ["--hz", str(hz)]
    until = f"until {' '.join(command)}; do sleep 1; done"
    env = os.environ | {POLICIES: str(folder / f"policies{index}.json")}
    return subprocess.Popen(["sh", "-c", until], cwd=Path(__file__).parent, env=env)


def measure(actors: int, hz: float | None, updates: float, steps: int, folder: Path) -> None:
    """Train for some steps with actors in processes of their own, and print the figures."""
    left: dict[int, float] = {}
    pack = weights.pack

    def noting(agent: Any) -> Any:
        result = pack(agent)
        left[trainer.progress.updates] = time.time()
        return result

    arrivals = Arrivals(steps // 10)
    config = merl.TrainConfig("measure_two_machines:TwoCameras", steps=steps, random_steps=0)
    values = {"seed_steps": 100, "updates_per_step": updates, "num_envs": actors, "device": "cpu"}
    values |= {"run_dir": folder / "run", "eval.every": 0, "actors.listen": ADDRESS}
    values |= {"replay.batch_size": 8, "threads": 1, "agent.torch_compile": "no"}
    processes = [start_actor(index, hz, folder) for index in range(actors)]
    with (
        patch.object(weights, "pack", noting),
        Trainer(override(config, values), [arrivals]) as trainer,
    ):
        trainer.fit()
    for process in processes:
        process.wait()
    seconds = arrivals.times[-1] - arrivals.times[0]
    print(f"{actors} actors, {hz or 'no'} Hz, {updates} updates per step:")
    print(f"  {(len(arrivals.times) - 1) / seconds:.0f} steps per second")
    show("step to replay", arrivals.delays)
    came = [
        at - left[int(number)]
        for file in folder.glob("policies*.json")
        for number, at in json.loads(file.read_text()).items()
    ]
    if came:
        show("update to actor", came)


def show(name: str, values: list[float]) -> None:
    """Print median and 99th percentile, in milliseconds."""
    middle, late = 1000 * np.percentile(values, [50, 99])
    print(f"  {name}: median {middle:.1f} ms, 99 % within {late:.1f} ms ({len(values)} values)")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--act"]:
        sys.exit(act())
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actors", type=int, default=1)
    parser.add_argument("--hz", type=float)
    parser.add_argument("--updates", type=float, default=0.0)
    parser.add_argument("--steps", type=int, default=3000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        measure(options.actors, options.hz, options.updates, options.steps, Path(name))
