"""A run from its first step to its last: builds the parts, drives the loop, measures and saves."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Protocol

import gymnasium
import torch
from gymnasium import spaces
from torch import Tensor

from merl.agents.ddpg import DDPG
from merl.agents.merl import make_merl, modalities
from merl.core import MerlError, is_image
from merl.replay import Replay, check_fits
from merl.training import checkpoint as checkpoints
from merl.training.config import TrainConfig
from merl.training.evaluation import Evaluation, Policy, evaluate, make_run_env
from merl.training.loop import Moment, Progress, Randomness, train
from merl.training.metrics import MetricsWriter
from merl.training.rollout import FrameStack
from merl.training.run import Run, refuse_existing, run_path
from merl.training.timing import measure

_LOG = logging.getLogger(__name__)


class View(Protocol):
    """Who watches a run: the live view of the command line, or nobody."""

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


@dataclass
class Outcome:
    """How a run ended.

    Attributes:
        run: its folder and config.
        progress: where it stands.
        seconds: of training, all its parts together.
        evaluation: the last one, if there was any.
        signal: what interrupted it; None if it ran to its end.
    """

    run: Run
    progress: Progress
    seconds: float
    evaluation: Evaluation | None
    signal: int | None


@dataclass
class Interrupt:
    """A wish to stop, by a signal; a second one stops at once."""

    number: int | None = None

    @contextmanager
    def listening(self) -> Iterator[Interrupt]:
        """Take SIGINT and SIGTERM as a wish to stop at the next safe point."""

        def note(number: int, frame: FrameType | None) -> None:
            if self.number is not None:
                os._exit(128 + number)
            self.number = number

        former = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield self
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)


class Averages:
    """Means of the learner's metrics since they were last taken; on the device until then."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    def add(self, metrics: dict[str, Tensor]) -> None:
        """Take in one update's."""
        for name, value in metrics.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._count += bool(metrics)

    def take(self) -> dict[str, float]:
        """The means, and begin anew."""
        means = {f"learn/{name}": float(s) / self._count for name, s in self._sums.items()}
        self._sums, self._count = {}, 0
        return means


@dataclass
class Clock:
    """Seconds of training, across interruptions, and the rates since the last reading.

    Beside the wall's clock it keeps the processor's, of all threads together: on a machine that is
    shared, the one that can be compared.
    """

    before: float = 0.0
    cpu_before: float = 0.0
    _cpu_start: float = field(default_factory=time.process_time)
    _start: float = field(default_factory=time.perf_counter)
    _last: tuple[float, int, int] = (0.0, 0, 0)

    def seconds(self) -> float:
        """Since the run began, time away not counted."""
        return self.before + time.perf_counter() - self._start

    def cpu_seconds(self) -> float:
        """Processor time since the run began."""
        return self.cpu_before + time.process_time() - self._cpu_start

    def rates(self, progress: Progress) -> dict[str, float]:
        """Steps and updates per second since the last call."""
        now = self.seconds()
        then, steps, updates = self._last
        self._last = (now, progress.step, progress.updates)
        span = max(now - then, 1e-9)
        return {
            "time/seconds": now,
            "time/cpu_seconds": self.cpu_seconds(),
            "time/steps_per_second": (progress.step - steps) / span,
            "time/updates_per_second": (progress.updates - updates) / span,
        }


class Trainer:
    """The parts of one run. `prepare` builds them and refuses what cannot work; `run` trains.

    Attributes:
        config: with `device`, `threads` and the agent's `precision` decided.
        timing: what this machine needs for a step and an update.
    """

    def __init__(
        self, config: TrainConfig, env: gymnasium.Env[Any, Any], device: torch.device
    ) -> None:
        self.env, self.device = env, device
        self.timing = measure(config, env, device)
        best = self.timing.best
        torch.set_num_threads(best.threads)
        self.config = dataclasses.replace(
            config,
            threads=best.threads,
            device="cuda" if device.type == "cuda" else "cpu",
            agent=dataclasses.replace(config.agent, precision=best.precision),
        )
        self.space, self.action_space = _spaces(self.config, env)
        self.progress, self.randomness = Progress(), Randomness(config.seed)
        self.agent: DDPG = make_merl(
            self.config.agent,
            self.space,
            self.action_space,
            frame_stack=config.replay.frame_stack,
            seed=self.randomness.agent,
            device=device,
        )

    @classmethod
    @contextmanager
    def prepare(cls, config: TrainConfig) -> Iterator[Trainer]:
        """Build the environment and the agent; nothing is written yet.

        Raises:
            MerlError: a device, renderer, space or size that is not to be had here.
        """
        device = choose_device(config.device)
        env = make_run_env(config)
        try:
            yield cls(config, env, device)
        finally:
            env.close()

    def check(self) -> None:
        """Refuse a run whose folder exists, or whose replay does not fit."""
        folder = run_path(self.config)
        refuse_existing(folder)
        check_fits(
            self.config.replay,
            self.space,
            self.action_space,
            directory=folder,
            capacity=self.config.capacity,
        )

    def start(self, view: View) -> Outcome:
        """Begin a new run."""
        self.check()
        run = Run.create(self.config, self.space, self.action_space)
        return self._run(run, None, view)

    def resume(self, run: Run, view: View) -> Outcome:
        """Go on from the run's last whole checkpoint."""
        return self._run(run, checkpoints.Checkpoint.find(run.checkpoints), view)

    def _run(self, run: Run, start: checkpoints.Checkpoint | None, view: View) -> Outcome:
        replay = Replay(
            self.config.replay,
            self.space,
            self.action_space,
            directory=run.replay,
            capacity=self.config.capacity,
        )
        with ExitStack() as stack:
            metrics = stack.enter_context(MetricsWriter(run.path, view.warn))
            interrupt = stack.enter_context(Interrupt().listening())
            session = _Session(self, run, replay, metrics, view, interrupt)
            stack.callback(session.close)
            if start is not None:
                session.restore(start)
            return session.train()


class _Interrupted(Exception):  # noqa: N818 (no error, a way out)
    """An evaluation is to end before its time."""


class _Session:
    """One stretch of training, from start or resume to the end or an interruption."""

    def __init__(
        self,
        trainer: Trainer,
        run: Run,
        replay: Replay,
        metrics: MetricsWriter,
        view: View,
        interrupt: Interrupt,
    ) -> None:
        self.trainer, self.config, self.run = trainer, trainer.config, run
        self.replay, self.metrics, self.view, self.interrupt = replay, metrics, view, interrupt
        self.clock, self.averages = Clock(), Averages()
        self.evaluation: Evaluation | None = None
        self.eval_env = make_run_env(self.config, render_mode="rgb_array")
        self._saved = time.perf_counter()

    def train(self) -> Outcome:
        trainer, progress = self.trainer, self.trainer.progress
        images = tuple(key for key in trainer.space if is_image(trainer.space[key]))
        frames = FrameStack(self.config.replay.frame_stack, images, trainer.device)
        self.view.begin(self.run, trainer)
        self.clock.rates(progress)
        for moment in train(
            trainer.env,
            trainer.agent,
            self.replay,
            frames,
            progress,
            trainer.randomness,
            self.config,
        ):
            self.averages.add(moment.learning)
            self.view.moment(moment, self._log(moment) if moment.episode else {})
            if self.interrupt.number is not None or self._time_is_up():
                break
            if moment.episode:
                self._at_episode_end()
        if self.interrupt.number is None:
            self._evaluate(last=True)
        self._save()
        return Outcome(
            self.run, progress, self.clock.seconds(), self.evaluation, self.interrupt.number
        )

    def restore(self, start: checkpoints.Checkpoint) -> None:
        """Stand where the checkpoint was taken."""
        trainer, state = self.trainer, start.state()
        checkpoints.load_agent(trainer.agent, start)
        trainer.progress = Progress(**state["progress"])
        trainer.randomness.load_state_dict(state["randomness"])
        self.replay.load_state_dict(state["replay"])
        trainer.env.unwrapped.np_random.bit_generator.state = state["environment"]
        self.clock = Clock(before=state["seconds"], cpu_before=state["cpu_seconds"])
        self.metrics.trim(trainer.progress.step)

    def close(self) -> None:
        self.eval_env.close()

    def _at_episode_end(self) -> None:
        progress, every = self.trainer.progress, self.config.eval.every
        due = progress.step // every > progress.evaluated // every
        if due and progress.step < self.config.steps:  # the last one comes after the loop
            self._evaluate()
            self._save()
        elif time.perf_counter() - self._saved > self.config.save_every:
            self._save()

    def _time_is_up(self) -> bool:
        minutes = self.config.minutes
        return minutes is not None and self.clock.seconds() > minutes * 60

    def _log(self, moment: Moment) -> dict[str, float]:
        """A row of metrics for the episode that has ended."""
        assert moment.episode is not None
        values = {f"train/{k}": v for k, v in moment.episode.metrics().items()}
        values |= self.averages.take()
        values |= self.clock.rates(self.trainer.progress)
        values["replay/steps"] = float(len(self.replay))
        self.metrics.write(moment.step, values)
        return values

    def _evaluate(self, last: bool = False) -> None:
        trainer, config = self.trainer, self.config.eval
        step = trainer.progress.step
        policy = Policy(trainer.agent, self.config, trainer.space, trainer.device, step)
        film = config.video == "each" or (config.video == "last" and last)
        try:
            self.evaluation = evaluate(
                policy,
                self.eval_env,
                config.episodes,
                reset=policy.reset,
                video=self.run.videos / f"{step:08d}.mp4" if film else None,
                tick=self._evaluating,
            )
        except _Interrupted:
            return
        trainer.progress.evaluated = step
        values = {f"eval/{name}": value for name, value in self.evaluation.metrics().items()}
        self.metrics.write(step, values | {"time/seconds": self.clock.seconds()})
        self.view.evaluated(step, self.evaluation)

    def _evaluating(self, episode: int) -> None:
        """Between two steps of an evaluation; it ends at once if the run is to stop."""
        if self.interrupt.number is not None:
            raise _Interrupted
        self.view.evaluating(episode, self.config.eval.episodes)

    def _save(self) -> None:
        trainer, progress = self.trainer, self.trainer.progress
        fresh = self.evaluation is not None and progress.evaluated == progress.step
        state = {
            "progress": dataclasses.asdict(progress),
            "randomness": trainer.randomness.state_dict(),
            "replay": self.replay.state_dict(),
            "environment": trainer.env.unwrapped.np_random.bit_generator.state,
            "seconds": self.clock.seconds(),
            "cpu_seconds": self.clock.cpu_seconds(),
        }
        try:
            self.replay.flush()
            checkpoints.save(
                self.run.checkpoints,
                progress.step,
                trainer.agent,
                state,
                score=self.evaluation.returns.mean if fresh and self.evaluation else None,
                keep=self.config.keep,
            )
            self.view.saved(progress.step)
        except OSError as error:
            self.view.warn(f"checkpoint at step {progress.step} was not written: {error.strerror}")
        self._saved = time.perf_counter()


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


def _spaces(config: TrainConfig, env: gymnasium.Env[Any, Any]) -> tuple[spaces.Dict, spaces.Box]:
    """What the agent consumes of the observation, and the actions."""
    assert isinstance(env.observation_space, spaces.Dict)
    assert isinstance(env.action_space, spaces.Box)
    images, vectors = modalities(config.agent, env.observation_space)
    consumed = {key: env.observation_space[key] for key in (*images, *vectors)}
    return spaces.Dict(consumed), env.action_space
