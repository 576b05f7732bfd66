"""Callbacks: objects whose methods are called at the events of training."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from torch import Tensor

from merl.evaluation.evaluation import Evaluation
from merl.training.loop import StepResult

if TYPE_CHECKING:
    from merl.training.trainer import Outcome, Trainer


class Callback:
    """Base class of callbacks; override the methods for the events that you need.

    If a method raises an exception, the run is saved and ends with that exception.
    """

    def on_start(self, trainer: Trainer) -> None:
        """Handle the start or the resume of training, at step `trainer.setup.progress.step`."""

    def on_step(self, result: StepResult) -> bool | None:
        """Handle a step of the environments; return False to stop training."""

    def on_update(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        """Handle the updates at this step; the metrics are scalars on the agent's device."""

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """Handle the end of an episode; the metrics are the new row of `metrics.csv`."""

    def on_evaluation_step(self, episode: int, total: int) -> None:
        """Handle a step of an evaluation, in episode number `episode` (from 0) of `total`."""

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """Handle the result of an evaluation."""

    def on_checkpoint(self, step: int) -> None:
        """Handle a checkpoint that was written."""

    def on_warning(self, message: str) -> None:
        """Handle a warning for the user; training continues."""

    def on_end(self, outcome: Outcome | None) -> None:
        """Handle the end of training; the outcome is None if an exception ended it."""


class CallbackList(Callback):
    """One callback that calls several callbacks in order."""

    def __init__(self, callbacks: Iterable[Callback] = ()) -> None:
        self._callbacks = list(callbacks)

    def on_start(self, trainer: Trainer) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_start(trainer)

    def on_step(self, result: StepResult) -> bool | None:
        """Call every callback; return False if any of them returned False."""
        answers = [callback.on_step(result) for callback in self._callbacks]
        return not any(answer is False for answer in answers)

    def on_update(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_update(step, metrics)

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_episode(step, metrics)

    def on_evaluation_step(self, episode: int, total: int) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_evaluation_step(episode, total)

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_evaluation(step, evaluation)

    def on_checkpoint(self, step: int) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_checkpoint(step)

    def on_warning(self, message: str) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_warning(message)

    def on_end(self, outcome: Outcome | None) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_end(outcome)
