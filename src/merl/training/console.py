"""The live view of a run: progress, speed, what training and evaluation bring."""

from __future__ import annotations

import time
from collections import deque
from datetime import timedelta
from statistics import mean

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table
from rich.text import Text

from merl.core import counted
from merl.training.evaluation import Evaluation
from merl.training.loop import Moment
from merl.training.run import Run

RECENT = 10  # training episodes that the shown means are of
PLAIN_INTERVAL = 30.0  # seconds between lines where there is no terminal


class ConsoleView:
    """Shows a run on a terminal as a live table, elsewhere as plain lines."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TaskProgressColumn(),
            TextColumn("{task.fields[left]}"),
            console=console,
        )
        self._live = Live(console=console, refresh_per_second=4, transient=False)
        self._numbers: dict[str, float] = {}
        self._recent: deque[dict[str, float]] = deque(maxlen=RECENT)
        self._evaluation = Text("none yet", style="dim")
        self._note = ""
        self._said = self._recent_time = time.perf_counter()
        self._recent_step = 0

    def __enter__(self) -> ConsoleView:
        """Begin to draw, once training begins."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last picture standing."""
        if self._live.is_started:
            self._live.update(self._picture(), refresh=True)
            self._live.stop()

    def begin(self, run: Run, step: int) -> None:
        """Training begins or goes on."""
        self._total, self._minutes = run.config.steps, run.config.minutes
        self._task = self._bar.add_task("steps", total=self._total, left="")
        self._start = time.perf_counter()
        self._recent_step = step
        if self.console.is_terminal:
            self._live.start()

    def moment(self, moment: Moment, metrics: dict[str, float]) -> None:
        """A step was taken."""
        self._bar.update(
            self._task,
            completed=moment.step,
            description=f"step {moment.step:,} of {self._total:,}",
            left=self._time_left(moment.step),
        )
        if metrics:
            self._numbers = metrics
            self._recent.append(metrics)
            self._show(moment)

    def evaluating(self, episode: int, total: int) -> None:
        """An evaluation goes on: the episode's index, of how many."""
        note = f"evaluating: episode {episode + 1} of {total}"
        if note != self._note and self._live.is_started:
            self._note = note
            self._live.update(self._picture())

    def evaluated(self, step: int, evaluation: Evaluation) -> None:
        """An evaluation is done."""
        self._note = ""
        self._evaluation = Text(f"at step {step:,}: {describe(evaluation)}")
        if not self.console.is_terminal:
            self.console.print(f"evaluation at step {step:,}: {describe(evaluation)}")

    def saved(self, step: int) -> None:
        """A checkpoint is on the disk."""
        self._note = f"saved at step {step:,}"

    def warn(self, message: str) -> None:
        """Something that the user should know."""
        self.console.print(f"warning: {message}", style="yellow", markup=False)

    def _show(self, moment: Moment) -> None:
        if self._live.is_started:
            self._live.update(self._picture())
        elif time.perf_counter() - self._said > PLAIN_INTERVAL:
            self._said = time.perf_counter()
            n = self._numbers
            self.console.print(
                f"step {moment.step:,}/{self._total:,}  "
                f"{self._training()}  "
                f"{n['time/steps_per_second']:.0f} steps/s  "
                f"{n['time/updates_per_second']:.0f} updates/s  "
                f"{self._time_left(moment.step)}",
                highlight=False,
            )

    def _time_left(self, step: int) -> str:
        """From the pace of this stretch; bounded by the minutes that it may take."""
        passed = time.perf_counter() - self._start
        taken = step - self._recent_step
        if passed < 5 or taken < 50:
            return ""
        left = (self._total - step) * passed / taken
        if self._minutes is not None:
            left = min(left, max(0.0, self._minutes * 60 - passed))
        return f"{timedelta(seconds=round(left))} left"

    def _picture(self) -> Group:
        n = self._numbers
        table = Table.grid(padding=(0, 3))
        if n:
            table.add_row(
                "speed",
                f"{n['time/steps_per_second']:.0f} steps/s",
                f"{n['time/updates_per_second']:.0f} updates/s",
            )
            table.add_row("training", self._training())
            if "learn/q" in n:
                table.add_row(
                    "learner", f"Q {n['learn/q']:.2f}", f"critic loss {n['learn/critic_loss']:.2g}"
                )
        table.add_row("evaluation", self._evaluation)
        return Group(self._bar, table, Text(self._note, style="dim"))

    def _training(self) -> str:
        """Return and success of the last training episodes, noise and all."""
        values = f"return {mean(row['train/return'] for row in self._recent):.1f}"
        ends = [row["train/success_end"] for row in self._recent if "train/success_end" in row]
        if ends:
            values += f", success {mean(ends):.0%}"
        return f"{values} (last {len(self._recent)})"


def describe(evaluation: Evaluation) -> str:
    """An evaluation in one line, with its intervals."""
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
