"""The printed duration of a run, and numbers with their nouns."""

from __future__ import annotations

from typing import Any

import pytest

from merl.cli.running import duration
from merl.config import TrainConfig
from merl.core import counted
from merl.replay import ReplayConfig
from merl.training.timing import Arithmetic, Timing

WHOLE = "1,000 steps of x:y on cpu"


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0 steps"), (1, "1 step"), (2, "2 steps"), (150_000, "150,000 steps"), (0.5, "0.5 steps")],
)
def test_numbers_agree_with_their_nouns(number: float, text: str) -> None:
    assert counted(number, "step") == text
    assert counted(1.0, "minute") == "1 minute"


@pytest.mark.parametrize(
    ("values", "knows_env", "done", "line"),
    [
        ({}, True, 0, f"{WHOLE} take about 0:03:20"),
        ({}, True, 999, "1 step of x:y on cpu takes about 0:02:23"),
        (
            {"minutes": 5.0},
            True,
            0,
            f"{WHOLE} take about 0:03:20, at most 5 minutes",
        ),
        (
            {"minutes": 1.0},
            True,
            0,
            "1 minute of x:y on cpu (1,000 steps would take about 0:03:20)",
        ),
        (
            {"minutes": 1.0},
            False,
            0,
            f"{WHOLE} in at most 1 minute",
        ),
        ({}, False, 990, "10 steps of x:y on cpu"),
    ],
)
def test_duration_in_one_line(values: Any, knows_env: bool, done: int, line: str) -> None:
    config = TrainConfig(
        "x:y",
        steps=1000,
        seed_steps=1000,
        device="cpu",
        replay=ReplayConfig(batch_size=8),
        **values,
    )
    # Ten evaluation episodes of 250 steps each are included.
    timing = Timing({Arithmetic("fp32", 1): 0.0}, 200 / 3500, knows_env=knows_env)
    assert duration(config, timing, done) == line
