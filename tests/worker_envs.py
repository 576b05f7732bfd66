"""Environments that misbehave in processes of their own, told how by environment variables."""

from __future__ import annotations

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
WORK = 0.02
"""Seconds that a step of `Slow` takes."""


class Plain(gymnasium.Env[Any, Any]):
    """A number per dimension, drawn by its own generator; the reward is the first one."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.taken = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken += 1
        seen = self._seen()
        info = {"success": seen[0] > 0, "reward_terms": {"first": float(seen[0])}, "else": object()}
        return seen, float(seen[0]), False, self.taken == EPISODE, info

    def _seen(self) -> Any:
        return self.np_random.normal(size=3).astype(np.float32)


class Misbehaving(Plain):
    """In a process of its own, at its 25th step: does `what`, as often as `TIMES` says."""

    def __init__(self, what: str) -> None:
        self.what, self.all = what, 0

    def step(self, action: Any) -> Any:
        self.all += 1
        if self.all == 25 and multiprocessing.parent_process() is not None and self._is_my_turn():
            if self.what == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.what == "stops":
                os.kill(os.getpid(), signal.SIGSTOP)
            time.sleep(1000)
        return super().step(action)

    def _is_my_turn(self) -> bool:
        folder = Path(os.environ["TURNS"])
        for turn in range(int(os.environ["TIMES"])):
            try:
                (folder / str(turn)).touch(exist_ok=False)
            except FileExistsError:
                continue
            return True
        return False


class Slow(Plain):
    """Each step takes a while, without the processor."""

    def step(self, action: Any) -> Any:
        time.sleep(WORK)
        return super().step(action)


class Beside(Plain):
    """In a process of its own, a late step ends only once the learner learns beside it."""

    def __init__(self) -> None:
        self.all = 0

    def step(self, action: Any) -> Any:
        self.all += 1
        if self.all >= 25 and multiprocessing.parent_process() is not None:
            deadline = time.monotonic() + 60
            while not (Path(os.environ["TURNS"]) / f"learns-{self.all}").exists():
                if time.monotonic() > deadline:
                    raise TimeoutError("nothing was learnt during this step")
                time.sleep(0.001)
        return super().step(action)


class Failing(Plain):
    """Fails with an exception that another process cannot be told."""

    def step(self, action: Any) -> Any:
        class LocalError(Exception):
            pass

        if multiprocessing.parent_process() is not None:
            raise LocalError("the gripper is gone")
        return super().step(action)


class Broken(Plain):
    """The second one's reward is no number at its 25th step."""

    def __init__(self) -> None:
        self.all, self.is_second = 0, multiprocessing.current_process().name.endswith("-1")

    def step(self, action: Any) -> Any:
        self.all += 1
        seen, reward, *rest = super().step(action)
        return (seen, np.nan if self.is_second and self.all == 25 else reward, *rest)


def broken() -> Plain:
    return Broken()


class Stillborn(Plain):
    """Dies at its first reset, if it has a process of its own."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().reset(seed=seed)


def stillborn() -> Plain:
    return Stillborn()


class Uneven(Plain):
    """What it tells changes in kind from step to step: a term is a whole number at times."""

    def step(self, action: Any) -> Any:
        seen, reward, terminated, truncated, _ = super().step(action)
        reward = max(reward, 0.0)
        info = {"reward_terms": {"first": reward if reward else 0}}
        return seen, reward, terminated, truncated, info


def uneven() -> Plain:
    return Uneven()


class NeverReady(Plain):
    """Cannot be made in a process of its own: whoever waits for it waits."""

    def __init__(self) -> None:
        if multiprocessing.parent_process() is not None:
            (Path(os.environ["TURNS"]) / "waits").touch()
            time.sleep(1000)


class OfItsOwn(Plain):
    """Leaves Gymnasium's generator alone."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.generator = np.random.default_rng(seed)
        self.taken = 0
        return self._seen(), {}

    def _seen(self) -> Any:
        return self.generator.normal(size=3).astype(np.float32)


def never_ready() -> Plain:
    return NeverReady()


def of_its_own() -> Plain:
    return OfItsOwn()


def fails() -> Plain:
    return Failing()


def plain() -> Plain:
    return Plain()


def slow() -> Plain:
    return Slow()


def beside() -> Plain:
    return Beside()


def dies() -> Plain:
    return Misbehaving("dies")


def hangs() -> Plain:
    return Misbehaving("hangs")


def stops() -> Plain:
    return Misbehaving("stops")
