"""Callbacks: code that is called while a run is trained."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from torch import Tensor

from merl.evaluation.evaluation import Evaluation
from merl.training.loop import StepResult

if TYPE_CHECKING:
    from merl.training.trainer import Outcome, Trainer


class Callback:
    """Called at the events of training; override the methods that you need.

    If a method raises an exception, the run is saved and ends with that exception.
    """

    def on_start(self, trainer: Trainer) -> None:
        """Training starts or resumes; `trainer.setup.progress` says at which step."""

    def on_step(self, result: StepResult) -> bool | None:
        """The environments took a step. Return False to stop training."""

    def on_update(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        """The agent learned at this step; the metrics are scalars on its device."""

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """An episode ended; the metrics are the row that `metrics.csv` gets."""

    def on_evaluation_step(self, episode: int, total: int) -> None:
        """An evaluation took a step in episode number `episode` (from 0) of `total`."""

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """An evaluation ended."""

    def on_checkpoint(self, step: int) -> None:
        """A checkpoint was written."""

    def on_warning(self, message: str) -> None:
        """Something happened that the user should know and that does not stop the run."""

    def on_end(self, outcome: Outcome | None) -> None:
        """Training ended; the outcome is None if an exception ended it."""


class CallbackList(Callback):
    """Several callbacks as one, called in their order."""

    def __init__(self, callbacks: Iterable[Callback] = ()) -> None:
        self._callbacks = list(callbacks)

    def on_start(self, trainer: Trainer) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.on_start(trainer)

    def on_step(self, result: StepResult) -> bool | None:
        """Return False if any callback does."""
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
