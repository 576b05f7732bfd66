"""The loop of Algorithm 1: act, remember, learn.

It is a generator that yields after every environment step, so that logging, evaluation and
checkpoints stay outside, and the same loop serves every agent and every environment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from merl.acting.environments import Environments, WorkerDied
from merl.acting.rollout import Episode, Fetched, FrameStack, side_by_side
from merl.config import TrainConfig
from merl.core import Agent, Transition
from merl.core.guards import check_finite
from merl.replay import ReplayBuffer


@dataclass
class Progress:
    """Where a run stands."""

    step: int = 0
    updates: int = 0
    episodes: int = 0
    evaluated: int = 0  # the step of the last evaluation
    attempts: int = 0  # at the evaluation that is due, which failed or was killed so far
    restarts: int = 0  # of environments' processes
    reports_success: bool = False  # an episode of the environment has reported success or failure


@dataclass(frozen=True)
class StepResult:
    """What the loop tells after an environment step, or one step of each of several environments.

    A run that goes on where updates were left begins with one that tells of those alone.

    Attributes:
        step: environment steps so far.
        updates: updates so far.
        learning: metrics of the updates at this step, scalars on the device; empty without one.
        episodes: the sums of the episodes that ended with it.
        lost: what happened to an environment's process; the episodes in progress are cut off.
    """

    step: int
    updates: int
    learning: dict[str, Tensor] = field(default_factory=dict)
    episodes: tuple[Episode, ...] = ()
    lost: str | None = None


Update = Callable[[], dict[str, Tensor]]
"""Makes one update; returns its metrics, scalars on the device."""


class Randomness:
    """One seed, split by purpose: no use of one stream moves another.

    Attributes:
        agent: the seed of initialisation, noise and shifts.
        actions: the uniformly random actions of the start.
        batches: what is sampled from replay.
    """

    def __init__(self, seed: int) -> None:
        words = np.random.SeedSequence(seed).generate_state(5)
        self._seed, self._environment, self.agent = seed, int(words[0]), int(words[1])
        self.actions, self.batches = (np.random.default_rng(int(word)) for word in words[2:4])
        self._device = int(words[4])

    def environment(self, index: int = 0, restart: int = 0) -> int:
        """Return the seed of an environment's first reset, in [0, 2^31).

        Args:
            index: of the environment.
            restart: how often the environments were restarted.
        """
        if index == restart == 0:
            seed = self._environment
        else:
            words = np.random.SeedSequence((self._seed, index, restart)).generate_state(1)
            seed = int(words[0])
        return seed % 2**31  # many simulators take the seed as a signed 32-bit integer

    def on_device(self, updates: int) -> int:
        """The seed of what is sampled from a replay on a GPU, from so many updates on."""
        return int(np.random.SeedSequence((self._device, updates)).generate_state(1)[0])

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
    stage: Collector,
    agent: Agent,
    update: Update,
    progress: Progress,
    randomness: Randomness,
    config: TrainConfig,
    is_to_stop: Callable[[], bool] = lambda: False,
) -> Iterator[StepResult]:
    """Act and learn until `config.steps`; yields after each step of the environments.

    Args:
        stage: where the agent acts, and what remembers it; its environments are seeded by this loop
            if the run begins, and stand where the caller set them if it goes on.
        agent: acts.
        update: has it learn from what is remembered.
        progress: moved on as the run goes.
        randomness: the run's random streams.
        config: steps, seed steps, random steps, updates per step, batch size.
        is_to_stop: whether updates that are due are to be left for when the run goes on; not asked
            beside the environments, where what is left would be learnt from more than was there.

    Raises:
        NotFinite: an observation or a reward is no number; the replay does not take it in.
    """
    if progress.episodes == 0:
        stage.seed(randomness, progress)
    stopping = is_to_stop if config.synchronous else lambda: False
    learn = partial(_learn, update, progress, config, stopping)
    # What was left when it was stopped, at the step that it was due at.
    agent.step = max(0, progress.step - config.action_repeat * stage.count)
    left = learn() if config.synchronous else {}
    if left or stopping():
        yield StepResult(progress.step, progress.updates, left)
    while progress.step < config.steps:
        agent.step = progress.step
        learning: dict[str, Tensor] = {}
        try:
            stage.begin_episodes(randomness, progress)
            actions = _actions(stage, agent, progress, randomness, config)
            # Beside the environments the learner learns while they step. A GPU is told what to
            # learn before its actions are waited for, lest it stand idle until they have arrived.
            told = actions.under_way and not config.synchronous
            if told:
                learning = learn()
            stage.act(actions.wait().numpy())
            if not (told or config.synchronous):
                learning = learn()
            ended = stage.remember(progress, config.action_repeat)
        except WorkerDied as lost:
            stage.broken = True
            yield StepResult(progress.step, progress.updates, learning, lost=str(lost))
            continue
        if config.synchronous or progress.step >= config.steps:
            learning = learn() or learning
        progress.episodes += len(ended)
        yield StepResult(progress.step, progress.updates, learning, ended)


class Collector:
    """The environments that the agent acts in, with the stacks that it sees, and the replay.

    Args:
        environments: one or several.
        replay: a ring for each.
        stacks: of each one's frames.

    Attributes:
        broken: an environment's process was lost; all are made anew before the next episode.
    """

    def __init__(
        self, environments: Environments, replay: ReplayBuffer, stacks: list[FrameStack]
    ) -> None:
        self.environments, self.replay, self.stacks = environments, replay, stacks
        self.broken = False
        self._seeds: dict[int, int] = {}
        self._episodes: dict[int, Episode] = {}  # those in progress
        self._actions: NDArray[np.float32] | None = None

    @property
    def count(self) -> int:
        """How many environments there are."""
        return self.environments.count

    def seed(self, randomness: Randomness, progress: Progress) -> None:
        """Have the next episode of each environment begin with a seed of the run's."""
        self._seeds = {
            index: randomness.environment(index, progress.restarts) for index in range(self.count)
        }

    def begin_episodes(self, randomness: Randomness, progress: Progress) -> None:
        """Start an episode in every environment that is in none."""
        if self.broken:
            progress.restarts += 1
            self._episodes.clear()  # the replay cuts them off where the next ones begin
            self.environments.restart()
            self.seed(randomness, progress)
            self.broken = False
        starting = {
            index: self._seeds.pop(index, None)
            for index in range(self.count)
            if index not in self._episodes
        }
        if not starting:
            return
        for index, observation in self.environments.reset(starting).items():
            check_finite(observation, 0.0, progress.step, self._where(index))
            self.replay.rings[index].begin(observation)
            self.stacks[index].reset(observation)
            self._episodes[index] = Episode()

    def act(self, actions: NDArray[np.float32]) -> None:
        """Have the environments step, with actions (count, A)."""
        self._actions = actions
        self.environments.send(actions)

    def remember(self, progress: Progress, repeat: int) -> tuple[Episode, ...]:
        """Take in what the actions led to; returns the episodes that it ended."""
        assert self._actions is not None
        ended = []
        for index, step in enumerate(self.environments.receive()):
            reached = progress.step + repeat
            check_finite(step.observation, step.reward, reached, self._where(index))
            over = bool(step.terminated or step.truncated)
            discount = 0.0 if step.terminated else 1.0
            self.replay.rings[index].add(
                Transition(self._actions[index], step.reward, discount, step.observation, over)
            )
            self.stacks[index].push(step.observation)
            self._episodes[index].add(step.reward, step.info)
            progress.step += repeat
            if over:
                ended.append(self._episodes.pop(index))
        return tuple(ended)

    def _where(self, index: int) -> str:
        """Which environment, where there are several; the first is number 0."""
        return f"of environment {index}" if self.count > 1 else ""


def _actions(
    stage: Collector, agent: Agent, progress: Progress, randomness: Randomness, config: TrainConfig
) -> Fetched:
    """Uniformly random at first, then the agent's: (count, A) in [-1, 1]."""
    if progress.step < config.random_steps:
        shape = (stage.count, *stage.environments.action_shape)
        drawn = randomness.actions.uniform(-1.0, 1.0, shape).astype(np.float32)
        return Fetched(torch.from_numpy(drawn))
    return Fetched(agent.act(side_by_side(stage.stacks), explore=True).float())


def updates_due(steps: int, updates_per_step: float) -> int:
    """How many updates so many steps ask for, exactly: 0.57 is meant, not the float nearest it."""
    return int(steps * Fraction(str(updates_per_step)))


def _learn(
    update: Update, progress: Progress, config: TrainConfig, is_to_stop: Callable[[], bool]
) -> dict[str, Tensor]:
    """The updates that are due: after t steps, (t - seed_steps) updates_per_step in all."""
    due = updates_due(progress.step - config.seed_steps, config.updates_per_step)
    metrics: dict[str, Tensor] = {}
    while progress.updates < due and not is_to_stop():
        metrics |= update()
        progress.updates += 1
    return metrics
