"""Small environments that misbehave in a run; tests set the behaviour in `unruly`."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from merl.evaluation.evaluation import EVALUATION_SEED

DEFAULT: dict[str, Any] = {
    "length": 10,  # steps of an episode
    "in_evaluation": None,  # called at each step of an evaluation
    "in_training": None,  # called at each step of training
    "draw": lambda env: env.np_random.normal(),
    "on_reset": lambda env, seed: None,
    "metadata": {"render_modes": ["rgb_array"], "render_fps": 25},
    "frame": lambda env: np.zeros((32, 32, 3), np.uint8),
}
unruly = SimpleNamespace(**DEFAULT)


class Unruly(gymnasium.Env[Any, Any]):
    """An observation of three equal random numbers; the reward is the first one."""

    def __init__(self, render_mode: str | None = None) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.metadata = unruly.metadata
        self.render_mode = render_mode
        self.evaluated = False
        self.starts: list[float] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if seed is not None:
            self.evaluated = EVALUATION_SEED <= seed < EVALUATION_SEED + 1000
        unruly.on_reset(self, seed)
        self.taken = 0
        seen = self.see()
        self.starts.append(float(seen[0]))
        return seen, {}

    def step(self, action: Any) -> Any:
        self.taken += 1
        act = unruly.in_evaluation if self.evaluated else unruly.in_training
        seen = self.see()
        if act is not None:
            seen = act(self, seen)
        return seen, float(seen[0]), False, self.taken >= unruly.length, {}

    def see(self) -> Any:
        return np.full(3, unruly.draw(self), np.float32)

    def render(self) -> Any:
        return unruly.frame(self)


def make(render_mode: str | None = None) -> Unruly:
    made.append(Unruly(render_mode))
    return made[-1]


made: list[Unruly] = []


def one() -> Unruly:
    """Return the same object every time, like a single physical device."""
    if not made:
        made.append(Unruly())
    return made[0]


def wanders() -> Unruly:
    os.chdir("/")
    return make()


class Unclosable(Unruly):
    """Its `close` never returns."""

    def close(self) -> None:
        time.sleep(1000)


def unclosable() -> Unclosable:
    return Unclosable()


def starts_a_thread() -> Unruly:
    """Start a thread that never ends."""
    threading.Thread(target=time.sleep, args=(1000,), name="camera").start()
    return Unruly()


# Values of `draw`.


def from_numpy(env: Unruly) -> float:
    return float(np.random.normal())  # noqa: NPY002


def from_python(env: Unruly) -> float:
    return random.gauss(0.0, 1.0)


def from_own_generator(env: Unruly) -> float:
    return float(env.rng.normal())  # type: ignore[attr-defined]


# Values of `in_training` and `in_evaluation`.


def fail(env: Unruly, seen: Any) -> Any:
    raise OSError("the camera is gone")


def run_out_of_memory(env: Unruly, seen: Any) -> Any:
    raise MemoryError


def give_nan(env: Unruly, seen: Any) -> Any:
    return np.full(3, np.nan, np.float32)


def interrupted(number: int, error: BaseException) -> Any:
    """Send a signal at the fifth step after the third or a later reset, then raise `error`."""

    def act(env: Unruly, seen: Any) -> Any:
        if len(env.starts) > 2 and env.taken == 5:
            os.kill(os.getpid(), number)
            raise error
        return seen

    return act


def takes_over_signals(env: Unruly, seen: Any) -> Any:
    """Install a handler at every step, and send Ctrl-C while it is installed."""
    signal.signal(signal.SIGINT, lambda *_: None)
    if len(env.starts) > 2 and env.taken == 5:
        os.kill(os.getpid(), signal.SIGINT)
    return seen
