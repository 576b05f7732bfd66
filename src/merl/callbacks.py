"""Callbacks: objects whose methods are called at the events of training."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from merl.core import CallbackFailed, MerlError
from merl.core.user_code import in_one_line
from merl.evaluation.evaluation import Evaluation

if TYPE_CHECKING:
    from merl.training.loop import StepResult
    from merl.training.outcome import Outcome
    from merl.training.trainer import Trainer


class Callback:
    """Base class of callbacks; override the methods for the events that you need.

    `trainer.stop()`, from any event, stops training after the current step. If a method raises an
    exception, the run is saved and ends with one line that names it.
    """

    def on_start(self, trainer: Trainer) -> None:
        """Handle the start or the resume of training, at step `trainer.progress.step`."""

    def correct(self, actions: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return the actions to execute in place of the agent's, or None to leave them.

        For a person who takes over for a while: the steps of an environment whose action differs
        are added to the demonstrations, which the run must have (`demos`), and written to the
        run's folder `corrections`.

        Args:
            actions: (N, A), in [-1, 1], one row for each environment.
        """
        return None

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """Handle the end of an episode; the metrics are the new row of `metrics.csv`."""

    def on_update(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        """Handle the updates at this step; the metrics are scalars on the agent's device."""

    def on_step(self, result: StepResult) -> bool | None:
        """Handle a step of the environments, as the last event of the step.

        Returns:
            False to stop training.
        """

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
    """One callback that passes every event to several callbacks, in order.

    Raises:
        CallbackFailed: a callback raised an exception that is not a `MerlError`. (After training,
            in `on_end`, this is only a warning, and the other callbacks are still called.)
    """

    def __init__(self, callbacks: Iterable[Callback] = ()) -> None:
        self._callbacks = list(callbacks)

    def __getattribute__(self, name: str) -> Any:
        """Return a function that passes an event on, in place of each method of `Callback`."""
        if name.startswith("on_"):
            return partial(self._notify, name)
        return super().__getattribute__(name)

    def corrects(self) -> bool:
        """Return whether any of the callbacks may correct actions."""
        return any(type(each).correct is not Callback.correct for each in self._callbacks)

    def correct(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the actions as the callbacks correct them, one after the other."""
        for callback in self._callbacks:
            try:
                corrected = callback.correct(actions)
                actions = actions if corrected is None else _checked(corrected, actions.shape)
            except Exception as error:
                name = f"{type(callback).__name__}.correct"
                raise CallbackFailed(f"callback {name} raised {in_one_line(error)}") from error
        return actions

    def _notify(self, event: str, *args: Any) -> bool:
        """Call the method `event` of every callback; return False if one of them returned False."""
        goes_on = True
        for callback in self._callbacks:
            try:
                goes_on &= getattr(callback, event)(*args) is not False
            except Exception as error:
                name = f"{type(callback).__name__}.{event}"
                failure = CallbackFailed(f"callback {name} raised {in_one_line(error)}")
                if event == "on_end":
                    self.on_warning(str(failure))
                elif isinstance(error, MerlError):
                    raise
                else:
                    raise failure from error
        return goes_on


def _checked(actions: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return corrected actions as float32.

    Raises:
        ValueError: they have another shape, or a value is not a number in [-1, 1].
    """
    found = np.asarray(actions, np.float32)
    if found.shape != shape:
        raise ValueError(f"it returned an array of shape {found.shape}: return None, or {shape}")
    if not (np.abs(found) <= 1.0).all():
        raise ValueError(
            f"it returned numbers from {found.min():g} to {found.max():g}: return None, or numbers "
            "in [-1, 1]"
        )
    return found
