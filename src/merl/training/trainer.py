"""A run from its first step to its last: builds the parts, drives the loop, measures and saves."""

from __future__ import annotations

import dataclasses
import math
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import torch
from gymnasium import spaces

from merl.agents import make_agent
from merl.agents.ddpg import DDPG
from merl.agents.networks import make_networks
from merl.core import EnvironmentsLost, MerlError, is_image
from merl.replay import Lanes, check_fits
from merl.resources import available_memory, keep_freed_memory
from merl.training import checkpoint
from merl.training.acting import Environments, Here, Lost, Workers
from merl.training.checkpoint import Checkpoint
from merl.training.config import TrainConfig
from merl.training.environment import make_run_env, run_spaces
from merl.training.evaluation import Evaluation, Policy, evaluate
from merl.training.guards import LossGuard
from merl.training.loop import Moment, Progress, Randomness, Stage, train
from merl.training.meters import Averages, Clock
from merl.training.metrics import MetricsWriter
from merl.training.rollout import FrameStack, mean_metrics
from merl.training.run import Run, refuse_existing, run_path, to_plain
from merl.training.signals import Interrupt
from merl.training.timing import measure
from merl.training.video import MIN_SIDE


class View(Protocol):
    """Who watches a run."""

    def begin(self, run: Run, trainer: Trainer) -> None:
        """Training begins or goes on."""

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


class Trainer:
    """The parts of one run: environments, agent, and where it stands.

    Attributes:
        config: with `device`, `threads` and the agent's `precision` decided.
        timing: what this machine needs for a step and an update.
        env: to act in.
        eval_env: to be evaluated in.
        films: whether that can be filmed.
        space: what the agent consumes.
        action_space: what it does.
        agent: the learner.
        progress: where the run stands.
        randomness: its random streams.
    """

    def __init__(
        self, config: TrainConfig, env: gymnasium.Env[Any, Any], eval_env: gymnasium.Env[Any, Any]
    ) -> None:
        self.env, self.eval_env = env, eval_env
        self.films = eval_env.render_mode == "rgb_array"
        self.space, self.action_space = run_spaces(config, env)
        self.device = choose_device(config.device)
        check_memory(config, self.space, self.action_space)
        keep_freed_memory()
        self.timing = measure(config, env, eval_env, self.space, self.device)
        best = self.timing.best
        torch.set_num_threads(best.threads)
        self.config = dataclasses.replace(
            config,
            threads=best.threads,
            device="cuda" if self.device.type == "cuda" else "cpu",
            agent=dataclasses.replace(config.agent, precision=best.precision),
        )
        self.progress, self.randomness = Progress(), Randomness(config.seed)
        self.agent: DDPG = make_agent(
            self.config.agent,
            self.space,
            self.action_space,
            frame_stack=config.replay.frame_stack,
            seed=self.randomness.agent,
            device=self.device,
        )

    @classmethod
    @contextmanager
    def prepare(cls, config: TrainConfig, *, new: bool) -> Iterator[Trainer]:
        """Build all that a run needs; what cannot work is refused here, and nothing is written.

        Args:
            config: of the run.
            new: the run begins, so its folder must not exist and its replay must fit.

        Raises:
            MerlError: a device, renderer, sense, folder or size that is not to be had.
        """
        choose_device(config.device)
        processors = os.cpu_count() or 1
        if config.threads is not None and config.threads > processors:
            raise MerlError(
                f"threads is {config.threads}, but this machine has {processors} processors: "
                f"give at most {processors}"
            )
        if new:
            refuse_existing(run_path(config))
        with ExitStack() as stack:
            env = make_run_env(config)
            stack.callback(env.close)
            space, actions = run_spaces(config, env)
            if new:
                check_fits(
                    config.replay,
                    space,
                    actions,
                    directory=run_path(config),
                    capacity=config.capacity,
                )
            size = max(config.env.render_size, MIN_SIDE)
            eval_env = make_run_env(config, render_mode="rgb_array", render_size=size)
            stack.callback(eval_env.close)
            yield cls(config, env, eval_env)

    def start(self, view: View) -> Outcome:
        """Begin a new run; if it fails before its first step, its folder is removed again."""
        run = Run.create(self.config, self.space, self.action_space)
        try:
            with run.lock():
                return self._run(run, None, view)
        except BaseException:
            if self.progress.step == 0:
                shutil.rmtree(run.path, ignore_errors=True)
            raise

    def resume(self, run: Run, start: Checkpoint | None, view: View) -> Outcome:
        """Go on from a checkpoint of the run, or begin it; the caller holds its lock."""
        run = dataclasses.replace(run, config=self.config)
        if start is None:
            run.record_resumption(0)
        return self._run(run, start, view)

    def _run(self, run: Run, start: Checkpoint | None, view: View) -> Outcome:
        with ExitStack() as stack:
            interrupt = stack.enter_context(Interrupt().listening())
            metrics = stack.enter_context(MetricsWriter(run.path, view.warn))
            config = self.config
            replay = Lanes(
                config.replay,
                self.space,
                self.action_space,
                count=config.num_envs,
                directory=run.replay,
                capacity=config.capacity,
            )
            with interrupt.raising():
                environments = Workers(config, self.env) if config.has_workers else Here(self.env)
            stack.callback(environments.close)
            stretch = _Stretch(self, run, replay, environments, metrics, view, interrupt)
            if start is not None:
                stretch.restore(start)
                run.record_resumption(start.step)
            return stretch.train()


class _Interrupted(Exception):  # noqa: N818 (no error, a way out)
    """An evaluation is to end before its time."""


class _Stretch:
    """One stretch of training, from start or resume to the end or an interruption."""

    def __init__(
        self,
        trainer: Trainer,
        run: Run,
        replay: Lanes,
        environments: Environments,
        metrics: MetricsWriter,
        view: View,
        interrupt: Interrupt,
    ) -> None:
        self.trainer, self.config, self.run = trainer, trainer.config, run
        self.replay, self.environments = replay, environments
        self.metrics, self.view, self.interrupt = metrics, view, interrupt
        self.clock, self.averages, self.guard = Clock(), Averages(), LossGuard()
        self.evaluation: Evaluation | None = None
        self.losses = 0
        self._states: list[dict[str, Any] | None] = [None] * environments.count
        self._saved = time.perf_counter()

    def train(self) -> Outcome:
        """Drive the loop; between its steps log, evaluate, save, and see whether to stop."""
        trainer, progress = self.trainer, self.trainer.progress
        images = tuple(key for key in trainer.space if is_image(trainer.space[key]))
        stacks = [
            FrameStack(self.config.replay.frame_stack, images, trainer.device)
            for _ in range(self.environments.count)
        ]
        stage = Stage(self.environments, self.replay, stacks)
        self.view.begin(self.run, trainer)
        if not trainer.films and self.config.eval.video != "none":
            self.view.warn("there will be no videos: the environment does not render to an array")
        if progress.step == 0:
            self._save()  # from here on there is something to go on from
        self.clock.mark(progress)
        for count, moment in enumerate(
            train(stage, trainer.agent, progress, trainer.randomness, self.config)
        ):
            if count == 0 and not moment.lost and None in self._environment_states():
                self.view.warn(
                    "a resumed run will meet other episodes than this one would: the environment "
                    "does not draw from Gymnasium's np_random"
                )
            self.guard.watch(moment.learning, moment.step)
            self.averages.add(moment.learning)
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
        trainer, state = self.trainer, start.state()
        checkpoint.load_agent(trainer.agent, start)
        trainer.progress = Progress(**state["progress"])
        trainer.randomness.load_state_dict(state["randomness"])
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
        self.metrics.trim(trainer.progress.step)

    def _lost(self, what: str) -> None:
        """An environment's process was lost: they are started again, if not too often.

        Raises:
            EnvironmentsLost: too often; the run is saved.
        """
        self.losses += 1
        most = self.config.worker_restarts
        if self.losses > most:
            self._save()
            step = self.trainer.progress.step
            saved = f"the run is saved at step {step:,}; go on with `merl resume {self.run.path}`"
            raise EnvironmentsLost(
                f"an environment's process {what}, after {most} restarts: "
                + (saved if step else "the run ends before its first step")
            )
        self.view.warn(
            f"an environment's process {what}: starting the environments again ({self.losses} of "
            f"{most} times)"
        )

    def _is_to_stop(self) -> bool:
        """By a signal, or because the minutes of this stretch are over."""
        minutes = self.config.minutes
        spent = minutes is not None and self.clock.stretch() > minutes * 60
        return spent or self.interrupt.number is not None

    def _at_episode_end(self) -> None:
        progress, every = self.trainer.progress, self.config.eval.every
        due = progress.step // every > progress.evaluated // every
        if due and progress.step < self.config.steps:  # the last one comes after the loop
            self._evaluate()
            self._save()
        elif time.perf_counter() - self._saved > self.config.save_every:
            self._save()

    def _log(self, moment: Moment) -> dict[str, float]:
        """A row of metrics for the episode that has ended."""
        self.guard.check()
        self.run.check_there()
        values = {f"train/{k}": v for k, v in mean_metrics(moment.episodes).items()}
        values |= self.averages.take()
        values |= self.clock.rates(self.trainer.progress)
        values["replay/steps"] = float(len(self.replay))
        if self.config.has_workers:
            values["workers/restarts"] = float(self.trainer.progress.restarts)
        self.metrics.write(moment.step, values)
        return values

    def _evaluate(self, last: bool = False) -> None:
        self.run.check_there()
        trainer, config = self.trainer, self.config.eval
        step = trainer.progress.step
        policy = Policy(trainer.agent, self.config, trainer.space, trainer.device, step)
        film = trainer.films and (config.video == "each" or (config.video == "last" and last))
        try:
            self.evaluation = evaluate(
                policy,
                trainer.eval_env,
                config.episodes,
                reset=policy.reset,
                video=self.run.videos / f"{step:08d}.mp4" if film else None,
                tick=self._evaluating,
                warn=self.view.warn,
            )
        except _Interrupted:
            return
        self.run.check_there()
        trainer.progress.evaluated = step
        values = {f"eval/{name}": value for name, value in self.evaluation.metrics().items()}
        self.metrics.write(step, values | {"time/seconds": self.clock.seconds()})
        self.view.evaluated(step, self.evaluation)
        self.clock.mark(trainer.progress)  # evaluating is not counted against the speed

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
        trainer, progress = self.trainer, self.trainer.progress
        fresh = self.evaluation is not None and progress.evaluated == progress.step
        state = {
            "progress": dataclasses.asdict(progress),
            "randomness": trainer.randomness.state_dict(),
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
                trainer.agent,
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
            self._saved = time.perf_counter()
        self.replay.settle()
        self.view.saved(progress.step)
        return True


def choose_device(name: str) -> torch.device:
    """The device of that name; "auto" is CUDA where it is there.

    Raises:
        MerlError: CUDA is asked for and not there.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise MerlError("--device cuda: no CUDA device is found here; use --device cpu or auto")
    return torch.device(name)


def check_memory(config: TrainConfig, space: spaces.Dict, action_space: spaces.Box) -> None:
    """Refuse networks or batches that this process could never hold.

    Counted are the weights with gradient, moments and average, and the batch's inputs with what one
    layer makes of them: less than what an update takes, so that nothing is refused that would fit.

    Raises:
        MerlError: naming what is too large.
    """
    with torch.device("meta"):
        networks = make_networks(
            config.agent, space, action_space.shape[0], config.replay.frame_stack
        )
    weights = 5 * 4 * sum(parameter.numel() for parameter in networks.parameters())
    stack, size = config.replay.frame_stack, config.replay.batch_size
    inputs = 2 * 5 * size * sum(math.prod(s.shape or ()) * stack for s in space.values())
    room = available_memory()
    for what, need in (("networks of agent.*", weights), (f"replay.batch-size {size}", inputs)):
        if need > room:
            raise MerlError(
                f"{what} would take {need / 1e9:.3g} GB or more, but {room / 1e9:.3g} GB of memory "
                "are available: make it smaller"
            )
