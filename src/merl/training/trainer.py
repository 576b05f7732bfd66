"""The trainer of a run, from its first step or a checkpoint to its end."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Iterable
from contextlib import ExitStack
from threading import Lock

from merl.acting.instances import own_bounds
from merl.acting.rollout import FrameStack, mean_metrics, report_success
from merl.callbacks import Callback, CallbackList
from merl.config import CUSTOM, Source, TrainConfig
from merl.core import EnvironmentsLost, EvaluationFailed, MerlError, counted
from merl.core.guards import LossGuard
from merl.core.signals import Interrupt
from merl.envs.user_env import MakeEnv
from merl.loggers import CSV, make_loggers
from merl.networks.settings import torch_settings
from merl.replay import ReplayBuffer
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.actors import Actors
from merl.training.corrections import Corrections
from merl.training.evaluator import Evaluations
from merl.training.loop import Collector, Progress, StepResult, train, train_from
from merl.training.meters import Averages, Clock, EpisodeWatch
from merl.training.outcome import Outcome
from merl.training.saving import Saver
from merl.training.setup import Setup, load_initial_weights
from merl.training.updating import make_update

_TRAINING = Lock()
"""Held while a run is trained: signals, random generators and torch's threads are the process's."""
_BUSY = "this process is training another run: wait for its end, or train in another process"


class Trainer:
    """Trainer of a run's agent: acts, learns, evaluates, logs and saves.

    The trainer is a context manager that closes the environments at the end:

        with Trainer(config, callbacks) as trainer:
            outcome = trainer.fit()

    Args:
        config: the run's config.
        callbacks: called at the events of training, after the loggers.
        source: where the config's values come from; recorded with a new run.
        resumed: None for a new run; else the run to resume, whose lock the caller holds, and the
            checkpoint to resume from, or None to start at the first step.
        skip_damaged: see `Saver.restore`.
        make: makes the environment, if the config does not name it; see `make_run_env`.

    Attributes:
        setup: environments, agent and random streams.
        config: the run's config, with the values that were chosen for this machine.
        run: the run's folder; set by `fit`.
        replay: the replay buffer; set by `fit`, until the trainer is closed.
        clock: training time; set by `fit`.
        evaluations: the evaluations so far; set by `fit`.

    Raises:
        MerlError: the config cannot work on this machine, the environment differs from that of the
            resumed run, or this process trains another run.
    """

    run: Run
    replay: ReplayBuffer
    clock: Clock
    evaluations: Evaluations

    def __init__(
        self,
        config: TrainConfig,
        callbacks: Iterable[Callback] = (),
        *,
        source: Source = CUSTOM,
        resumed: tuple[Run, Checkpoint | None] | None = None,
        skip_damaged: bool = False,
        make: MakeEnv | None = None,
    ) -> None:
        if _TRAINING.locked():
            raise MerlError(_BUSY)
        self._csv = CSV()
        notified = [self._csv, *make_loggers(config.log), *callbacks]
        with ExitStack() as stack:
            self._actors = stack.enter_context(Actors.listening(config))
            if self._actors is not None:
                make = make or self._actors.make_env(resumed[0] if resumed else None)
                notified.append(self._actors)
            self._callbacks = CallbackList(notified)
            prepared = Setup.prepare(config, new=resumed is None, source=source, make=make)
            self.setup = setup = stack.enter_context(prepared)
            if resumed is not None:
                bounds = own_bounds(setup.env)
                resumed[0].check_environment(setup.space, setup.action_space, bounds)
            if resumed is None or resumed[1] is None:
                load_initial_weights(setup.agent, setup.home)
            self._resources = stack.pop_all()
        self.config, self._source, self._resumed = setup.config, source, resumed
        self._averages, self._guard, self._skip_damaged = Averages(), LossGuard(), skip_damaged
        self._worker_losses, self._stops = 0, False  # stops: a callback ends the training

    def __enter__(self) -> Trainer:
        """Return the trainer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the environments and the replay, also if a callback keeps the trainer."""
        self._resources.close()
        for name in ("replay", "_saver"):  # the files stay mapped as long as these exist
            vars(self).pop(name, None)

    @property
    def progress(self) -> Progress:
        """Return the counts of steps, updates and episodes so far."""
        return self.setup.progress

    def stop(self) -> None:
        """Stop training after the current step, as its end: evaluate, and save a checkpoint."""
        self._stops = True

    def warn(self, message: str) -> None:
        """Show a warning to the user."""
        self._callbacks.on_warning(message)

    def fit(self) -> Outcome:
        """Train until the run ends or is stopped; call this method once.

        A signal stops the run at the next safe point, with a checkpoint. A new run that fails
        before its first step leaves no folder.

        Raises:
            CallbackFailed: a callback raised an exception; the run can be resumed.
            EnvironmentFailed: the user's environment failed; the run can be resumed.
            EnvironmentsLost: worker processes died too often; the run can be resumed.
            EvaluationFailed: an evaluation failed; the run can be resumed.
            NotFinite: an observation or a reward is NaN or infinite, and the run can be resumed; or
                a loss or a weight is NaN or infinite, and the run can be resumed from its last
                checkpoint only.
        """
        if not _TRAINING.acquire(blocking=False):
            raise MerlError(_BUSY)
        with ExitStack() as stack:
            stack.callback(_TRAINING.release)
            if self._resumed is not None:
                run, start = self._resumed
                return self._fit(dataclasses.replace(run, config=self.config), start)
            setup, source = self.setup, self._source
            spaces = setup.space, setup.action_space, own_bounds(setup.env)
            begun = Run.begin(self.config, *spaces, setup.left_open, source=source, home=setup.home)
            run = stack.enter_context(begun)
            try:
                return self._fit(run, None)
            except BaseException:
                if self.progress.step == 0:
                    run.discard()
                raise

    def _fit(self, run: Run, start: Checkpoint | None) -> Outcome:
        """Open replay and environments, restore the run if it resumes, and train."""
        self.run, self.clock, setup = run, Clock(), self.setup
        with ExitStack() as stack:
            self._interrupt = stack.enter_context(Interrupt().listening())
            with torch_settings(setup.device):
                self.replay = ReplayBuffer(setup.replay_spec, run.replay)
            with self._interrupt.raising():
                self._environments = setup.make_environments()
            stack.callback(self._environments.close)
            self._corrections = stack.enter_context(Corrections.of(self._callbacks, setup, run))
            self.evaluations = Evaluations(setup, run, self.clock, self._callbacks, self._interrupt)
            watched = self.evaluations, self.clock, self._guard, self._callbacks
            self._saver = Saver(setup, run, self.replay, self._environments, *watched)
            if start is not None:
                self._saver.restore(start, skip_damaged=self._skip_damaged)
            if self._resumed is not None:
                run.record_resumption(start.step if start else 0)
            outcome = None
            try:
                self._callbacks.on_start(self)
                outcome = self._train_and_rescue()
            finally:
                self._callbacks.on_end(outcome)
        unwritten = self._csv.file.unwritten if self._csv.file else 0
        return dataclasses.replace(outcome, unwritten=unwritten)

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
            if isinstance(error, EvaluationFailed | EnvironmentsLost) or not self._rescue():
                raise
            step, line = self.progress.step, resume_line(self.run.path)
            saved = f"the run is saved at step {step:,}: fix the cause, and resume with `{line}`"
            if isinstance(error, MerlError):
                error.args = (f"{error}; {saved}",)
            else:
                self.warn(saved)
            raise

    def _rescue(self) -> bool:
        """Save after an error, if a step was taken; return whether the state is on the disk."""
        try:
            return self.progress.step > 0 and self._saver.save()
        except Exception:  # a loss or a weight is not finite, or the folder is gone
            return False

    def _train(self) -> Outcome:
        """Run the loop of Algorithm 1; log, evaluate and save between its steps."""
        progress, steps = self.progress, self._steps()
        evaluates = self.setup.eval_env is not None
        if evaluates and not self.setup.records_video and self.config.eval.video != "none":
            self.warn("there will be no videos: the environment does not render to an array")
        if progress.step == 0 and not self._saver.save():
            raise MerlError(
                f"no checkpoint can be written to {self.run.path}: free space on its disk, or "
                "choose a folder on another disk with --run-dir"
            )
        if progress.step and self.evaluations.are_due() and not self.replay.state_dict()["open"]:
            self._evaluate()  # the run was stopped before this evaluation or within it
            self._saver.save()
        self.clock.mark(progress)
        watch = EpisodeWatch(self.config, progress.step)
        for count, result in enumerate(steps):
            if count == 0 and not result.lost and not self._saver.resumes_exactly():
                self.warn(
                    "a resumed run will have other episodes than an uninterrupted run, unless the "
                    "environment draws its random numbers from Gymnasium's np_random, or from the "
                    "global generators of NumPy, Python or torch"
                )
            self._handle(result)
            if (note := watch.note(result)) is not None:
                self.warn(note)
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
            setup.batches_from(self.replay, self._corrections),
            setup.randomness,
            self.config,
            setup.device,
            self._callbacks.on_warning,
            setup.progress.updates,
        )
        is_to_stop = lambda: self._interrupt.number is not None  # noqa: E731
        if self._actors is not None:
            return train_from(self._actors, update, setup.progress, self.config, is_to_stop)
        return train(
            Collector(self._environments, self.replay, stacks, self._corrections),
            setup.agent,
            update,
            setup.progress,
            setup.randomness,
            self.config,
            is_to_stop,
        )

    def _handle(self, result: StepResult) -> None:
        """Notify the callbacks of one step of the loop, first those that log its row."""
        self._guard.watch(result.learning, result.step)
        self._averages.add(result.learning)
        if result.lost and not self._is_to_stop():
            self._count_worker_loss(result.lost)
        if result.episodes:
            self._callbacks.on_episode(result.step, self._row(result))
        if result.learning:
            self._callbacks.on_update(result.step, result.learning)
        if self._callbacks.on_step(result) is False:
            self.stop()

    def _outcome(self, saved: bool) -> Outcome:
        last, number = self.evaluations.last, self._interrupt.number
        return Outcome(self.run, self.progress, last, number, saved)

    def _count_worker_loss(self, cause: str) -> None:
        """Count the death of a worker process; the loop restarts the environments.

        Raises:
            EnvironmentsLost: worker processes died too often; the run is saved.
        """
        self._worker_losses += 1
        most, what = self.config.worker_restarts, f"an environment's process {cause}"
        if self._worker_losses > most:
            self._saver.save()
            step, line = self.progress.step, resume_line(self.run.path)
            saved = f"the run is saved at step {step:,}; resume with `{line}`"
            end = saved if step else "the run ends before its first step"
            raise EnvironmentsLost(f"{what}, after {counted(most, 'restart')}: {end}")
        self.warn(
            f"{what}: starting the environments again (restart {self._worker_losses} of {most})"
        )

    def _is_to_stop(self) -> bool:
        """Return whether a signal, a callback or the time limit stops the run."""
        minutes = self.config.minutes
        spent = minutes is not None and self.clock.seconds_since_start() > minutes * 60
        return spent or self._stops or self._interrupt.number is not None

    def _at_episode_end(self) -> None:
        if is_due := self.evaluations.are_due():
            self._evaluate()
        if is_due or self._saver.interval.is_due():
            self._saver.save()

    def _row(self, result: StepResult) -> dict[str, float]:
        """Return the row of metrics for the episodes that ended at this step."""
        self._guard.check()
        self.run.check_there()
        progress = self.progress
        progress.reports_success |= report_success(result.episodes)
        means = mean_metrics(result.episodes, reports_success=progress.reports_success)
        values = {} if self.setup.imitates else {f"train/{k}": v for k, v in means.items()}
        values |= self._averages.take() | self.clock.rates(progress)
        values |= {"replay/steps": float(len(self.replay))}
        if self.config.has_workers:
            values["workers/restarts"] = float(progress.restarts)
        return values

    def _evaluate(self, last: bool = False) -> None:
        self.evaluations.run(self._saver.save, last=last)
        self.clock.mark(self.progress)  # the rates do not include the evaluation
