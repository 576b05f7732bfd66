"""The trainer of a run, from its first step or a checkpoint to its end."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass

from merl.acting.environments import Environments, InProcessEnvs
from merl.acting.rollout import FrameStack, mean_metrics, report_success
from merl.acting.run_env import own_bounds
from merl.acting.workers import WorkerEnvs
from merl.agents import load_initial_weights
from merl.config import TrainConfig
from merl.core import (
    EnvironmentFailed,
    EnvironmentsLost,
    EvaluationFailed,
    MerlError,
    NotFinite,
    counted,
)
from merl.core.guards import LossGuard
from merl.core.signals import Interrupt
from merl.evaluation.evaluation import Evaluation
from merl.networks.settings import torch_settings
from merl.replay import ReplayBuffer
from merl.runs.checkpoint import Checkpoint
from merl.runs.metrics import MetricsWriter
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.callbacks import Callback, CallbackList
from merl.training.evaluator import Evaluations
from merl.training.loop import Collector, Progress, StepResult, train
from merl.training.meters import Averages, Clock
from merl.training.saving import Saver
from merl.training.setup import Setup
from merl.training.updating import make_update

LONG = 2000
"""Steps per environment without the end of an episode after which the user is warned; the limit is
half of the run's steps if these are fewer."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    Attributes:
        run: folder and config of the run.
        progress: counts of steps, updates and episodes.
        evaluation: the last evaluation; None if there was none.
        signal: number of the signal that stopped the run; None if no signal stopped it.
        saved: whether a checkpoint of the final state is on the disk.
        unwritten: rows of metrics that could not be written.
    """

    run: Run
    progress: Progress
    evaluation: Evaluation | None
    signal: int | None
    saved: bool
    unwritten: int = 0


class Trainer:
    """Trainer of a run's agent: acts, learns, evaluates, logs and saves.

    The trainer is a context manager that closes the environments at the end:

        with Trainer(config, callbacks) as trainer:
            outcome = trainer.fit()

    Args:
        config: the run's config.
        callbacks: called at the events of training.
        resumed: None for a new run; else the run to resume, whose lock the caller holds, and the
            checkpoint to resume from, or None to start at the first step.

    Attributes:
        setup: environments, agent, progress and random streams.
        config: the run's config, with the values that were chosen for this machine.
        run: the run's folder; set by `fit`.
        replay: the replay buffer; set by `fit`.

    Raises:
        MerlError: the config cannot work on this machine, or the environment differs from that of
            the resumed run.
    """

    run: Run
    replay: ReplayBuffer

    def __init__(
        self,
        config: TrainConfig,
        callbacks: Iterable[Callback] = (),
        *,
        resumed: tuple[Run, Checkpoint | None] | None = None,
    ) -> None:
        with ExitStack() as stack:
            self.setup = stack.enter_context(Setup.prepare(config, new=resumed is None))
            setup = self.setup
            if resumed is not None:
                bounds = own_bounds(setup.env)
                resumed[0].check_environment(setup.space, setup.action_space, bounds)
            if resumed is None or resumed[1] is None:
                load_initial_weights(setup.agent, setup.home)
            self._resources = stack.pop_all()
        self.config, self._resumed = setup.config, resumed
        self._callbacks = CallbackList(callbacks)
        self._averages, self._guard = Averages(), LossGuard()
        self._worker_losses = 0
        self._callback_stops = False  # a callback returned False
        # Step of the last end of an episode; None once the user is warned.
        self._episode_end: int | None = None

    def __enter__(self) -> Trainer:
        """Return the trainer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the environments."""
        self._resources.close()

    def fit(self) -> Outcome:
        """Train until the run ends or is stopped; call this method once.

        A signal stops the run at the next safe point, with a checkpoint. A new run that fails
        before its first step leaves no folder.

        Raises:
            EnvironmentFailed: the user's environment failed; the run can be resumed.
            EnvironmentsLost: worker processes died too often; the run can be resumed.
            EvaluationFailed: an evaluation failed; the run can be resumed.
            NotFinite: an observation or a reward is NaN or infinite, and the run can be resumed; or
                a loss or a weight is NaN or infinite, and the run can be resumed from its last
                checkpoint only.
        """
        setup = self.setup
        if self._resumed is not None:
            run, start = self._resumed
            run = dataclasses.replace(run, config=self.config)
            if start is None:
                run.record_resumption(0)
            return self._fit(run, start)
        space, actions = setup.space, setup.action_space
        bounds = own_bounds(setup.env)
        with Run.begin(
            self.config, space, actions, bounds, setup.left_open, home=setup.home
        ) as run:
            try:
                return self._fit(run, None)
            except BaseException:
                if setup.progress.step == 0:
                    run.discard()
                raise

    def _fit(self, run: Run, start: Checkpoint | None) -> Outcome:
        """Open replay, metrics and environments, restore the run if it resumes, and train."""
        self.run, setup = run, self.setup
        self._clock = Clock()
        with ExitStack() as stack:
            self._interrupt = stack.enter_context(Interrupt().listening())
            self._metrics = stack.enter_context(MetricsWriter(run.path, self._callbacks.on_warning))
            with torch_settings(setup.device):
                self.replay = ReplayBuffer(setup.replay_spec, run.replay)
            with self._interrupt.raising():
                self._environments = self._make_environments()
            stack.callback(self._environments.close)
            self._evaluations = Evaluations(
                setup, run, self._metrics, self._callbacks, self._interrupt
            )
            self._saver = Saver(
                setup,
                run,
                self.replay,
                self._environments,
                self._evaluations,
                self._clock,
                self._guard,
                self._callbacks,
            )
            if start is not None:
                self._saver.restore(start)
                self._metrics.trim(setup.progress.step)
                run.record_resumption(start.step)
            outcome = None
            try:
                outcome = self._train_and_rescue()
            finally:
                self._callbacks.on_end(outcome)
        return dataclasses.replace(outcome, unwritten=self._metrics.unwritten)

    def _make_environments(self) -> Environments:
        env = self.setup.env
        return WorkerEnvs(self.config, env) if self.config.has_workers else InProcessEnvs(env)

    def _train_and_rescue(self) -> Outcome:
        """Train; after an error, save the run and raise the error.

        After a signal, the run counts as stopped, also if the signal made something fail.
        """
        try:
            return self._train()
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):  # raised by the environment's signal handler
                self._interrupt.note(signal.SIGINT)
            if self._interrupt.number is not None:
                return self._outcome(self._saver.save())
            step, line = self.setup.progress.step, resume_line(self.run.path)
            if isinstance(error, EvaluationFailed | EnvironmentsLost) or not self._rescue():
                raise
            saved = f"the run is saved at step {step:,}: fix the cause, and resume with `{line}`"
            if isinstance(error, EnvironmentFailed | NotFinite):
                raise type(error)(f"{error}; {saved}") from error
            self._callbacks.on_warning(saved)
            raise

    def _rescue(self) -> bool:
        """Save after an error, if a step was taken; return whether the state is on the disk."""
        try:
            return self.setup.progress.step > 0 and self._saver.save()
        except Exception:  # a loss or a weight is not finite, or the folder is gone
            return False

    def _train(self) -> Outcome:
        """Run the loop of Algorithm 1; log, evaluate and save between its steps."""
        progress = self.setup.progress
        steps = self._steps()
        self._callbacks.on_start(self)
        evaluates = self.setup.eval_env is not None
        if evaluates and not self.setup.records_video and self.config.eval.video != "none":
            self._callbacks.on_warning(
                "there will be no videos: the environment does not render to an array"
            )
        if progress.step == 0 and not self._saver.save():
            raise MerlError(
                f"no checkpoint can be written to {self.run.path}: free space on its disk, or "
                "choose a folder on another disk with --run-dir"
            )
        if progress.step and self._evaluations.are_due() and not self.replay.state_dict()["open"]:
            self._evaluate()  # the run was stopped before this evaluation or within it
            self._saver.save()
        self._clock.mark(progress)
        self._episode_end = progress.step
        for count, result in enumerate(steps):
            if count == 0 and not result.lost and not self._saver.resumes_exactly():
                self._callbacks.on_warning(
                    "a resumed run will have other episodes than an uninterrupted run, unless the "
                    "environment draws its random numbers from Gymnasium's np_random, or from the "
                    "global generators of NumPy, Python or torch"
                )
            self._handle(result)
            if self._is_to_stop():
                break
            if result.episodes:
                self._at_episode_end()
            elif self._saver.interval.is_overdue():
                self._saver.save(within_episode=True)
            if self._is_to_stop():
                break
        if evaluates and self._interrupt.number is None and progress.evaluated < progress.step:
            self._evaluate(last=True)
        return self._outcome(self._saver.save())

    def _steps(self) -> Iterable[StepResult]:
        """Return the loop of Algorithm 1, which yields after every step of the environments."""
        setup = self.setup
        stacks = [
            FrameStack(setup.spec.modalities, setup.spec.frame_stack, setup.device)
            for _ in range(self._environments.count)
        ]
        update = make_update(
            setup.agent,
            self.replay,
            setup.randomness,
            self.config,
            setup.device,
            self._callbacks.on_warning,
            setup.progress.updates,
        )
        return train(
            Collector(self._environments, self.replay, stacks),
            setup.agent,
            update,
            setup.progress,
            setup.randomness,
            self.config,
            lambda: self._interrupt.number is not None,
        )

    def _handle(self, result: StepResult) -> None:
        """Log one step of the loop and notify the callbacks."""
        self._guard.watch(result.learning, result.step)
        self._averages.add(result.learning)
        self._watch_for_episode_end(result)
        if result.lost and not self._is_to_stop():
            self._count_worker_loss(result.lost)
        if result.learning:
            self._callbacks.on_update(result.step, result.learning)
        if self._callbacks.on_step(result) is False:
            self._callback_stops = True
        if result.episodes:
            self._callbacks.on_episode(result.step, self._log(result))

    def _outcome(self, saved: bool) -> Outcome:
        number = self._interrupt.number
        return Outcome(self.run, self.setup.progress, self._evaluations.last, number, saved)

    def _watch_for_episode_end(self, result: StepResult) -> None:
        """Warn once if no episode ends, since metrics and evaluations wait for that."""
        most = min(LONG * self._environments.count, max(1, self.config.steps // 2))
        if result.episodes:
            self._episode_end = result.step
        elif self._episode_end is not None and result.step - self._episode_end > most:
            self._episode_end = None
            self._callbacks.on_warning(
                f"no episode has ended in {most:,} steps, and nothing is logged or evaluated until "
                "one ends: if episodes have no end, wrap the environment in "
                "gymnasium.wrappers.TimeLimit"
            )

    def _count_worker_loss(self, cause: str) -> None:
        """Count the death of a worker process; the loop restarts the environments.

        Raises:
            EnvironmentsLost: worker processes died too often; the run is saved.
        """
        self._worker_losses += 1
        most = self.config.worker_restarts
        if self._worker_losses > most:
            self._saver.save()
            step = self.setup.progress.step
            saved = f"the run is saved at step {step:,}; resume with `{resume_line(self.run.path)}`"
            raise EnvironmentsLost(
                f"an environment's process {cause}, after {counted(most, 'restart')}: "
                + (saved if step else "the run ends before its first step")
            )
        self._callbacks.on_warning(
            f"an environment's process {cause}: starting the environments again (restart "
            f"{self._worker_losses} of {most})"
        )

    def _is_to_stop(self) -> bool:
        """Return whether a signal, a callback or the time limit stops the run."""
        minutes = self.config.minutes
        spent = minutes is not None and self._clock.seconds_since_start() > minutes * 60
        return spent or self._callback_stops or self._interrupt.number is not None

    def _at_episode_end(self) -> None:
        if self._evaluations.are_due():
            self._evaluate()
            self._saver.save()
        elif self._saver.interval.is_due():
            self._saver.save()

    def _log(self, result: StepResult) -> dict[str, float]:
        """Write a row of metrics for the episodes that ended at this step, and return it."""
        self._guard.check()
        self.run.check_there()
        progress = self.setup.progress
        progress.reports_success |= report_success(result.episodes)
        means = mean_metrics(result.episodes, reports_success=progress.reports_success)
        values = {f"train/{k}": v for k, v in means.items()}
        values |= self._averages.take()
        values |= self._clock.rates(progress)
        values["replay/steps"] = float(len(self.replay))
        if self.config.has_workers:
            values["workers/restarts"] = float(progress.restarts)
        self._metrics.write(result.step, values)
        return values

    def _evaluate(self, last: bool = False) -> None:
        self._evaluations.run(self._saver.save, self._clock, last=last)
        self._clock.mark(self.setup.progress)  # the rates do not include the evaluation
