"""Corrections: a person takes over for a while, and these steps become demonstrations (HIL-SERL).

Each stretch of corrected steps is an episode that is cut off at its end. Batches draw it like the
demonstrations. It is also written into the run's folder `corrections`, from which a resumed run
reads it, and other runs too (`--demos RUN/corrections`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.acting.environments import Step
from merl.core import MerlError, Observation
from merl.demos.demonstrations import store
from merl.demos.episode import EpisodeRecording
from merl.demos.recorder import Recorder
from merl.replay import ReplayBuffer

if TYPE_CHECKING:
    from merl.callbacks import CallbackList
    from merl.runs.run import Run
    from merl.training.setup import Setup

FOLDER = "corrections"
"""Folder of the corrections in a run's folder."""
CAPACITY = 100_000
"""Most steps of corrections that are drawn; older ones stay in the folder alone."""

Correct = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Corrections:
    """Corrections of a run; see the module.

    Args:
        correct: maps the agent's actions (N, A) to those that are executed.
        replay: an empty replay like that of the demonstrations.
        recorder: writes the corrections; those that its folder holds are read.
        space: the run's observations, in whose bounds depth is stored.

    Attributes:
        replay: the corrections, to draw from.
    """

    def __init__(
        self, correct: Correct, replay: ReplayBuffer, recorder: Recorder, space: spaces.Dict
    ) -> None:
        self.replay, self._space = replay, space
        self._correct, self._recorder = correct, recorder
        self._observations: dict[int, Observation] = {}  # the newest, by environment
        self._open: dict[int, EpisodeRecording] = {}  # stretches in progress, by environment
        self._actions: dict[int, NDArray[np.float32]] = {}  # of this step, where corrected
        for episode in recorder.demonstrations.episodes():
            store(episode, replay, space)

    @classmethod
    @contextmanager
    def of(cls, correct: CallbackList, setup: Setup, run: Run) -> Iterator[Corrections | None]:
        """Open the corrections of a run; None if no callback can correct actions.

        Raises:
            MerlError: the run has no demonstrations.
        """
        if not correct.corrects():
            yield None
            return
        if setup.config.has_actors:
            raise MerlError("a callback corrects actions, but this run's actors act elsewhere")
        if setup.demos is None:
            raise MerlError(
                "a callback corrects actions, which become demonstrations, but the run has none to "
                "add to: name a folder of them with --demos (`merl demos record` makes one)"
            )
        config = setup.config
        options = {} if config.has_user_env else config.env.form
        own, folder = (setup.space, setup.action_space), run.path / FOLDER
        recorder = Recorder(folder, config.task, "corrections", *own, options, append=True)
        spec = replace(setup.demos.spec, capacity=min(CAPACITY, config.capacity))
        corrections = cls(correct.correct, ReplayBuffer(spec), recorder, setup.space)
        try:
            yield corrections
        finally:
            corrections.close()

    def begin(self, index: int, observation: Observation) -> None:
        """Note the first observation of an episode of environment `index`."""
        self._close(index)  # a stretch that the death of a worker process has cut off
        self._observations[index] = observation

    def apply(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the actions (N, A) to execute, and begin or end stretches of corrected steps."""
        executed = self._correct(actions.copy())  # it may change them in place
        changed = np.flatnonzero((executed != actions).any(axis=1)).tolist()
        self._actions = {index: executed[index] for index in changed}
        for index in self._open.keys() - self._actions.keys():
            self._close(index)
        for index in changed:
            if index not in self._open:
                self._open[index] = EpisodeRecording(self._observations[index])
        return executed

    def add(self, index: int, step: Step) -> None:
        """Add the step that the environment has made, if its action was corrected."""
        self._observations[index] = step.observation
        action = self._actions.get(index)
        if action is not None:
            self._open[index].add(action, action, step.observation, step.reward, step.info)
            if step.terminated or step.truncated:
                self._close(index, terminated=step.terminated)

    def close(self) -> None:
        """End the stretches in progress."""
        for index in list(self._open):
            self._close(index)

    def _close(self, index: int, *, terminated: bool = False) -> None:
        recording = self._open.pop(index, None)
        if recording is not None and len(recording):
            episode = recording.finish(terminated=terminated)
            self._recorder.add(episode)
            store(episode, self.replay, self._space)
