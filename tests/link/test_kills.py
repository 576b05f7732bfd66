"""Learner and actors that are killed at random: every timestep arrives exactly once, in order."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest

from helpers import wait_for
from merl.link.timesteps import Layout
from merl.replay import ReplayBuffer, ReplaySpec
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.training.loop import updates_due
from two_sides import Sides

STEPS = ("--steps", "1000000", "--replay.capacity", "200000")


@pytest.fixture
def started() -> Iterator[list[BaseProcess]]:
    """Processes that are killed at the end of the test."""
    processes: list[BaseProcess] = []
    yield processes
    for process in processes:
        process.kill()


def spooled(run: Run, folder: Path) -> dict[int, float]:
    """Return the count of each timestep that is intact in a spool, by the timestep's number."""
    layout, found = Layout(*run.spaces()), {}
    for file in folder.glob("*.steps"):
        data = file.read_bytes()
        for at in range(0, len(data), layout.size):
            part = data[at : at + layout.size]
            if (number := layout.number(part)) is not None:
                found[number] = float(layout.unpack(part).observation["joint"][0])
    return found


def stored(run: Run, rings: int) -> tuple[list[np.ndarray], list[np.ndarray], dict[str, int]]:
    """Return counts and positions of all timesteps of each ring at the last checkpoint."""
    config = run.config
    spec = ReplaySpec.of(config.replay, *run.spaces(), capacity=config.capacity, rings=rings)
    buffer = ReplayBuffer(spec, run.replay)
    state = Checkpoint.find(run.checkpoints).state()
    buffer.load_state_dict(state["replay"])
    counts, positions = [], []
    for number, ring in enumerate(buffer.rings):
        slots = number * buffer.slots + np.arange(ring.timesteps)
        assert ring.timesteps < buffer.slots, "the ring has overwritten its first timesteps"
        assert list(buffer.arrays["timestep"][slots]) == list(range(1, ring.timesteps + 1))
        counts.append(np.array(buffer.arrays["observation.joint"][slots, 0]))
        positions.append(np.array(buffer.arrays["position"][slots]))
        rewards = np.where(positions[-1] > 0, counts[-1], 0)
        assert (buffer.arrays["reward"][slots] == rewards).all()
        assert sum(positions[-1] > 0) == ring.steps
    return counts, positions, state["progress"]


def check_sequence(counts: np.ndarray, positions: np.ndarray, log: Path, kills: int) -> None:
    """Check that a ring has all that an actor's environment did, but for a step at each kill."""
    assert counts[0] == 1
    assert log.stat().st_size - counts[-1] in (0, 1)
    gaps = np.diff(counts)
    assert (gaps >= 1).all()
    assert (gaps <= 2).all()
    assert (gaps > 1).sum() <= kills
    assert (positions[1:][gaps > 1] == 0).all()  # after the kill, an episode begins


@pytest.mark.parametrize(
    ("seed", "kills", "actors"),
    [(0, 10, 1), pytest.param(1, 40, 2, marks=pytest.mark.long)],
)
def test_killed_sides_lose_and_repeat_nothing(
    seed: int, kills: int, actors: int, tmp_path: Path, started: list[BaseProcess]
) -> None:
    rng = random.Random(seed)
    sides = Sides(tmp_path, *STEPS, "--num-envs", str(actors))
    names = [f"actor{index}" for index in range(actors)]

    def start(name: str) -> BaseProcess:
        process = sides.learner() if name == "learner" else sides.actor(name)
        started.append(process)
        return process

    running = {"learner": start("learner")}
    wait_for(lambda: "waiting" in sides.output("learner"))
    running |= {name: start(name) for name in names}
    seen: dict[str, dict[int, float]] = {name: {} for name in names}
    left = dict.fromkeys(("learner", *names), kills)
    wait_for(lambda: list(sides.run.glob("checkpoints/0*")))
    run = Run.open(sides.run)
    while any(left.values()):
        time.sleep(rng.uniform(0.05, 1.2))
        for name, process in running.items():
            # An actor ends by itself if no learner is there when it starts.
            if not process.is_alive() and rng.random() < 0.7:  # else it stays away for a while
                running[name] = start(name)
        name = rng.choice([name for name, count in left.items() if count])
        if running[name].is_alive():
            os.kill(running[name].pid or 0, signal.SIGKILL)
            running[name].join()
            left[name] -= 1
            if name != "learner":
                for number, count in spooled(run, tmp_path / name / "spool").items():
                    assert seen[name].setdefault(number, count) == count
    for name in ("learner", *names):  # an actor ends by itself if the learner is not there yet
        while time.sleep(2) or not running[name].is_alive():
            running[name] = start(name)
    end(sides, running, names)
    run = Run.open(sides.run)
    counts, positions, progress = stored(run, actors)
    for ring in range(actors):
        owner = next(name for name in names if fits(seen[name], counts[ring]))
        names.remove(owner)
        check_sequence(counts[ring], positions[ring], tmp_path / owner / "count", kills)
    assert progress["step"] == sum((p > 0).sum() for p in positions)
    due = updates_due(progress["step"] - run.config.seed_steps, run.config.updates_per_step)
    assert due - 1 <= progress["updates"] <= due  # the signal may come before the last one


def fits(seen: dict[int, float], counts: np.ndarray) -> bool:
    """Return whether a ring holds all timesteps that were in a spool when its actor was killed."""
    return all(number <= len(counts) and counts[number - 1] == c for number, c in seen.items())


def end(sides: Sides, running: dict[str, BaseProcess], names: list[str]) -> None:
    """Stop the actors, which send what is left, and then the learner, which saves it."""
    time.sleep(3)
    for name in (*names, "learner"):
        os.kill(running[name].pid or 0, signal.SIGTERM)
        running[name].join(60)
        assert running[name].exitcode == 128 + signal.SIGTERM, sides.output(name)
