"""The expected duration of a run, printed before it begins."""

from __future__ import annotations

import dataclasses
from datetime import timedelta

from merl.config import TrainConfig
from merl.core import counted
from merl.training.timing import Timing


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
        return f"{steps} {where}{bound}"
    seconds = timing.seconds(dataclasses.replace(config, minutes=None), done)
    about = f"about {timedelta(seconds=round(seconds))}"
    if config.minutes is not None and seconds > 60 * config.minutes:
        return f"{limit} {where} ({steps} would take {about})"
    bound = "" if limit is None else f", at most {limit}"
    return f"{steps} {where} {'takes' if left == 1 else 'take'} {about}{bound}"
