"""How long a run takes: said before it begins, or after its first steps."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from datetime import timedelta

from rich.console import Console

from merl.config import TrainConfig
from merl.core import counted
from merl.evaluation.evaluation import Evaluation
from merl.training.console import ConsoleView
from merl.training.loop import StepResult
from merl.training.parts import Parts
from merl.training.timing import Timing

FIRST_STEPS = 50
"""Steps of the environment, from which its time per step is taken."""


def duration(config: TrainConfig, timing: Timing, done: int) -> str:
    """Return how much there is to do, and how long it takes, in one line.

    Args:
        config: of the run.
        timing: what this machine needs.
        done: steps that the run has taken already.
    """
    left = config.steps - done
    steps = counted(left, "step")
    limit = None if config.minutes is None else counted(config.minutes, "minute")
    where = f"of {config.task} on {config.device}"
    if not timing.knows_env:
        bound = "" if limit is None else f" in at most {limit}"
        later = f" (how long they take is said after the first {FIRST_STEPS})"
        return f"{steps} {where}{bound}{later if left > FIRST_STEPS else ''}"
    seconds = timing.seconds(dataclasses.replace(config, minutes=None), done)
    about = f"about {timedelta(seconds=round(seconds))}"
    if config.minutes is not None and seconds > 60 * config.minutes:
        return f"{limit} {where} ({steps} would take {about})"
    bound = "" if limit is None else f", at most {limit}"
    return f"{steps} {where} {'takes' if left == 1 else 'take'} {about}{bound}"


class DurationView(ConsoleView):
    """The live view of a run whose environment was not timed: it times the first steps.

    Args:
        console: where to print.
        parts: what the run is made of.
        scale: see `ConsoleView`.
    """

    def __init__(self, console: Console, parts: Parts, scale: Mapping[str, float]) -> None:
        super().__init__(console, scale)
        self._config, self._timing = parts.config, parts.timing
        self._first: tuple[float, StepResult] | None = None  # the time of the first step
        self._is_said = False

    def moment(self, moment: StepResult, metrics: dict[str, float]) -> None:
        """See `stretch.View`."""
        super().moment(moment, metrics)
        if self._is_said:
            return
        now = time.perf_counter()
        if self._first is None:
            self._first = now, moment
            return
        start, first = self._first
        steps = moment.step - first.step
        if steps < FIRST_STEPS:
            return
        self._is_said = True
        learning = (moment.updates - first.updates) * self._timing.update[self._timing.best]
        decisions = steps / self._config.action_repeat
        step = max(0.0, now - start - learning) / decisions
        timing = dataclasses.replace(self._timing, step=step, knows_env=True)
        told = duration(self._config, timing, moment.step)
        self.console.print(f"{told}; a step takes {1000 * step:.1f} ms", highlight=False)

    def evaluated(self, step: int, evaluation: Evaluation) -> None:
        """See `stretch.View`; the time of the evaluation is not that of the steps."""
        super().evaluated(step, evaluation)
        self._first = None
