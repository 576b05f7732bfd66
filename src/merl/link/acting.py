"""An actor: it acts in an environment with the newest policy of a learner."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from merl.acting.rollout import Episode, FrameStack
from merl.acting.run_env import run_spaces, run_spec
from merl.agents import make_agent
from merl.config import TrainConfig
from merl.core import Observation, Transition
from merl.core.guards import check_finite
from merl.evaluation.realtime import Driven, Limits, drive
from merl.link import weights
from merl.link.connection import Connection
from merl.link.spool import Spool
from merl.link.timesteps import Layout, Timestep

_CPU = torch.device("cpu")
_POLL = 0.2
"""Seconds after which a wait for the learner asks whether to stop."""


class StopRequest(Protocol):
    """A request to stop."""

    def asked(self) -> bool:
        """Return whether to stop."""
        ...

    def at_once(self) -> AbstractContextManager[None]:
        """Let a signal raise in a call that may wait for long."""
        ...


@dataclass(frozen=True)
class Pace:
    """When an actor acts.

    Attributes:
        hz: steps per second; None: as fast as the learner learns.
        behind: largest number of timesteps that are not in the learner's replay yet at a step; with
            a rate, at the start of an episode, since a robot must not wait within one.
        random_steps: timesteps at the start with uniformly random actions.
    """

    hz: float | None = None
    behind: int = 100
    random_steps: int = 0


class Spooled(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose timesteps go into a spool.

    Args:
        env: the environment.
        stack: the last frames of each camera.
        layout: form of the timesteps.
        spool: gets each timestep.
        connection: is notified of it.

    Attributes:
        episode: sums of the episode in progress.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        stack: FrameStack,
        layout: Layout,
        spool: Spool,
        connection: Connection,
    ) -> None:
        super().__init__(env)
        self._stack, self._layout, self._spool = stack, layout, spool
        self._connection, self.episode = connection, Episode()

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        observation, info = self.env.reset(**options)
        check_finite(observation, 0.0, self._spool.last + 1)
        self.episode = Episode()
        self._write(self._stack.reset(observation), None)
        return observation, info

    def step(self, action: NDArray[np.float32]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action; see `gymnasium.Env.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        check_finite(observation, float(reward), self._spool.last + 1)
        self.episode.add(float(reward), info)
        stored, over = self._stack.push(observation), bool(terminated or truncated)
        step = Transition(action, float(reward), 0.0 if terminated else 1.0, stored, over)
        self._write(stored, step)
        return observation, reward, terminated, truncated, info

    def _write(self, stored: Observation, step: Transition | None) -> None:
        timestep = Timestep(self._spool.last + 1, stored, step, self.episode)
        self._spool.append(self._layout.pack(timestep))
        self._connection.notify()


class Actor:
    """Acts with exploration noise, in episodes that go to the learner.

    Args:
        config: the config of the run, for this machine.
        env: the environment of the run.
        spool: keeps the timesteps; it belongs to the run.
        layout: their form.
        connection: is open.
        pace: when to act.
        limits: limits of actions, steps and lateness.
        stop: the request to stop.

    Attributes:
        policy: the learner's updates at which the policy was sent.
    """

    def __init__(
        self,
        config: TrainConfig,
        env: gymnasium.Env[Any, Any],
        spool: Spool,
        layout: Layout,
        connection: Connection,
        pace: Pace,
        limits: Limits,
        stop: StopRequest,
    ) -> None:
        # After a restart, neither the noise nor the starts of the episodes repeat.
        seeds = np.random.SeedSequence((config.seed, connection.place or 0, spool.last))
        words = [int(word) for word in seeds.generate_state(3)]
        spec = run_spec(config, env)
        self._stack = FrameStack(spec.modalities, config.replay.frame_stack, _CPU)
        self._env = Spooled(env, self._stack, layout, spool, connection)
        self._agent = make_agent(
            config.agent_name,
            config.agent,
            *run_spaces(config, env),
            frame_stack=config.replay.frame_stack,
            seed=words[0],
            device=_CPU,
            threads=1,
        )
        self._random, self._seed = np.random.default_rng(words[1]), words[2] % 2**31
        self._spool, self._connection, self._pace = spool, connection, pace
        self._limits, self._stop = limits, stop
        self._loaded = False
        self.policy = 0
        self._stack.reset(spec.space.sample())
        self._agent.act(self._stack.observation(), explore=True, step=0)  # the first takes longer

    def episodes(self) -> Iterator[tuple[Episode, Driven]]:
        """Act; yield after each episode, until the run is done or a stop.

        Raises:
            MerlError: the environment failed, the spool cannot be written, or the learner refuses.
        """
        seed: int | None = self._seed
        rate = math.inf if self._pace.hz is None else self._pace.hz
        while self._wait(self._pace.behind):
            with self._stop.at_once():  # it may wait for a person
                observation, _ = self._env.reset(seed=seed)
            seed = None
            driven = drive(self._act, self._env, observation, rate, self._limits, self._ends)
            yield self._env.episode, driven
            if driven.end in ("stopped", "late"):
                return

    def _act(self, _: Observation) -> NDArray[np.float32]:
        """Return the action for the newest frames."""
        if self._pace.hz is None:
            self._wait(self._pace.behind)
        self._load()
        if self._spool.last <= self._pace.random_steps:
            size = self._env.action_space.shape
            return self._random.uniform(-1.0, 1.0, size).astype(np.float32)
        step = self._connection.step
        action = self._agent.act(self._stack.observation(), explore=True, step=step)[0]
        result: NDArray[np.float32] = action.float().numpy()
        return result

    def _ends(self) -> bool:
        self._connection.check()
        return self._connection.done or self._stop.asked()

    def _wait(self, behind: int) -> bool:
        """Wait for weights, and until the learner is near; return False if it is time to stop."""
        while not self._ends():
            self._load()
            near = self._connection.wait(behind, _POLL)
            if near and self._loaded:
                return not self._ends()
            if near:  # the first weights are on their way
                time.sleep(_POLL)
        return False

    def _load(self) -> None:
        """Load the newest weights, if there are any."""
        newest = self._connection.take_weights()
        if newest is not None:
            header, data = newest
            weights.load(self._agent, header["weights"], data)
            self._loaded, self.policy = True, int(header["updates"])
