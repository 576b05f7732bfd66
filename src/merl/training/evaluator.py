"""The evaluations of a run: their schedule, their results, and the handling of failures."""

from __future__ import annotations

from collections.abc import Callable

from merl.callbacks import Callback
from merl.core import EvaluationFailed, MerlError
from merl.core.signals import Interrupt
from merl.core.user_code import in_one_line
from merl.evaluation.evaluation import Evaluation, evaluate
from merl.evaluation.policy import Policy
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.meters import Clock
from merl.training.setup import Setup

ATTEMPTS = 3
"""Maximum number of attempts at an evaluation during which the process crashes or is killed; after
that, it is skipped."""


class _Interrupted(Exception):  # noqa: N818 (not an error)
    """An exception that ends an evaluation early after a signal."""


class Evaluations:
    """The evaluations of a run's agent and their results.

    Args:
        setup: agent, environment and progress.
        run: the run's folder.
        clock: provides the training time of the run.
        callbacks: notified of evaluations and warnings.
        interrupt: signals; the first one ends an evaluation immediately.

    Attributes:
        last: the last evaluation; None before the first.
        row: the metrics of the last evaluation, by their names in `metrics.csv`.
    """

    def __init__(
        self,
        setup: Setup,
        run: Run,
        clock: Clock,
        callbacks: Callback,
        interrupt: Interrupt,
    ) -> None:
        self._setup, self._config, self._run = setup, setup.config, run
        self._clock, self._callbacks, self._interrupt = clock, callbacks, interrupt
        self.last: Evaluation | None = None
        self.row: dict[str, float] = {}
        self._warned = set[str]()

    def are_due(self) -> bool:
        """Return whether an evaluation is due; False after the last step of training."""
        progress, every = self._setup.progress, self._config.eval.every
        if not every or progress.step >= self._config.steps:
            return False
        return progress.step // every > progress.evaluated // every

    def run(self, save: Callable[[], bool], *, last: bool = False) -> None:
        """Save a checkpoint, so that a failing evaluation loses no training, and evaluate.

        Args:
            save: writes a checkpoint; returns whether it is on the disk.
            last: whether this is the evaluation at the end of training.

        Raises:
            EvaluationFailed: the evaluation raised an exception. The resumed run repeats it; if it
                fails again, the run skips it with a warning, and later evaluations that fail, too,
                until one succeeds.
        """
        progress, previous = self._setup.progress, self.last
        progress.attempts += 1
        if progress.attempts > ATTEMPTS:
            self._skip(f"was started {ATTEMPTS} times and never finished")
            return
        save()
        try:
            self.last = self._evaluate(last)
        except Exception as error:
            if isinstance(error, _Interrupted) or self._interrupt.number is not None:
                progress.attempts -= 1
                return
            self._fail(error, save)
            return
        self._run.check_there()
        progress.evaluated, progress.attempts = progress.step, 0
        progress.reports_success |= self.last.success_end is not None
        self.row = {f"eval/{name}": value for name, value in self.last.metrics().items()}
        self.row["time/seconds"] = self._clock.seconds()
        self._callbacks.on_evaluation(progress.step, self.last)
        if previous is not None and not self.last.starts_as(previous):
            self._warn_once(
                "the episodes of this evaluation start differently from those of the previous one, "
                "although the seeds are the same: the environment or one of its wrappers keeps "
                "state across resets, or ignores the seed"
            )

    def _evaluate(self, last: bool) -> Evaluation:
        """Run the episodes of an evaluation."""
        setup, config = self._setup, self._config.eval
        step = setup.progress.step
        assert setup.eval_env is not None
        policy = Policy(setup.agent, self._config, setup.space, setup.device, step)
        is_due = config.video == "each" or (config.video == "last" and last)
        record = setup.records_video and is_due
        return evaluate(
            policy,
            setup.eval_env,
            config.episodes,
            reset=policy.reset,
            video=self._run.videos / f"{step:08d}.mp4" if record else None,
            tick=self._on_step,
            warn=self._warn_once,
            max_steps=self._config.eval_steps,
            reports_success=setup.progress.reports_success,
        )

    def _fail(self, error: Exception, save: Callable[[], bool]) -> None:
        """Handle an evaluation's exception: end the run, or skip the evaluation.

        Skip it if it was started before, or if the previous evaluation was skipped, so that a
        resumed run does not end with the same failure again.
        """
        self._run.check_there()
        why = in_one_line(error)
        if self._setup.progress.attempts > 1:
            self._skip(f"failed again: {why}")
            return
        line = resume_line(self._run.path)
        saved = f"the run is saved at that step: fix the cause, and resume with `{line}`"
        if not save():
            saved = f"resume from the last checkpoint with `{line}`"
        step = self._setup.progress.step
        failure = EvaluationFailed(f"the evaluation at step {step:,} failed: {why}; {saved}")
        if isinstance(error, MerlError):
            failure.exit_code = error.exit_code
        raise failure from error

    def _skip(self, why: str) -> None:
        """Skip the evaluation that is due, with a warning."""
        progress = self._setup.progress
        progress.evaluated, progress.attempts = progress.step, 1
        self._callbacks.on_warning(
            f"the evaluation at step {progress.step:,} {why}; the run continues without it"
        )

    def _warn_once(self, message: str) -> None:
        """Warn, but only once with the same message, which every evaluation would repeat."""
        if message not in self._warned:
            self._warned.add(message)
            self._callbacks.on_warning(message)

    def _on_step(self, episode: int) -> None:
        """Notify the callbacks of a step of an evaluation; end it if a signal has arrived."""
        if self._interrupt.number is not None:
            raise _Interrupted
        self._callbacks.on_evaluation_step(episode, self._config.eval.episodes)
