"""Environments that misbehave in worker processes; environment variables control how."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

EPISODE = 10
"""Steps of an episode."""
WORK = 0.02
"""Seconds that a step of `Slow` takes."""


def hang_in_c() -> None:
    """Wait for ever, with the GIL and whatever signals arrive: lock a mutex twice."""
    mutex = ctypes.create_string_buffer(64)
    for _ in range(2):
        ctypes.PyDLL(None).pthread_mutex_lock(mutex)


class Plain(gymnasium.Env[Any, Any]):
    """Three random numbers from Gymnasium's generator; the reward is the first one."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.taken = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken += 1
        observation = self._observation()
        info = {
            "success": observation[0] > 0,
            "reward_terms": {"first": float(observation[0])},
            "else": object(),
        }
        return observation, float(observation[0]), False, self.taken == EPISODE, info

    def _observation(self) -> Any:
        return self.np_random.normal(size=3).astype(np.float32)


class Misbehaving(Plain):
    """In a worker process: dies, stops or hangs at the 25th step, `TIMES` times in total."""

    def __init__(self, what: str) -> None:
        self.what, self.steps = what, 0

    def step(self, action: Any) -> Any:
        self.steps += 1
        if (
            self.steps == 25
            and multiprocessing.parent_process() is not None
            and self._takes_a_turn()
        ):
            if self.what == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.what == "hangs in C":
                hang_in_c()
            if self.what == "stops":
                os.kill(os.getpid(), signal.SIGSTOP)
            time.sleep(1000)
        return super().step(action)

    def _takes_a_turn(self) -> bool:
        folder = Path(os.environ["TURNS"])
        for turn in range(int(os.environ["TIMES"])):
            try:
                (folder / str(turn)).touch(exist_ok=False)
            except FileExistsError:
                continue
            return True
        return False


class Slow(Plain):
    """Each step sleeps for `WORK` seconds."""

    def step(self, action: Any) -> Any:
        time.sleep(WORK)
        return super().step(action)


class WaitsForUpdate(Plain):
    """In a worker process: from the 25th step on, each step waits for an update to start."""

    def __init__(self) -> None:
        self.steps = 0

    def step(self, action: Any) -> Any:
        self.steps += 1
        if self.steps >= 25 and multiprocessing.parent_process() is not None:
            deadline = time.monotonic() + 60
            while not (Path(os.environ["TURNS"]) / f"learns-{self.steps}").exists():
                if time.monotonic() > deadline:
                    raise TimeoutError("no update started during this step")
                time.sleep(0.001)
        return super().step(action)


class Failing(Plain):
    """In a worker process: fails with an exception that cannot be pickled."""

    def step(self, action: Any) -> Any:
        class LocalError(Exception):
            pass

        if multiprocessing.parent_process() is not None:
            raise LocalError("the gripper is gone")
        return super().step(action)


class NaNReward(Plain):
    """In the second worker, the reward is NaN at the 25th step."""

    def __init__(self) -> None:
        self.steps, self.is_second = 0, multiprocessing.current_process().name.endswith("-1")

    def step(self, action: Any) -> Any:
        self.steps += 1
        observation, reward, *rest = super().step(action)
        return (observation, np.nan if self.is_second and self.steps == 25 else reward, *rest)


def nan_reward() -> Plain:
    return NaNReward()


class DiesAtReset(Plain):
    """In a worker process: dies at the first reset."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().reset(seed=seed)


def dies_at_reset() -> Plain:
    return DiesAtReset()


class MixedTypes(Plain):
    """The type of its reward term changes between steps: float, or the integer 0."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, _ = super().step(action)
        reward = max(reward, 0.0)
        info = {"reward_terms": {"first": reward if reward else 0}}
        return observation, reward, terminated, truncated, info


def mixed_types() -> Plain:
    return MixedTypes()


class NeverReady(Plain):
    """In a worker process: its constructor does not return."""

    def __init__(self) -> None:
        if multiprocessing.parent_process() is not None:
            (Path(os.environ["TURNS"]) / "waits").touch()
            time.sleep(1000)


class OwnGenerator(Plain):
    """Uses its own random generator instead of Gymnasium's."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.generator = np.random.default_rng(seed)
        self.taken = 0
        return self._observation(), {}

    def _observation(self) -> Any:
        return self.generator.normal(size=3).astype(np.float32)


def never_ready() -> Plain:
    return NeverReady()


def own_generator() -> Plain:
    return OwnGenerator()


def fails() -> Plain:
    return Failing()


def plain() -> Plain:
    return Plain()


def slow() -> Plain:
    return Slow()


def waits_for_update() -> Plain:
    return WaitsForUpdate()


def dies() -> Plain:
    return Misbehaving("dies")


def hangs() -> Plain:
    return Misbehaving("hangs")


def hangs_in_c() -> Plain:
    return Misbehaving("hangs in C")


def stops() -> Plain:
    return Misbehaving("stops")
