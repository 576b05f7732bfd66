"""One stretch of training: drives the loop, and between its steps measures, evaluates and saves."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from merl.acting.environments import Environments, WorkerDied
from merl.acting.rollout import FrameStack, mean_metrics, report_success
from merl.core import (
    EnvironmentFailed,
    EnvironmentsLost,
    EvaluationFailed,
    MerlError,
    NotFinite,
    counted,
    is_image,
)
from merl.core.guards import LossGuard
from merl.core.signals import Interrupt
from merl.evaluation.evaluation import Evaluation
from merl.replay import ReplayBuffer
from merl.runs import checkpoint
from merl.runs.checkpoint import Checkpoint
from merl.runs.metrics import MetricsWriter
from merl.runs.plain import to_plain
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.evaluator import Evaluations
from merl.training.loop import Collector, Progress, StepResult, train
from merl.training.meters import Averages, Clock, Interval
from merl.training.parts import Parts
from merl.training.updating import make_update

LONG = 2000
"""Steps of an episode from which on the user is asked whether it will ever end; or half of the
run's, if that is less."""


class View(Protocol):
    """Who watches a run."""

    def begin(self, run: Run, step: int) -> None:
        """Training begins, or goes on from there."""

    def moment(self, moment: StepResult, metrics: dict[str, float]) -> None:
        """A step was taken; `metrics` is empty unless an episode ended."""

    def evaluating(self, episode: int, total: int) -> None:
        """A step of an evaluation: the episode's index, of how many."""

    def evaluated(self, step: int, evaluation: Evaluation) -> None:
        """An evaluation is done."""

    def saved(self, step: int) -> None:
        """A checkpoint is on the disk."""

    def warn(self, message: str) -> None:
        """Something that the user should know and that does not stop the run."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        run: its folder and config.
        progress: where it stands.
        evaluation: the last one, if there was any.
        signal: what interrupted it; None if it ran to its end.
        saved: whether its last checkpoint is on the disk.
        unwritten: rows of metrics that could not be written.
    """

    run: Run
    progress: Progress
    evaluation: Evaluation | None
    signal: int | None
    saved: bool
    unwritten: int = 0


class Stretch:
    """One stretch of training, from start or resume to the end or an interruption."""

    def __init__(
        self,
        parts: Parts,
        run: Run,
        replay: ReplayBuffer,
        environments: Environments,
        metrics: MetricsWriter,
        view: View,
        interrupt: Interrupt,
    ) -> None:
        self.parts, self.config, self.run = parts, parts.config, run
        self.replay, self.environments = replay, environments
        self.metrics, self.view, self.interrupt = metrics, view, interrupt
        self.clock, self.averages, self.guard = Clock(), Averages(), LossGuard()
        self.evaluations = Evaluations(parts, run, metrics, view, interrupt)
        self.losses = 0
        self._saved: dict[str, Any] | None = None  # the progress at the last save
        self._ended: int | None = None  # the last episode's step, until it is long ago
        self._states: Sequence[Mapping[str, Any] | None] = [None] * environments.count
        self._interval = Interval(self.config.save_every)

    def train(self) -> Outcome:
        """Drive the loop to its end; if the environment fails, save before raising.

        Once a signal has arrived, the run ends as stopped, whatever fails because of the signal.

        Raises:
            EnvironmentFailed: the user's environment failed; the run can be resumed.
            EvaluationFailed: an evaluation failed; the run can be resumed.
            NotFinite: an observation or a reward is NaN or infinite, and the run can be resumed; or
                a loss or a weight is, and nothing newer than the last checkpoint is usable.
        """
        try:
            return self._drive()
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):  # by a handler of the environment's
                self.interrupt.note(signal.SIGINT)
            if self.interrupt.number is not None:
                return self._outcome(self._save())
            step, line = self.parts.progress.step, resume_line(self.run.path)
            if isinstance(error, EvaluationFailed | EnvironmentsLost) or not self._rescue():
                raise
            saved = f"the run is saved at step {step:,}: mend it, and go on with `{line}`"
            if isinstance(error, EnvironmentFailed | NotFinite):
                raise type(error)(f"{error}; {saved}") from error
            self.view.warn(saved)
            raise

    def _rescue(self) -> bool:
        """Save after an error, if there is anything to save; returns whether it succeeded."""
        try:
            return self.parts.progress.step > 0 and self._save()
        except Exception:  # the weights are not finite, or the folder is gone
            return False

    def _drive(self) -> Outcome:
        """Between the loop's steps log, evaluate, save, and see whether to stop."""
        parts, progress = self.parts, self.parts.progress
        images = tuple(key for key in parts.space if is_image(parts.space[key]))
        stacks = [
            FrameStack(self.config.replay.frame_stack, images, parts.device)
            for _ in range(self.environments.count)
        ]
        stage = Collector(self.environments, self.replay, stacks)
        update = make_update(
            parts.agent,
            self.replay,
            parts.randomness,
            self.config,
            self.view.warn,
            progress.updates,
        )
        self.view.begin(self.run, progress.step)
        evaluates = parts.eval_env is not None
        if evaluates and not parts.films and self.config.eval.video != "none":
            self.view.warn("there will be no videos: the environment does not render to an array")
        if progress.step == 0 and not self._save():  # there must be something to go on from
            raise MerlError(
                f"no checkpoint can be written into {self.run.path}: make room on its disk, or "
                "name a folder on another with --run-dir"
            )
        if progress.step and self.evaluations.are_due() and not self.replay.state_dict()["open"]:
            self._evaluate()  # the run was left before it or within it
            self._save()
        self.clock.mark(progress)
        self._ended = progress.step
        moments = train(
            stage,
            parts.agent,
            update,
            progress,
            parts.randomness,
            self.config,
            lambda: self.interrupt.number is not None,
        )
        for count, moment in enumerate(moments):
            if count == 0 and not moment.lost and not self._resumes_exactly():
                self.view.warn(
                    "a resumed run will meet other episodes than this one would, unless the "
                    "environment draws from Gymnasium's np_random, or from the global generators "
                    "of NumPy, Python or torch"
                )
            self.guard.watch(moment.learning, moment.step)
            self.averages.add(moment.learning)
            self._watch_for_episode_end(moment)
            if moment.lost and not self._is_to_stop():
                self._lost(moment.lost)
            self.view.moment(moment, self._log(moment) if moment.episodes else {})
            if self._is_to_stop():
                break
            if moment.episodes:
                self._at_episode_end()
            elif self._interval.is_overdue():
                self._save(within=True)
            if self._is_to_stop():
                break
        if evaluates and self.interrupt.number is None and progress.evaluated < progress.step:
            self._evaluate(last=True)
        return self._outcome(self._save())

    def _outcome(self, saved: bool) -> Outcome:
        number = self.interrupt.number
        return Outcome(self.run, self.parts.progress, self.evaluations.last, number, saved)

    def _resumes_exactly(self) -> bool:
        """Whether the checkpoint holds the state of the generators that Gymnasium gives."""
        return all(state and "bit_generator" in state for state in self._environment_states())

    def restore(self, start: Checkpoint) -> None:
        """Continue from a checkpoint.

        Raises:
            MerlError: the checkpoint cannot be used.
            EnvironmentsLost: an environment's process died.
        """
        parts, state = self.parts, start.state()
        checkpoint.load_agent(parts.agent, start)
        try:
            with checkpoint.readable(start):
                counts = state["progress"]
                if not all(isinstance(count, int) and count >= 0 for count in counts.values()):
                    raise TypeError(f"progress is {counts}")
                parts.progress = Progress(**counts)
                parts.randomness.load_state_dict(state["randomness"])
                self.replay.load_state_dict(state["replay"])
                states = state["environment"]
                self._states = states if isinstance(states, list) else [states]
                self.environments.restore(self._states)
                self.clock = Clock(float(state["seconds"]), float(state["cpu_seconds"]))
        except WorkerDied as lost:
            raise EnvironmentsLost(
                f"an environment's process {lost} right after its start: see what it said above"
            ) from None
        self.metrics.trim(parts.progress.step)

    def _watch_for_episode_end(self, moment: StepResult) -> None:
        """Warn, once, if no episode ends: metrics and evaluations wait for that."""
        long = min(LONG * self.environments.count, max(1, self.config.steps // 2))
        if moment.episodes:
            self._ended = moment.step
        elif self._ended is not None and moment.step - self._ended > long:
            self._ended = None
            self.view.warn(
                f"no episode has ended in {long:,} steps, and nothing is logged or evaluated until "
                "one does: an environment whose episodes have no end needs "
                "gymnasium.wrappers.TimeLimit"
            )

    def _lost(self, what: str) -> None:
        """An environment's process was lost: they are started again, if not too often.

        Raises:
            EnvironmentsLost: too often; the run is saved.
        """
        self.losses += 1
        most = self.config.worker_restarts
        if self.losses > most:
            self._save()
            step = self.parts.progress.step
            saved = f"the run is saved at step {step:,}; go on with `{resume_line(self.run.path)}`"
            raise EnvironmentsLost(
                f"an environment's process {what}, after {counted(most, 'restart')}: "
                + (saved if step else "the run ends before its first step")
            )
        self.view.warn(
            f"an environment's process {what}: starting the environments again (restart "
            f"{self.losses} of {most})"
        )

    def _is_to_stop(self) -> bool:
        """By a signal, or because the minutes of this stretch are over."""
        minutes = self.config.minutes
        spent = minutes is not None and self.clock.stretch() > minutes * 60
        return spent or self.interrupt.number is not None

    def _at_episode_end(self) -> None:
        if self.evaluations.are_due():
            self._evaluate()
            self._save()
        elif self._interval.is_due():
            self._save()

    def _log(self, moment: StepResult) -> dict[str, float]:
        """A row of metrics for the episode that has ended."""
        self.guard.check()
        self.run.check_there()
        progress = self.parts.progress
        progress.reports_success |= report_success(moment.episodes)
        means = mean_metrics(moment.episodes, reports_success=progress.reports_success)
        values = {f"train/{k}": v for k, v in means.items()}
        values |= self.averages.take()
        values |= self.clock.rates(self.parts.progress)
        values["replay/steps"] = float(len(self.replay))
        if self.config.has_workers:
            values["workers/restarts"] = float(self.parts.progress.restarts)
        self.metrics.write(moment.step, values)
        return values

    def _evaluate(self, last: bool = False) -> None:
        self.evaluations.run(self._save, self.clock, last=last)
        self.clock.mark(self.parts.progress)  # evaluating is not counted against the speed

    def _environment_states(self) -> Sequence[Mapping[str, Any] | None]:
        """Return the states of the environments; of those that are lost, the last known."""
        with suppress(WorkerDied):
            self._states = self.environments.states()
        return self._states

    def _save(self, within: bool = False) -> bool:
        """Write a checkpoint, unless the last one is of the present state.

        A checkpoint that cannot be written is a warning, and does not stop the run.

        Args:
            within: it is written within an episode that takes long.

        Returns:
            Whether a checkpoint of the present state is on the disk.

        Raises:
            MerlError: the run's folder is gone, or what would be saved is no longer finite.
        """
        self.guard.check()
        self.run.check_there()
        parts, progress = self.parts, self.parts.progress
        if self._saved == dataclasses.asdict(progress):
            return True
        last = self.evaluations.last
        fresh = last is not None and progress.evaluated == progress.step
        state = {
            "progress": dataclasses.asdict(progress),
            "randomness": parts.randomness.state_dict(),
            "replay": self.replay.state_dict(),
            "environment": self._environment_states(),
            "seconds": self.clock.seconds(),
            "cpu_seconds": self.clock.cpu_seconds(),
            "env": to_plain(self.config.env),
        }
        try:
            self.replay.flush()
            checkpoint.save(
                self.run.checkpoints,
                progress.step,
                parts.agent,
                state,
                score=last.returns.mean if fresh and last else None,
                keep=self.config.keep,
            )
        except OSError as error:
            self.run.check_there()
            reason = error.strerror or error
            self.view.warn(f"the checkpoint at step {progress.step} was not written: {reason}")
            return False
        finally:
            self._interval.saved(within)
        self._saved = dataclasses.asdict(progress)
        self.replay.settle()
        self.view.saved(progress.step)
        return True
