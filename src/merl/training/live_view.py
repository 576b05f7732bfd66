"""The live view of a run: progress, speed, and the results of training and evaluation."""

from __future__ import annotations

import io
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from importlib import import_module
from statistics import mean
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from merl.callbacks import Callback
from merl.core import METRICS_FILE, counted
from merl.evaluation.evaluation import Evaluation
from merl.runs.metrics import read_rows
from merl.training.loop import StepResult

if TYPE_CHECKING:
    from merl.training.outcome import Outcome
    from merl.training.trainer import Trainer

RECENT = 10
"""Number of training episodes in the shown means; with more environments, one of each."""
PLAIN_INTERVAL = 30.0
"""Seconds between two progress lines if the output is not a terminal."""
SPARKS = "▁▂▃▄▅▆▇█"
ASCII_SPARKS = "_.-=+*%#"
SPARK_WIDTH = 40
"""Maximum length of a sparkline in characters; neighbours are averaged if there are more values."""


class LiveView(Callback):
    """View of a run: a live table in a terminal or a notebook, plain lines in other output.

    Args:
        console: where to print; by default the standard output.
        scale: {name: return} of references, e.g. random actions and an expert, from the lowest to
            the highest return; empty if unknown.
    """

    def __init__(
        self, console: Console | None = None, scale: Mapping[str, float] | None = None
    ) -> None:
        is_notebook = console is None and Console().is_jupyter
        # Jupyter asks for colours as a terminal does, but does not move the cursor.
        plain: Any = {"force_jupyter": False, "force_terminal": False} if is_notebook else {}
        self.console = console or Console(markup=False, highlight=False, **plain)
        self._scale = dict(scale or {})
        self._speed = self._training = self._learner = self._evaluation = self._note = ""
        self._recent: deque[Mapping[str, float]] = deque(maxlen=RECENT)
        self._returns: list[float] = []  # mean returns of all evaluations
        self._training_return: float | None = None  # of the last episode
        self._step = self._updates = self._total = self._learning_starts = 0
        self._minutes: float | None = None
        self._start = self._printed = time.perf_counter()
        self._learning_since: tuple[float, int] | None = None  # time and step of the first update
        self._live: Live | _Cell | None = None
        if is_notebook:
            self._live = _Cell(self._draw)
        elif self.console.is_interactive:
            # Rich draws in another thread: replace objects, do not change them in place.
            self._live = Live(console=self.console, refresh_per_second=4, get_renderable=self._draw)

    def on_end(self, outcome: Outcome | None) -> None:
        """Draw the table for the last time and leave it there."""
        if self._live is not None and self._live.is_started:
            self._live.refresh()
            self._live.stop()

    def on_start(self, trainer: Trainer) -> None:
        """Start to show the run."""
        run, config = trainer.run, trainer.run.config
        self._total, self._minutes = config.steps, config.minutes
        self._step = trainer.setup.progress.step
        self._learning_starts = config.seed_steps
        # A row of metrics has the episodes of all environments that ended at one step.
        self._recent = deque(maxlen=max(1, RECENT // config.num_envs))
        _, rows = read_rows(run.path / METRICS_FILE)  # of a resumed run
        self._returns = [float(row["eval/return"]) for row in rows if "eval/return" in row]
        every = config.eval.every
        self._evaluation = f"first one after step {every:,}, or at the end" if every else ""
        self._start = self._printed = time.perf_counter()
        if self._live is not None:
            self._live.start()
        elif self._scale:
            self._print(f"returns to compare with: {self._references()}")

    def on_step(self, result: StepResult) -> bool | None:
        """Show a step of the environments."""
        self._step, self._updates = result.step, result.updates
        if self._learning_since is None and result.updates:
            self._learning_since = time.perf_counter(), result.step
        self._update_cell()
        return None

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """Show the metrics of an episode."""
        if "train/return" in metrics:  # not of an agent that imitates
            self._recent.append(metrics)
            self._training_return = metrics["train/return"]
            self._training = self._recent_training()
        self._speed = (
            f"{metrics['time/steps_per_second']:.0f} steps/s, "
            f"{metrics['time/updates_per_second']:.0f} updates/s"
        )
        if {"learn/q", "learn/critic_loss"} <= metrics.keys():  # a user's agent may lack one
            self._learner = (
                f"Q {metrics['learn/q']:.2f}, critic loss {metrics['learn/critic_loss']:.2g}"
            )
        if self._live is None and time.perf_counter() - self._printed > PLAIN_INTERVAL:
            self._printed = time.perf_counter()
            left = self._time_left()
            self._print(
                f"{self._position()} ({self._fraction():.0%}{f', {left}' if left else ''}): "
                f"{f'training {self._training}; ' if self._training else ''}{self._speed}"
            )

    def on_evaluation_step(self, episode: int, total: int) -> None:
        """Show that an evaluation is in episode `episode` (from 0) of `total`."""
        self._note = f"evaluating: episode {episode + 1} of {total}"
        self._update_cell()

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """Show the result of an evaluation."""
        self._note = ""
        self._returns = [*self._returns, evaluation.returns.mean]
        self._evaluation = f"at step {step:,}: {describe(evaluation)}"
        if self._live is None:
            self._print(f"evaluation {self._evaluation}{self._low_return_note()}")
            if len(self._returns) > 1:
                self._print(f"returns of all evaluations: {self._sparkline()}")

    def on_checkpoint(self, step: int) -> None:
        """Show that a checkpoint was written."""
        self._note = f"saved at step {step:,}"

    def on_warning(self, message: str) -> None:
        """Print a warning."""
        self.console.print(f"warning: {message}", style="yellow", markup=False, soft_wrap=True)

    def _print(self, line: str) -> None:
        self.console.print(line, highlight=False, soft_wrap=True)

    def _update_cell(self) -> None:
        if isinstance(self._live, _Cell):
            self._live.update()

    def _draw(self) -> Group:
        """Return the live table."""
        bar = Table.grid(padding=(0, 1), expand=True)
        bar.add_column()
        bar.add_column(ratio=1)
        bar.add_column()
        fraction = self._fraction()
        bar.add_row(Text(f"{fraction:4.0%}"), ProgressBar(1.0, fraction), Text(self._time_left()))
        rows = {
            "progress": self._position(),
            "speed": self._speed,
            "training": self._training,
            "learner": self._learner,
            "evaluation": self._evaluation,
            "evaluations": self._sparkline() if len(self._returns) > 1 else "",
            "compare with": self._references(),
        }
        table = Table.grid(padding=(0, 2))
        for name, text in rows.items():
            if text:
                table.add_row(Text(name, no_wrap=True), Text(text))
        return Group(bar, table, Text(self._note, style="dim"))

    def _position(self) -> str:
        """Return the steps so far and their limit, and the time if it is limited."""
        steps = f"step {self._step:,} of {self._total:,}"
        if self._minutes is None:
            return steps
        limit = self._minutes * 60
        passed = min(time.perf_counter() - self._start, limit)
        return f"{_clock(passed)} of {_clock(limit)}, or {steps}"

    def _fraction(self) -> float:
        """Return the completed fraction of the limit that is reached first, steps or minutes."""
        fraction = self._step / max(self._total, 1)
        if self._minutes is not None:
            passed = time.perf_counter() - self._start
            fraction = max(fraction, passed / (self._minutes * 60))
        return min(fraction, 1.0)

    def _time_left(self) -> str:
        """Estimate the time to the limit that is reached first; return "" while it is unknown.

        Use only the speed since the first update, since steps before it are much faster.
        """
        now, estimates = time.perf_counter(), []
        if self._minutes is not None:
            estimates.append(self._minutes * 60 - (now - self._start))
        if self._learning_since is not None:
            since, first = self._learning_since
            if now - since >= 5 and self._step - first >= 50:
                estimates.append((self._total - self._step) * (now - since) / (self._step - first))
        left = min(estimates, default=0.0)
        return f"{_clock(left)} left" if left > 0 else ""

    def _recent_training(self) -> str:
        """Format return and success of the last training episodes, which have noise."""
        values = f"return {mean(row['train/return'] for row in self._recent):.1f}"
        name = "train/success_end"
        if any(name in row for row in self._recent):  # a row without this metric is a failure
            values += f", success {mean(row.get(name, 0.0) for row in self._recent):.0%}"
        about = "the newest episodes, with noise"
        if not self._updates:
            about += f"; learning begins at step {self._learning_starts:,}"
        return f"{values} ({about})"

    def _references(self) -> str:
        """Format the returns of the references, and a note if the agent is below all of them."""
        names = ", ".join(f"{name} {value:.1f}" for name, value in self._scale.items())
        return f"{names}{self._low_return_note()}"

    def _low_return_note(self) -> str:
        """Explain why the newest return is below all references; return "" if it is not."""
        newest = self._returns[-1] if self._returns else self._training_return
        if newest is None or not self._scale or newest >= min(self._scale.values()):
            return ""
        return f"; at first an agent is often below {min(self._scale, key=self._scale.__getitem__)}"

    def _sparkline(self) -> str:
        """Draw the returns of all evaluations; the scale includes the references."""
        values = [*self._returns, *self._scale.values()]
        low, high = min(values), max(values)
        encoding = (self.console.encoding or "").lower()
        line = sparkline(self._returns, low, high, SPARKS if "utf" in encoding else ASCII_SPARKS)
        return f"{line} (scale: {low:.1f} to {high:.1f})"


class _Cell:
    """Text in the output of a notebook's cell, replaced twice a second; it needs no widgets.

    Args:
        draw: returns what to show.
    """

    def __init__(self, draw: Callable[[], Group]) -> None:
        self._draw, self._shown = draw, 0.0
        self._handle: Any = None

    @property
    def is_started(self) -> bool:
        return self._handle is not None

    def start(self) -> None:
        display = import_module("IPython.display").display  # every notebook has it
        self._handle = display({"text/plain": ""}, raw=True, display_id=True)
        self.refresh()

    def update(self) -> None:
        if time.perf_counter() - self._shown > 0.5:
            self.refresh()

    def refresh(self) -> None:
        text = io.StringIO()
        console = Console(file=text, width=100, force_jupyter=False, force_terminal=False)
        console.print(self._draw())
        self._handle.update({"text/plain": text.getvalue()}, raw=True)
        self._shown = time.perf_counter()

    def stop(self) -> None:
        self._handle = None


def sparkline(values: Sequence[float], low: float, high: float, levels: str = SPARKS) -> str:
    """Draw values as one line of characters.

    Args:
        values: at least one value; if more than `SPARK_WIDTH`, groups of neighbours are averaged.
        low: value of the lowest character.
        high: value of the highest character.
        levels: the characters, from the lowest to the highest.
    """
    groups = np.array_split(np.asarray(values), min(len(values), SPARK_WIDTH))
    means = np.array([group.mean() for group in groups])
    height = (means - low) / max(high - low, 1e-9)
    return "".join(levels[index] for index in np.rint(height * (len(levels) - 1)).astype(int))


def _clock(seconds: float) -> str:
    """Format seconds as minutes:seconds or hours:minutes:seconds."""
    text = str(timedelta(seconds=round(seconds)))
    return text.removeprefix("0:")


def describe(evaluation: Evaluation) -> str:
    """Describe an evaluation in one line, with confidence intervals."""
    returns, end = evaluation.returns, evaluation.success_end
    line = f"return {returns.mean:.1f} [{returns.low:.1f}, {returns.high:.1f}]"
    if end is not None and evaluation.success_any and evaluation.success_share:
        line += f", success {end.mean:.0%} [{end.low:.0%}, {end.high:.0%}] at the end"
        if not end.mean == evaluation.success_any.mean == evaluation.success_share.mean:
            line += (
                f", {evaluation.success_any.mean:.0%} at any time, "
                f"{evaluation.success_share.mean:.0%} of the steps"
            )
    return f"{line} ({counted(len(evaluation.episodes), 'episode')})"
