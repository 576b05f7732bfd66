from __future__ import annotations

import io
from types import SimpleNamespace
from typing import Any

from rich.console import Console

from merl.training.console import ConsoleView, describe
from merl.training.evaluation import summarize
from merl.training.loop import Moment
from merl.training.rollout import Episode

METRICS = {
    "train/return": 12.34,
    "train/success_end": 1.0,
    "time/steps_per_second": 33.0,
    "time/updates_per_second": 17.0,
    "learn/q": 4.5,
    "learn/critic_loss": 0.25,
}


def episodes() -> list[Episode]:
    won, lost = Episode(), Episode()
    won.add(2.0, {"success": 1.0})
    lost.add(1.0, {"success": 0.0})
    return [won, lost]


def watch(terminal: bool) -> str:
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=terminal, width=100)
    run: Any = SimpleNamespace(config=SimpleNamespace(steps=1000, minutes=None))
    with ConsoleView(console) as view:
        view.begin(run, 0)
        for step in range(1, 251):
            view.moment(Moment(step, step), METRICS if step == 250 else {})
        view.evaluating(0, 2)
        view.evaluated(250, summarize(episodes()))
        view.warn("the disk is full")
        view.saved(250)
    return shown.getvalue()


def test_a_terminal_shows_progress_speed_and_what_is_learnt() -> None:
    shown = watch(terminal=True)
    for said in ("250 of 1,000", "33 steps/s", "17 updates/s", "return 12.3, success 100%"):
        assert said in shown
    for said in ("Q 4.50", "at step 250", "warning: the disk is full", "saved at step 250"):
        assert said in shown
    assert shown.rstrip().endswith("\x1b[?25h")  # the cursor is back


def test_elsewhere_there_are_plain_lines() -> None:
    shown = watch(terminal=False)
    assert "\x1b" not in shown
    assert "evaluation at step 250: return 1.5" in shown
    assert "warning: the disk is full" in shown


def test_an_evaluation_in_one_line() -> None:
    line = describe(summarize(episodes()))
    assert line.startswith("return 1.5 [1.0, 2.0], success 50% [9%, 91%] at the end")
    assert line.endswith("(2 episodes)")


def test_success_rates_that_are_equal_are_said_once() -> None:
    line = describe(summarize(episodes()[1:]))
    assert line == "return 1.0 [1.0, 1.0], success 0% [0%, 79%] at the end (1 episode)"
