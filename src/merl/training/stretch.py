"""One stretch of training: drives the loop, and between its steps measures, evaluates and saves."""

from __future__ import annotations

import dataclasses
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from merl.core import EnvironmentFailed, EnvironmentsLost, counted, is_image
from merl.replay import Lanes
from merl.training import checkpoint
from merl.training.acting import Environments, Lost
from merl.training.checkpoint import Checkpoint
from merl.training.evaluation import Evaluation, Policy, evaluate
from merl.training.guards import LossGuard
from merl.training.loop import Moment, Progress, Stage, train
from merl.training.meters import Averages, Clock, Interval
from merl.training.metrics import MetricsWriter
from merl.training.parts import Parts
from merl.training.plain import to_plain
from merl.training.rollout import FrameStack, mean_metrics
from merl.training.run import Run, resume_line
from merl.training.signals import Interrupt
from merl.training.updating import make_update

LONG = 10_000
"""Steps of an episode, from which on one wonders whether it will end."""


class View(Protocol):
    """Who watches a run."""

    def begin(self, run: Run, step: int) -> None:
        """Training begins, or goes on from there."""

    def moment(self, moment: Moment, metrics: dict[str, float]) -> None:
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
    """

    run: Run
    progress: Progress
    evaluation: Evaluation | None
    signal: int | None
    saved: bool


class _Interrupted(Exception):  # noqa: N818 (no error, a way out)
    """An evaluation is to end before its time."""


class Stretch:
    """One stretch of training, from start or resume to the end or an interruption."""

    def __init__(
        self,
        parts: Parts,
        run: Run,
        replay: Lanes,
        environments: Environments,
        metrics: MetricsWriter,
        view: View,
        interrupt: Interrupt,
    ) -> None:
        self.parts, self.config, self.run = parts, parts.config, run
        self.replay, self.environments = replay, environments
        self.metrics, self.view, self.interrupt = metrics, view, interrupt
        self.clock, self.averages, self.guard = Clock(), Averages(), LossGuard()
        self.evaluation: Evaluation | None = None
        self.losses = 0
        self._ended: int | None = None  # the last episode's step, until it is long ago
        self._states: list[dict[str, Any] | None] = [None] * environments.count
        self._interval = Interval(self.config.save_every)

    def train(self) -> Outcome:
        """Drive the loop to its end; where the environment fails, save before that is told.

        Raises:
            EnvironmentFailed: the user's environment did; the run can go on.
        """
        try:
            return self._drive()
        except EnvironmentFailed as failure:
            step = self.parts.progress.step
            if step == 0 or not self._save():
                raise
            raise EnvironmentFailed(
                f"{failure}; the run is saved at step {step:,}: mend it, and go on with "
                f"`{resume_line(self.run.path)}`"
            ) from failure

    def _drive(self) -> Outcome:
        """Between the loop's steps log, evaluate, save, and see whether to stop."""
        parts, progress = self.parts, self.parts.progress
        images = tuple(key for key in parts.space if is_image(parts.space[key]))
        stacks = [
            FrameStack(self.config.replay.frame_stack, images, parts.device)
            for _ in range(self.environments.count)
        ]
        stage = Stage(self.environments, self.replay, stacks)
        update = make_update(
            parts.agent,
            self.replay,
            parts.randomness,
            self.config,
            self.view.warn,
            progress.updates,
        )
        self.view.begin(self.run, progress.step)
        if not parts.films and self.config.eval.video != "none":
            self.view.warn("there will be no videos: the environment does not render to an array")
        if progress.step == 0:
            self._save()  # from here on there is something to go on from
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
            if count == 0 and not moment.lost and None in self._environment_states():
                self.view.warn(
                    "a resumed run will meet other episodes than this one would: the environment "
                    "does not draw from Gymnasium's np_random"
                )
            self.guard.watch(moment.learning, moment.step)
            self.averages.add(moment.learning)
            self._watch_for_an_end(moment)
            if moment.lost and not self._is_to_stop():
                self._lost(moment.lost)
            self.view.moment(moment, self._log(moment) if moment.episodes else {})
            if moment.episodes and not self._is_to_stop():
                self._at_episode_end()
            if self._is_to_stop():
                break
        if self.interrupt.number is None and progress.evaluated < progress.step:
            self._evaluate(last=True)
        saved = self._save()
        return Outcome(self.run, progress, self.evaluation, self.interrupt.number, saved)

    def restore(self, start: Checkpoint) -> None:
        """Stand where the checkpoint was taken."""
        parts, state = self.parts, start.state()
        checkpoint.load_agent(parts.agent, start)
        parts.progress = Progress(**state["progress"])
        parts.randomness.load_state_dict(state["randomness"])
        self.replay.load_state_dict(state["replay"])
        states = state["environment"]
        self._states = states if isinstance(states, list) else [states]
        try:
            self.environments.restore(self._states)
        except Lost as lost:
            raise EnvironmentsLost(
                f"an environment's process {lost} right after its start: see what it said above"
            ) from None
        self.clock = Clock(state["seconds"], state["cpu_seconds"])
        self.metrics.trim(parts.progress.step)

    def _watch_for_an_end(self, moment: Moment) -> None:
        """Rows and checkpoints wait for the end of an episode: tell, once, if none comes."""
        if moment.episodes:
            self._ended = moment.step
        elif self._ended is not None and moment.step - self._ended > LONG:
            self._ended = None
            self.view.warn(
                f"no episode has ended in {LONG:,} steps, and nothing is logged or saved until one "
                "does: an environment that goes on for ever needs gymnasium.wrappers.TimeLimit"
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
        progress, every = self.parts.progress, self.config.eval.every
        due = progress.step // every > progress.evaluated // every
        if due and progress.step < self.config.steps:  # the last one comes after the loop
            self._evaluate()
            self._save()
        elif self._interval.is_due():
            self._save()

    def _log(self, moment: Moment) -> dict[str, float]:
        """A row of metrics for the episode that has ended."""
        self.guard.check()
        self.run.check_there()
        values = {f"train/{k}": v for k, v in mean_metrics(moment.episodes).items()}
        values |= self.averages.take()
        values |= self.clock.rates(self.parts.progress)
        values["replay/steps"] = float(len(self.replay))
        if self.config.has_workers:
            values["workers/restarts"] = float(self.parts.progress.restarts)
        self.metrics.write(moment.step, values)
        return values

    def _evaluate(self, last: bool = False) -> None:
        self.run.check_there()
        parts, config = self.parts, self.config.eval
        step = parts.progress.step
        policy = Policy(parts.agent, self.config, parts.space, parts.device, step)
        film = parts.films and (config.video == "each" or (config.video == "last" and last))
        try:
            self.evaluation = evaluate(
                policy,
                parts.eval_env,
                config.episodes,
                reset=policy.reset,
                video=self.run.videos / f"{step:08d}.mp4" if film else None,
                tick=self._evaluating,
                warn=self.view.warn,
            )
        except _Interrupted:
            return
        self.run.check_there()
        parts.progress.evaluated = step
        values = {f"eval/{name}": value for name, value in self.evaluation.metrics().items()}
        self.metrics.write(step, values | {"time/seconds": self.clock.seconds()})
        self.view.evaluated(step, self.evaluation)
        self.clock.mark(parts.progress)  # evaluating is not counted against the speed

    def _evaluating(self, episode: int) -> None:
        """Between two steps of an evaluation; it ends at once if the run is to stop."""
        if self.interrupt.number is not None:
            raise _Interrupted
        self.view.evaluating(episode, self.config.eval.episodes)

    def _environment_states(self) -> list[dict[str, Any] | None]:
        """Where the environments stand; of those that are lost, where they stood last."""
        with suppress(Lost):
            self._states = self.environments.states()
        return self._states

    def _save(self) -> bool:
        """Write a checkpoint; that it could not be written is told, and does not stop the run.

        Raises:
            MerlError: the run's folder is gone, or what would be saved is no longer finite.
        """
        self.guard.check()
        self.run.check_there()
        parts, progress = self.parts, self.parts.progress
        fresh = self.evaluation is not None and progress.evaluated == progress.step
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
                score=self.evaluation.returns.mean if fresh and self.evaluation else None,
                keep=self.config.keep,
            )
        except OSError as error:
            self.run.check_there()
            reason = error.strerror or error
            self.view.warn(f"the checkpoint at step {progress.step} was not written: {reason}")
            return False
        finally:
            self._interval.saved()
        self.replay.settle()
        self.view.saved(progress.step)
        return True
