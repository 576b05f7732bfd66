"""Run a policy in real time: a fixed rate, limits of the actions, a deadline for every step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError, Observation
from merl.core.guards import check_finite
from merl.evaluation.evaluation import Act

End = Literal["terminated", "truncated", "stopped", "time", "late"]


@dataclass(frozen=True)
class Limits:
    """Limits of a run on a robot.

    Attributes:
        action: largest absolute value of an action's numbers, in (0, 1].
        change: largest change of an action's number from step to step; the first action counts from
            zero. None: no limit.
        steps: steps of an episode; None: until the environment ends it.
        late: number of consecutive steps that miss their deadline, after which the run ends.
    """

    action: float = 1.0
    change: float | None = None
    steps: int | None = None
    late: int = 25

    def apply(self, action: NDArray[np.float32], last: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action within the limits, after the action `last`."""
        limited = np.clip(action, -self.action, self.action)
        if self.change is not None:
            limited = np.clip(limited, last - self.change, last + self.change)
        return limited.astype(np.float32)


@dataclass
class Timing:
    """Times of the steps of an episode.

    Attributes:
        policy: time of the policy in each step, s.
        env: time of the environment's step, s.
        lateness: time by which each step ended after its deadline, s; 0 if it was in time.
    """

    policy: list[float] = field(default_factory=list)
    env: list[float] = field(default_factory=list)
    lateness: list[float] = field(default_factory=list)

    @property
    def late(self) -> int:
        """Return the number of steps that missed their deadline."""
        return sum(seconds > 0 for seconds in self.lateness)


@dataclass(frozen=True)
class Driven:
    """How an episode in real time went.

    Attributes:
        timing: times of the steps.
        end: why it ended.
    """

    timing: Timing
    end: End


def drive(
    act: Act,
    env: gymnasium.Env[Any, Any],
    observation: Observation,
    rate: float,
    limits: Limits,
    stop: Callable[[], bool],
    *,
    record: Callable[..., None] = lambda *step: None,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], float] = time.perf_counter,
) -> Driven:
    """Run one episode after the environment's reset, a step every 1 / `rate` seconds.

    A step begins at its time and must end before the next one begins. After a step that is late,
    the next one begins at once and the schedule starts anew: steps are never made up for.

    Args:
        act: maps an observation to an action in [-1, 1].
        env: the environment, whose step may return before the robot has moved.
        observation: the observation after the reset.
        rate: steps per second.
        limits: limits of actions, steps and lateness.
        stop: whether to stop, asked before every action.
        record: gets every step, as `merl.demos.episode.EpisodeRecording.add`.
        sleep: waits, s.
        clock: returns the time, s.

    Raises:
        MerlError: the environment failed, or a value is not finite.
    """
    timing = Timing()
    last = np.zeros(env.action_space.shape or (), np.float32)
    period, end = 1.0 / rate, cast("End | None", None)
    begin, behind = clock(), 0
    while end is None:
        wait = begin - clock()
        if wait > 0:
            sleep(wait)
        if stop():
            end = "stopped"
            break
        started = clock()
        action = np.asarray(act(observation), np.float32).clip(-1.0, 1.0)
        thought = clock()
        last = limits.apply(action, last)
        observation, reward, terminated, truncated, info = env.step(last)
        check_finite(observation, float(reward), len(timing.env) + 1)
        record(last, action, observation, float(reward), info)
        ended = clock()
        timing.policy.append(thought - started)
        timing.env.append(ended - thought)
        late = max(0.0, ended - (begin + period))
        timing.lateness.append(late)
        behind = behind + 1 if late else 0
        begin = ended if late else begin + period
        if terminated or truncated:
            end = "terminated" if terminated else "truncated"
        elif limits.steps is not None and len(timing.env) >= limits.steps:
            end = "time"
        elif behind >= limits.late:
            end = "late"
    return Driven(timing, end)


def check_rate(rate: float | None) -> float:
    """Return the rate of a run.

    Raises:
        MerlError: it is not known.
    """
    if rate is None:
        raise MerlError("the environment's metadata has no render_fps: give the rate with --hz")
    return rate
