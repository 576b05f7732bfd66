"""The loop of Algorithm 1: act, remember, learn.

It is a generator that yields after every environment step, so that logging, evaluation and
checkpoints stay outside, and the same loop serves every agent and every environment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from merl.core import Agent, Transition
from merl.replay import Replay
from merl.training.config import TrainConfig
from merl.training.guards import check_moment
from merl.training.rollout import Episode, FrameStack


@dataclass
class Progress:
    """Where a run stands."""

    step: int = 0
    updates: int = 0
    episodes: int = 0
    evaluated: int = 0  # the step of the last evaluation


@dataclass(frozen=True)
class Moment:
    """What the loop tells after an environment step.

    Attributes:
        step: environment steps so far.
        updates: updates so far.
        learning: metrics of the updates at this step, scalars on the device; empty without one.
        episode: the episode's sum, at its last step.
    """

    step: int
    updates: int
    learning: dict[str, Tensor] = field(default_factory=dict)
    episode: Episode | None = None


class Randomness:
    """One seed, split by purpose: no use of one stream moves another.

    Attributes:
        environment: the seed of the first reset; the environment goes on from there by itself.
        agent: the seed of initialisation, noise and shifts.
        actions: the uniformly random actions of the start.
        batches: what is sampled from replay.
    """

    def __init__(self, seed: int) -> None:
        words = np.random.SeedSequence(seed).generate_state(4)
        self.environment, self.agent = int(words[0]), int(words[1])
        self.actions, self.batches = (np.random.default_rng(int(word)) for word in words[2:])

    def state_dict(self) -> dict[str, Any]:
        """The generators' states, as plain types."""
        return {
            "actions": self.actions.bit_generator.state,
            "batches": self.batches.bit_generator.state,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take back what `state_dict` gave."""
        self.actions.bit_generator.state = state["actions"]
        self.batches.bit_generator.state = state["batches"]


def train(
    env: gymnasium.Env[Any, Any],
    agent: Agent,
    replay: Replay,
    stack: FrameStack,
    progress: Progress,
    randomness: Randomness,
    config: TrainConfig,
) -> Iterator[Moment]:
    """Act and learn until `config.steps`; yields after each environment step.

    Args:
        env: acts in [-1, 1], observes a `Dict`; reset with a seed by the caller's doing if the run
            goes on from a checkpoint, by this loop if it begins.
        agent: acts and learns.
        replay: takes in every step.
        stack: of the agent's frames.
        progress: moved on as the run goes.
        randomness: the run's random streams.
        config: steps, seed steps, random steps, updates per step, batch size.

    Raises:
        NotFinite: an observation or a reward is no number; the replay does not take it in.
    """
    shape = env.action_space.shape
    assert shape is not None
    while progress.step < config.steps:
        seed = randomness.environment if progress.episodes == 0 else None
        observation, _ = env.reset(seed=seed)
        check_moment(observation, 0.0, progress.step)
        replay.begin(observation)
        stack.reset(observation)
        episode, over = Episode(), False
        while not over and progress.step < config.steps:
            agent.step = progress.step
            if progress.step < config.random_steps:
                action = randomness.actions.uniform(-1.0, 1.0, shape).astype(np.float32)
            else:
                action = _first(agent.act(stack.observation(), explore=True))
            observation, reward, terminated, truncated, info = env.step(action)
            check_moment(observation, float(reward), progress.step + config.action_repeat)
            over = bool(terminated or truncated)
            discount = 0.0 if terminated else 1.0
            replay.add(Transition(action, float(reward), discount, observation, over))
            stack.push(observation)
            episode.add(float(reward), info)
            progress.step += config.action_repeat
            learning = _learn(agent, replay, progress, randomness, config)
            progress.episodes += over
            yield Moment(progress.step, progress.updates, learning, episode if over else None)


def _learn(
    agent: Agent,
    replay: Replay,
    progress: Progress,
    randomness: Randomness,
    config: TrainConfig,
) -> dict[str, Tensor]:
    """The updates that are due: after t steps, (t - seed_steps) updates_per_step in all."""
    due = int((progress.step - config.seed_steps) * config.updates_per_step)
    metrics: dict[str, Tensor] = {}
    while progress.updates < due:
        metrics = agent.update(replay.sample(config.replay.batch_size, randomness.batches))
        progress.updates += 1
    return metrics


def _first(actions: Tensor) -> NDArray[np.float32]:
    """The action of a batch of one."""
    first: NDArray[np.float32] = actions[0].to("cpu", torch.float32).numpy()
    return first
