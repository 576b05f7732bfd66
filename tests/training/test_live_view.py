from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from helpers import flat
from merl.acting.rollout import Episode
from merl.evaluation.evaluation import Evaluation, summarize
from merl.training import live_view
from merl.training.live_view import LiveView, describe, sparkline
from merl.training.loop import StepResult

METRICS = {
    "train/return": 12.34,
    "train/success_end": 1.0,
    "time/steps_per_second": 33.0,
    "time/updates_per_second": 17.0,
    "learn/q": 4.5,
    "learn/critic_loss": 0.25,
}
SCALE = {"random actions": 7.8, "scripted expert": 219.4}


class Clock:
    """Replacement of `time.perf_counter`, whose time a test sets."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Replace the clock of the live view by one that only the test advances."""
    clock = Clock()
    monkeypatch.setattr(live_view.time, "perf_counter", clock)
    return clock


def episodes() -> list[Episode]:
    won, lost = Episode(), Episode()
    won.add(2.0, {"success": 1.0})
    lost.add(1.0, {"success": 0.0})
    return [won, lost]


def evaluation_of(value: float) -> Evaluation:
    episode = Episode()
    episode.add(value, {})
    return summarize([episode])


def new_run(steps: int = 1000, minutes: float | None = None, path: Path = Path("nowhere")) -> Any:
    config = SimpleNamespace(
        steps=steps,
        minutes=minutes,
        seed_steps=100,
        num_envs=1,
        eval=SimpleNamespace(every=250),
    )
    return SimpleNamespace(config=config, path=path)


def trainer_of(run: Any, step: int) -> Any:
    setup = SimpleNamespace(progress=SimpleNamespace(step=step))
    return SimpleNamespace(run=run, setup=setup)


def show_step(view: LiveView, result: StepResult, metrics: dict[str, float]) -> None:
    view.on_step(result)
    if metrics:
        view.on_episode(result.step, metrics)


def console_of(terminal: bool, width: int = 100, encoding: str = "utf-8") -> Console:
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding, write_through=True)
    return Console(
        file=file, force_terminal=terminal, force_interactive=terminal, width=width, markup=False
    )


def text_of(console: Console) -> str:
    file: Any = console.file
    return file.buffer.getvalue().decode(file.encoding)


def drawn(view: LiveView) -> str:
    """Return the text of the live table, with single spaces."""
    with view.console.capture() as capture:
        view.console.print(view._draw())
    return flat(re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", capture.get()))


def watch(terminal: bool, width: int = 100, encoding: str = "utf-8") -> str:
    console = console_of(terminal, width, encoding)
    view = LiveView(console, SCALE)
    view.on_start(trainer_of(new_run(), 0))
    for step in range(1, 251):
        show_step(view, StepResult(step, step), METRICS if step == 250 else {})
    view.on_evaluation_step(0, 2)
    view.on_evaluation(250, summarize(episodes()))
    view.on_evaluation(251, evaluation_of(219.4))
    view.on_warning("the disk is full")
    view.on_checkpoint(250)
    view.on_end(None)
    return text_of(console)


def test_a_terminal_shows_progress_speed_and_results() -> None:
    for width in (60, 100):
        shown = flat(watch(terminal=True, width=width))
        for text in ("250 of 1,000", "33 steps/s, 17 updates/s", "return 12.3, success 100%"):
            assert text in shown
        for text in ("Q 4.50", "at step 250", "warning: the disk is full", "saved at step 250"):
            assert text in shown
        assert shown.rstrip().endswith("\x1b[?25h")  # shows the cursor again


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_output_other_than_a_terminal_gets_plain_lines(encoding: str) -> None:
    shown = watch(terminal=False, width=60, encoding=encoding)
    assert shown.replace("\n", "").isprintable()
    lines = shown.splitlines()
    assert lines[0] == "returns to compare with: random actions 7.8, scripted expert 219.4"
    assert lines[1].startswith("evaluation at step 250: return 1.5 [1.0, 2.0], success 50%")
    assert lines[1].endswith("; at first an agent is often below random actions")
    assert "below" not in lines[2]
    high = "█" if encoding == "utf-8" else "#"
    assert lines[3].startswith("returns of all evaluations: ")
    assert f"{high} (scale: 1.5 to 219.4)" in lines[3]
    assert lines[4] == "warning: the disk is full"


def test_an_ascii_terminal_gets_only_ascii() -> None:
    watch(terminal=True, width=60, encoding="ascii")  # would raise UnicodeEncodeError


def test_plain_lines_are_printed_at_intervals_with_position_and_speed(clock: Clock) -> None:
    console = console_of(terminal=False)
    view = LiveView(console)
    view.on_start(trainer_of(new_run(minutes=10.0), 0))
    for step, seconds in ((200, 10.0), (300, 25.0), (400, 31.0), (450, 40.0)):
        clock.seconds = 100.0 + seconds
        show_step(view, StepResult(step, step - 100), METRICS)
    (line,) = text_of(console).splitlines()
    assert line.startswith("00:31 of 10:00, or step 400 of 1,000 (40%, 01:03 left): training")
    assert line.endswith("noise); 33 steps/s, 17 updates/s")


@pytest.mark.parametrize(
    ("minutes", "step", "seconds", "percent"),
    [
        (None, 250, 1e6, "25%"),
        (10.0, 250, 60.0, "25%"),  # the steps are reached first
        (10.0, 10, 300.0, "50%"),  # the minutes are reached first
        (10.0, 10, 900.0, "100%"),  # the last evaluation
    ],
)
def test_the_progress_bar_uses_the_limit_that_is_reached_first(
    minutes: float | None, step: int, seconds: float, percent: str, clock: Clock
) -> None:
    view = LiveView(console_of(terminal=False))
    view.on_start(trainer_of(new_run(minutes=minutes), 0))
    show_step(view, StepResult(step, 0), {})
    clock.seconds += seconds
    shown = drawn(view)
    assert shown.startswith(f"{percent} ")
    if minutes is not None:
        assert f"{min(seconds, 600) / 60:02.0f}:00 of 10:00, or step {step}" in shown


def test_the_time_left_uses_the_speed_with_updates(clock: Clock) -> None:
    """Steps without updates are much faster, and the estimate would be far too short."""
    view = LiveView(console_of(terminal=False))
    view.on_start(trainer_of(new_run(), 0))
    clock.seconds += 10.0
    show_step(view, StepResult(100, 0), {})
    assert "left" not in drawn(view)
    show_step(view, StepResult(101, 1), {})
    clock.seconds += 100.0
    show_step(view, StepResult(201, 101), {})  # one step per second
    assert "13:19 left" in drawn(view)
    clock.seconds += 800.0
    show_step(view, StepResult(1000, 900), {})
    assert "left" not in drawn(view)


def test_a_return_below_random_actions_is_explained() -> None:
    view = LiveView(console_of(terminal=False), SCALE)
    view.on_start(trainer_of(new_run(), 0))
    assert "compare with random actions 7.8, scripted expert 219.4" in drawn(view)
    assert "below" not in drawn(view)
    show_step(view, StepResult(50, 0), METRICS | {"train/return": 0.0})
    shown = drawn(view)
    assert "return 0.0" in shown
    assert "learning begins at step 100" in shown
    assert "at first an agent is often below random actions" in shown
    view.on_evaluation(250, evaluation_of(100.0))
    assert "below" not in drawn(view)


def test_before_the_first_evaluation_its_step_is_shown() -> None:
    view = LiveView(console_of(terminal=False))
    view.on_start(trainer_of(new_run(), 0))
    shown = drawn(view)
    assert "evaluation first one after step 250, or at the end" in shown
    assert "compare with" not in shown  # no references are known


def test_a_training_episode_without_a_success_report_counts_as_failed() -> None:
    view = LiveView(console_of(terminal=False))
    view.on_start(trainer_of(new_run(), 0))
    without_report = {name: value for name, value in METRICS.items() if "success" not in name}
    for step, metrics in enumerate((METRICS, *[without_report] * 3)):
        show_step(view, StepResult(step, 0), metrics)
    assert "success 25%" in drawn(view)


@pytest.mark.parametrize("missing", ["learn/q", "learn/critic_loss"])
def test_an_agent_that_does_not_report_both_is_shown_without_them(missing: str) -> None:
    view = LiveView(console_of(terminal=False))
    view.on_start(trainer_of(new_run(), 0))
    reported = {name: value for name, value in METRICS.items() if name != missing}
    show_step(view, StepResult(200, 100), reported)
    assert "learner" not in drawn(view)
    show_step(view, StepResult(201, 101), METRICS)
    assert "learner Q 4.50, critic loss 0.25" in drawn(view)


def test_a_resumed_run_shows_its_earlier_evaluations(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("step,train/return,eval/return\n10,1,\n20,2,0.0\n")
    view = LiveView(console_of(terminal=False))
    view.on_start(trainer_of(new_run(path=tmp_path), 20))
    view.on_evaluation(30, evaluation_of(5.0))
    assert "evaluations ▁█ (scale: 0.0 to 5.0)" in drawn(view)


def test_a_sparkline_averages_neighbours_if_there_are_too_many_values() -> None:
    assert sparkline([0.0, 3.5, 7.0], 0.0, 7.0) == "▁▅█"
    assert sparkline([1.0], 1.0, 1.0) == "▁"
    assert sparkline([0.0, 7.0] * 40, 0.0, 7.0, "_.-=+*%#") == "+" * 40


def test_describe_puts_an_evaluation_in_one_line() -> None:
    line = describe(summarize(episodes()))
    assert line.startswith("return 1.5 [1.0, 2.0], success 50% [9%, 91%] at the end")
    assert line.endswith("(2 episodes)")


def test_equal_success_rates_are_printed_once() -> None:
    line = describe(summarize(episodes()[1:]))
    assert line == "return 1.0 [1.0, 1.0], success 0% [0%, 79%] at the end (1 episode)"
