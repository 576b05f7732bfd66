"""The expected duration of a run, printed before it begins or after its first steps."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from datetime import timedelta

from rich.console import Console

from merl.config import TrainConfig
from merl.core import counted
from merl.evaluation.evaluation import Evaluation
from merl.training.live_view import LiveView
from merl.training.loop import StepResult
from merl.training.timing import Timing
from merl.training.trainer import Trainer

FIRST_STEPS = 50
"""Environment steps that are timed to estimate the time per step."""


def duration(config: TrainConfig, timing: Timing, done: int) -> str:
    """Return how many steps remain and how long they take, in one line.

    Args:
        config: the config of the run.
        timing: the measured times of a step and of an update.
        done: steps that the run has already taken.
    """
    left = config.steps - done
    steps = counted(left, "step")
    limit = None if config.minutes is None else counted(config.minutes, "minute")
    where = f"of {config.task} on {config.device}"
    if not timing.knows_env:
        bound = "" if limit is None else f" in at most {limit}"
        later = f" (their duration is printed after the first {FIRST_STEPS})"
        return f"{steps} {where}{bound}{later if left > FIRST_STEPS else ''}"
    seconds = timing.seconds(dataclasses.replace(config, minutes=None), done)
    about = f"about {timedelta(seconds=round(seconds))}"
    if config.minutes is not None and seconds > 60 * config.minutes:
        return f"{limit} {where} ({steps} would take {about})"
    bound = "" if limit is None else f", at most {limit}"
    return f"{steps} {where} {'takes' if left == 1 else 'take'} {about}{bound}"


class DurationView(LiveView):
    """Live view that times the first steps if the environment was not timed before training.

    Args:
        console: where to print.
        scale: see `LiveView`.
    """

    def __init__(self, console: Console, scale: Mapping[str, float]) -> None:
        super().__init__(console, scale)
        self._timing: Timing | None = None  # until the duration is printed
        self._first: tuple[float, StepResult] | None = None  # time and first step

    def on_start(self, trainer: Trainer) -> None:
        """See `Callback`."""
        super().on_start(trainer)
        self._config, timing = trainer.config, trainer.setup.timing
        self._timing = None if timing.knows_env else timing

    def on_step(self, result: StepResult) -> bool | None:
        """See `Callback`."""
        super().on_step(result)
        if self._timing is None:
            return None
        now = time.perf_counter()
        if self._first is None:
            self._first = now, result
            return None
        start, first = self._first
        steps = result.step - first.step
        if steps < FIRST_STEPS:
            return None
        learning = (result.updates - first.updates) * self._timing.update[self._timing.best]
        actions = steps / self._config.action_repeat
        step = max(0.0, now - start - learning) / actions
        timing = dataclasses.replace(self._timing, step=step, knows_env=True)
        self._timing = None
        line = duration(self._config, timing, result.step)
        self.console.print(f"{line}; a step takes {1000 * step:.1f} ms", highlight=False)
        return None

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """See `Callback`; the time of the evaluation does not count for the steps."""
        super().on_evaluation(step, evaluation)
        self._first = None
