"""The evaluations of a run: when they are due, and what becomes of the run if one fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from merl.core import EvaluationFailed, MerlError
from merl.core.signals import Interrupt
from merl.envs.wrappers import in_one_line
from merl.evaluation.evaluation import Evaluation, Policy, evaluate
from merl.runs.metrics import MetricsWriter
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.meters import Clock
from merl.training.parts import Parts

if TYPE_CHECKING:
    from merl.training.stretch import View

ATTEMPTS = 3
"""Attempts at an evaluation that is killed or crashes the process; then it is left out."""


class _Interrupted(Exception):  # noqa: N818 (no error, a way out)
    """An evaluation is to end before its time."""


class Evaluations:
    """Evaluates the agent of a run, and records and shows the result.

    Args:
        parts: agent, environment and progress.
        run: its folder.
        metrics: receives the numbers.
        view: shows them.
        interrupt: ends an evaluation at once.

    Attributes:
        last: the last evaluation; None before the first.
    """

    def __init__(
        self,
        parts: Parts,
        run: Run,
        metrics: MetricsWriter,
        view: View,
        interrupt: Interrupt,
    ) -> None:
        self._parts, self._config, self._run = parts, parts.config, run
        self._metrics, self._view, self._interrupt = metrics, view, interrupt
        self.last: Evaluation | None = None
        self._warned = set[str]()

    def are_due(self) -> bool:
        """Whether to evaluate before training continues; the last evaluation comes after it."""
        progress, every = self._parts.progress, self._config.eval.every
        if not every or progress.step >= self._config.steps:
            return False
        return progress.step // every > progress.evaluated // every

    def run(self, save: Callable[[], bool], clock: Clock, *, last: bool = False) -> None:
        """Evaluate, after a save: whatever the evaluation does, no training is lost.

        Args:
            save: writes a checkpoint; returns whether it is on the disk.
            clock: tells the time of the run.
            last: no more training follows.

        Raises:
            EvaluationFailed: it ended by an exception. The resumed run repeats it, and from then on
                leaves out those that fail, with a warning.
        """
        progress, before = self._parts.progress, self.last
        progress.attempts += 1
        if progress.attempts > ATTEMPTS:
            self._leave_out(f"was begun {ATTEMPTS} times and never finished")
            return
        save()
        try:
            self.last = self._measured(last)
        except Exception as error:
            if isinstance(error, _Interrupted) or self._interrupt.number is not None:
                progress.attempts -= 1
                return
            self._fail(error, save)
            return
        self._run.check_there()
        progress.evaluated, progress.attempts = progress.step, 0
        progress.reports_success |= self.last.success_end is not None
        values = {f"eval/{name}": value for name, value in self.last.metrics().items()}
        self._metrics.write(progress.step, values | {"time/seconds": clock.seconds()})
        self._view.evaluated(progress.step, self.last)
        if before is not None and not self.last.starts_as(before):
            self._warn_once(
                "the episodes of this evaluation do not start as those of the one before, with the "
                "same seeds: the environment or a wrapper of it keeps state across resets, or does "
                "not follow its seed"
            )

    def _measured(self, last: bool) -> Evaluation:
        """Run the episodes of an evaluation."""
        parts, config = self._parts, self._config.eval
        step = parts.progress.step
        assert parts.eval_env is not None
        policy = Policy(parts.agent, self._config, parts.space, parts.device, step)
        film = parts.films and (config.video == "each" or (config.video == "last" and last))
        return evaluate(
            policy,
            parts.eval_env,
            config.episodes,
            reset=policy.reset,
            video=self._run.videos / f"{step:08d}.mp4" if film else None,
            tick=self._evaluating,
            warn=self._warn_once,
            max_steps=self._config.eval_steps,
            reports_success=parts.progress.reports_success,
        )

    def _fail(self, error: Exception, save: Callable[[], bool]) -> None:
        """Handle an evaluation's exception: end the run, or leave the evaluation out.

        It is left out if it was begun before, or if the evaluation before it was left out: so a
        resumed run does not end by the same failure again.
        """
        self._run.check_there()
        why = str(error) if isinstance(error, MerlError) else in_one_line(error)
        if self._parts.progress.attempts > 1:
            self._leave_out(f"failed again: {why}")
            return
        line = resume_line(self._run.path)
        saved = f"the run is saved at that step: mend it, and go on with `{line}`"
        if not save():
            saved = f"go on from the last checkpoint with `{line}`"
        step = self._parts.progress.step
        failure = EvaluationFailed(f"the evaluation at step {step:,} failed: {why}; {saved}")
        if isinstance(error, MerlError):
            failure.exit_code = error.exit_code
        raise failure from error

    def _leave_out(self, why: str) -> None:
        """Leave out the evaluation that is due."""
        progress = self._parts.progress
        progress.evaluated, progress.attempts = progress.step, 1
        self._view.warn(
            f"the evaluation at step {progress.step:,} {why}; the run goes on without it"
        )

    def _warn_once(self, message: str) -> None:
        """Warn, unless the same was said before: each evaluation would repeat it."""
        if message not in self._warned:
            self._warned.add(message)
            self._view.warn(message)

    def _evaluating(self, episode: int) -> None:
        """Between two steps of an evaluation; it ends at once if the run is to stop."""
        if self._interrupt.number is not None:
            raise _Interrupted
        self._view.evaluating(episode, self._config.eval.episodes)
