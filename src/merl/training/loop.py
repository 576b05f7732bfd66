"""The loop of Algorithm 1: act, store the transition, learn.

The loop is a generator that yields after every environment step. Logging, evaluations and
checkpoints are outside of the loop, so the same loop trains every agent in every environment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from merl.acting.environments import Environments, WorkerDied
from merl.acting.rollout import Episode, Fetched, FrameStack, side_by_side
from merl.config import TrainConfig
from merl.core import Agent, MerlError, Transition
from merl.core.guards import check_finite
from merl.replay import ReplayBuffer
from merl.training.corrections import Corrections


@dataclass
class Progress:
    """Counts of a run so far."""

    step: int = 0
    updates: int = 0
    episodes: int = 0
    evaluated: int = 0  # the step of the last evaluation
    attempts: int = 0  # at the due evaluation; all of them failed or were killed
    restarts: int = 0  # of the worker processes
    reports_success: bool = False  # an episode has reported success or failure


@dataclass(frozen=True)
class StepResult:
    """Result of one step of every environment.

    If updates are still due when a run resumes, the first result reports only these.

    Attributes:
        step: environment steps so far.
        updates: updates so far.
        learning: metrics of the updates at this step, scalars on the device; empty without one.
        episodes: the episodes that ended at this step.
        lost: why a worker process died, which cuts off the episodes in progress; None if none died.
    """

    step: int
    updates: int
    learning: dict[str, Tensor] = field(default_factory=dict)
    episodes: tuple[Episode, ...] = ()
    lost: str | None = None


Update = Callable[[int], dict[str, Tensor]]
"""A function that makes one update and returns its metrics, scalars on the device. Its argument is
the number of environment steps before the current one, on which schedules depend."""


class Randomness:
    """Random streams from one seed, one for each purpose; drawing from one does not affect another.

    Attributes:
        agent: seed of initialisation, noise and shifts.
        actions: generator of the uniformly random actions at the start.
        batches: generator of the batches from replay.
    """

    def __init__(self, seed: int) -> None:
        words = np.random.SeedSequence(seed).generate_state(5)
        self._seed, self._environment, self.agent = seed, int(words[0]), int(words[1])
        self.actions, self.batches = (np.random.default_rng(int(word)) for word in words[2:4])
        self._device = int(words[4])

    def environment(self, index: int = 0, restart: int = 0) -> int:
        """Return the seed of an environment's first reset, in [0, 2^31).

        Args:
            index: index of the environment.
            restart: number of restarts of the environments so far.
        """
        if index == restart == 0:
            seed = self._environment
        else:
            words = np.random.SeedSequence((self._seed, index, restart)).generate_state(1)
            seed = int(words[0])
        return seed % 2**31  # many simulators need a signed 32-bit integer

    def on_device(self, updates: int) -> int:
        """Return the seed for sampling from a replay on a GPU, starting after `updates` updates."""
        return int(np.random.SeedSequence((self._device, updates)).generate_state(1)[0])

    def state_dict(self) -> dict[str, Any]:
        """Return the generators' states as plain types."""
        return {
            "actions": self.actions.bit_generator.state,
            "batches": self.batches.bit_generator.state,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`."""
        self.actions.bit_generator.state = state["actions"]
        self.batches.bit_generator.state = state["batches"]


def train(
    collector: Collector,
    agent: Agent,
    update: Update,
    progress: Progress,
    randomness: Randomness,
    config: TrainConfig,
    is_to_stop: Callable[[], bool] = lambda: False,
) -> Iterator[StepResult]:
    """Act and learn up to step `config.steps`; yield after each step of the environments.

    Args:
        collector: steps the environments and fills the replay. The loop seeds the environments of a
            new run; the caller restores those of a resumed run before the call.
        agent: chooses actions.
        update: makes one update of the agent from the replay.
        progress: counts of the run; updated by the loop.
        randomness: the run's random streams.
        config: steps, seed steps, random steps, updates per step.
        is_to_stop: returns whether to stop before the next update, and to leave the remaining
            updates to the resumed run. Ignored without `config.synchronous`, where the resumed run
            would make these updates from a fuller replay.

    Raises:
        NotFinite: an observation or a reward is NaN or infinite; it does not enter the replay.
    """
    if progress.episodes == 0:
        collector.seed(randomness, progress)
    stopping = is_to_stop if config.synchronous else lambda: False
    learn = partial(_learn, update, progress, config, stopping)
    # First make the updates that were due when the run was stopped.
    step = max(0, progress.step - config.action_repeat * collector.count)
    remaining = learn(step) if config.synchronous else {}
    if remaining or stopping():
        yield StepResult(progress.step, progress.updates, remaining)
    while progress.step < config.steps:
        step = progress.step
        learning: dict[str, Tensor] = {}
        try:
            collector.begin_episodes(randomness, progress)
            actions = _actions(collector, agent, progress, randomness, config)
            # Without `synchronous` the updates run while the environments step. Launch them on a
            # GPU before waiting for the actions, so that the GPU never idles.
            launched = actions.under_way and not config.synchronous
            if launched:
                learning = learn(step)
            collector.act(actions.wait().numpy())
            if not (launched or config.synchronous):
                learning = learn(step)
            ended = collector.store(progress, config.action_repeat)
        except WorkerDied as died:
            collector.broken = True
            yield StepResult(progress.step, progress.updates, learning, lost=str(died))
            continue
        if config.synchronous or progress.step >= config.steps:
            learning = learn(step) or learning
        progress.episodes += len(ended)
        yield StepResult(progress.step, progress.updates, learning, ended)


class Receiver(Protocol):
    """Receiver of transitions that others collect."""

    def store(self, progress: Progress, repeat: int) -> tuple[Episode, ...]:
        """Wait a moment for a transition and store it in the replay.

        Args:
            progress: counts of the run; `step` is increased by `repeat` for a transition.
            repeat: environment steps of each transition.

        Returns:
            The episode that has ended, if one has.
        """
        ...


def train_from(
    receiver: Receiver,
    update: Update,
    progress: Progress,
    config: TrainConfig,
    is_to_stop: Callable[[], bool] = lambda: False,
) -> Iterator[StepResult]:
    """Learn from received transitions; yield after each of them, or after a moment without.

    Arguments as of `train`.
    """
    learn = partial(_learn, update, progress, config, is_to_stop)
    remaining = learn(max(0, progress.step - config.action_repeat))
    if remaining or is_to_stop():
        yield StepResult(progress.step, progress.updates, remaining)
    while progress.step < config.steps:
        step = progress.step
        ended = receiver.store(progress, config.action_repeat)
        learning = learn(step)
        progress.episodes += len(ended)
        yield StepResult(progress.step, progress.updates, learning, ended)


class Collector:
    """Collector of transitions: it steps the environments and fills the replay.

    Args:
        environments: one or several environments.
        replay: the replay, with a ring for each environment.
        stacks: a frame stack for each environment.
        corrections: lets callbacks correct the actions; None if none does.

    Attributes:
        broken: whether a worker process died; then all restart before the next episode.
    """

    def __init__(
        self,
        environments: Environments,
        replay: ReplayBuffer,
        stacks: list[FrameStack],
        corrections: Corrections | None = None,
    ) -> None:
        self._corrections = corrections
        self.environments, self.replay, self.stacks = environments, replay, stacks
        self.broken = False
        self._seeds: dict[int, int] = {}
        self._episodes: dict[int, Episode] = {}  # in progress, by environment
        self._actions: NDArray[np.float32] | None = None

    @property
    def count(self) -> int:
        """Return the number of environments."""
        return self.environments.count

    def seed(self, randomness: Randomness, progress: Progress) -> None:
        """Seed the next episode of each environment from the run's seed."""
        self._seeds = {
            index: randomness.environment(index, progress.restarts) for index in range(self.count)
        }

    def begin_episodes(self, randomness: Randomness, progress: Progress) -> None:
        """Start an episode in every environment that has none in progress."""
        if self.broken:
            progress.restarts += 1
            self._episodes.clear()  # the replay cuts these off when the next ones begin
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
            self.replay.begin(self.stacks[index].reset(observation), index)
            self._episodes[index] = Episode()
            if self._corrections is not None:
                self._corrections.begin(index, observation)

    def act(self, actions: NDArray[np.float32]) -> None:
        """Start a step of the environments with actions (count, A)."""
        self._actions = actions if self._corrections is None else self._corrections.apply(actions)
        self.environments.send(self._actions)

    def store(self, progress: Progress, repeat: int) -> tuple[Episode, ...]:
        """Wait for the step and store its transitions; return the episodes that ended."""
        assert self._actions is not None
        ended = []
        for index, step in enumerate(self.environments.receive()):
            reached = progress.step + repeat
            check_finite(step.observation, step.reward, reached, self._where(index))
            over = bool(step.terminated or step.truncated)
            discount = 0.0 if step.terminated else 1.0
            stored = self.stacks[index].push(step.observation)
            transition = Transition(self._actions[index], step.reward, discount, stored, over)
            self.replay.add(transition, index)
            self._episodes[index].add(step.reward, step.info)
            progress.step += repeat
            if self._corrections is not None:
                self._corrections.add(index, step)
            if over:
                ended.append(self._episodes.pop(index))
        return tuple(ended)

    def _where(self, index: int) -> str:
        """Return words for an error message that name the environment, if there are several."""
        return f"of environment {index}" if self.count > 1 else ""


def _actions(
    collector: Collector,
    agent: Agent,
    progress: Progress,
    randomness: Randomness,
    config: TrainConfig,
) -> Fetched:
    """Return actions (count, A) in [-1, 1]: uniformly random at first, later from the agent."""
    if progress.step < config.random_steps:
        shape = (collector.count, *collector.environments.action_shape)
        drawn = randomness.actions.uniform(-1.0, 1.0, shape).astype(np.float32)
        return Fetched(torch.from_numpy(drawn))
    actions = agent.act(side_by_side(collector.stacks), explore=True, step=progress.step)
    expected = (collector.count, *collector.environments.action_shape)
    if actions.shape != expected:
        raise MerlError(
            f"act() of agent {config.agent_name!r} returned shape {tuple(actions.shape)}: return "
            f"{expected}, one action for each environment"
        )
    return Fetched(actions.float())


def updates_due(steps: int, updates_per_step: float) -> int:
    """Return the number of updates due after `steps` steps; 0.57 counts as exactly 57/100."""
    return int(steps * Fraction(str(updates_per_step)))


def _learn(
    update: Update,
    progress: Progress,
    config: TrainConfig,
    is_to_stop: Callable[[], bool],
    step: int,
) -> dict[str, Tensor]:
    """Make the updates that are due: after step t, (t - seed_steps) * updates_per_step in total."""
    due = updates_due(progress.step - config.seed_steps, config.updates_per_step)
    metrics: dict[str, Tensor] = {}
    while progress.updates < due and not is_to_stop():
        metrics |= update(step)
        progress.updates += 1
    return metrics
