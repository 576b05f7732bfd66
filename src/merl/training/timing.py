"""Time an update and an environment step on this machine, once, before a run starts.

Updates and acting are timed with synthetic observations. A user's own environment is not timed: it
may be a robot, which must not move before the run starts.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any, Literal, TypeVar

import gymnasium
import torch
from gymnasium import spaces

from merl.accelerate.cuda_graph import Recorded
from merl.accelerate.speed_up import speed_up
from merl.agents import make_agent
from merl.agents.config import AgentConfig, ObservationConfig
from merl.config import TrainConfig
from merl.core import Accelerable, Agent, Batch, MerlError, counted
from merl.modalities import modalities_of
from merl.networks.settings import torch_settings
from merl.training.loop import Update

Config = TypeVar("Config", bound=ObservationConfig)

REPEATS = 3
"""Number of measurements; their median is the result."""
REPEATS_ON_GPU = 30
"""Number of measurements of an update on a GPU, where it takes a few milliseconds."""
MEASURED_STEPS = 25
"""Environment steps of one measurement."""
THREADS_PAY = 1.3
"""Minimum speedup over one thread for which several threads are chosen. Threads wait for each other
in every operation: if another process uses a core, they can be ten times slower than one."""
BF16_PAYS = 1.1
"""Minimum speedup over fp32 for which bf16 is chosen. If both are about equally fast, every run of
the same command must make the same choice."""
WORTH_COMPILING = 1800.0
"""Minimum duration of a run, in seconds, for which a compiled update is tried; trying it takes a
minute or two."""


@dataclass(frozen=True)
class Arithmetic:
    """Precision, threads and compilation of the updates."""

    precision: Literal["fp32", "bf16"]
    threads: int
    compiled: bool = False

    def __str__(self) -> str:
        kind = f"{self.precision}, compiled," if self.compiled else self.precision
        return f"{kind} on {counted(self.threads, 'thread')}"

    @property
    def must_gain(self) -> float:
        """Return the minimum speedup over fp32 on one thread for which this is chosen."""
        precision = BF16_PAYS if self.precision == "bf16" else 1.0
        return precision * (THREADS_PAY if self.threads > 1 else 1.0)

    def decided(self, config: Config) -> Config:
        """Return the config with this precision and compilation, if the agent is merl's."""
        if not isinstance(config, AgentConfig):
            return config
        torch_compile: Literal["yes", "no"] = "yes" if self.compiled else "no"
        return dataclasses.replace(config, precision=self.precision, torch_compile=torch_compile)


@dataclass(frozen=True)
class Timing:
    """Measured times, in seconds.

    Attributes:
        update: time of one update, for each arithmetic that was tried.
        step: time of choosing an action and of one step of the run's environment, including its
            images; with `action_repeat`, of all steps of one action.
        frame: time of one frame of a video; 0 without videos.
        not_compiled: why updates cannot be compiled; None if compilation works or was not tried.
        knows_env: whether `step` includes the environment's step; if not, it is only the time of
            choosing an action.
    """

    update: Mapping[Arithmetic, float]
    step: float
    frame: float = 0.0
    not_compiled: str | None = None
    knows_env: bool = True

    @property
    def best(self) -> Arithmetic:
        """Return the fastest arithmetic; bf16 and more threads only if they are clearly faster."""
        return min(self.update, key=lambda kind: self.update[kind] * kind.must_gain)

    def seconds(self, config: TrainConfig, done: int = 0) -> float:
        """Return the time of a run from step `done` to its end, including evaluations.

        The time is a lower bound if `step` does not include the environment's step (`knows_env`).
        """
        steps = max(0, config.steps - done)
        repeat = config.action_repeat
        updates = (config.steps - max(done, config.seed_steps)) * config.updates_per_step
        count = config.eval.count(steps)
        evaluations = count * config.eval.episodes
        length = 250 / repeat  # assumed number of actions in an episode
        videos = {"each": count, "last": min(1, count), "none": 0}[config.eval.video]
        total = max(0.0, updates) * self.update[self.best] + videos * length * self.frame
        total += (steps / repeat + evaluations * length) * self.step
        return min(total, (config.minutes or float("inf")) * 60)


def measure(
    config: TrainConfig,
    env: gymnasium.Env[Any, Any],
    eval_env: gymnasium.Env[Any, Any],
    space: spaces.Dict,
    device: torch.device,
) -> Timing:
    """Time the update in every arithmetic that the config allows, and the environment's step.

    On a CPU, try the precisions on one thread, then the fastest on all cores, or on all but one if
    environments step beside the updates. On a GPU, use all threads, and also try the fastest
    precision compiled. Do not reset, step or render a user's own environments.

    Args:
        config: the config of the run.
        env: the environment for training.
        eval_env: the environment for evaluations, which renders the videos.
        space: the observation space of the agent.
        device: device of the networks.

    Raises:
        MerlError: the config asks for a compiled update, and compilation fails; or the update
            returns no metrics.
    """
    cores = len(os.sched_getaffinity(0))
    threads = config.threads or (cores if device.type == "cuda" else 1)
    most = cores if config.synchronous else cores - 1
    precisions: tuple[Literal["fp32", "bf16"], ...] = ("fp32",)
    compiled = False
    if isinstance(config.agent, AgentConfig):
        asked, compiled = config.agent.precision, config.agent.torch_compile == "yes"
        precisions = ("fp32", "bf16") if asked == "auto" else (asked,)
    assert isinstance(env.action_space, spaces.Box)
    with torch_settings(device):
        batch = random_batch(config, space, env.action_space)  # on the host, like replay batches
    update: dict[Arithmetic, float] = {}

    def attempt(arithmetic: Arithmetic) -> Agent:
        torch.set_num_threads(arithmetic.threads)
        try:
            with torch_settings(device):
                agent = _agent(config, space, batch, device, arithmetic)
                update[arithmetic] = _time_update(config.agent_name, agent, batch, device)
        except Exception as error:
            if arithmetic.compiled:
                raise _CompileError(error) from error
            raise
        return agent

    for precision in precisions:
        agent = attempt(Arithmetic(precision, threads, compiled))
    fastest = Timing(update, 0.0).best
    if config.threads is None and most > threads:
        attempt(dataclasses.replace(fastest, threads=most))
    torch.set_num_threads(threads)
    with torch_settings(device):
        step, frame = _time_acting(agent, batch, device), 0.0
    if not config.has_user_env:
        makes_videos = config.eval.video != "none" and eval_env.render_mode == "rgb_array"
        frame = _time_frame(eval_env) if makes_videos else 0.0
        step += _time_step(env)
    timing = Timing(update, step, frame, knows_env=not config.has_user_env)
    if not worth_compiling(config, timing, device):
        return timing
    print("merl: trying torch.compile once, which takes a minute or two", file=sys.stderr)
    try:
        attempt(dataclasses.replace(fastest, compiled=True))
    except _CompileError as failure:
        return dataclasses.replace(timing, not_compiled=failure.reason)
    return timing


def worth_compiling(config: TrainConfig, timing: Timing, device: torch.device) -> bool:
    """Return whether to try a compiled update: on a GPU, for a long run, if the config allows it.

    On a CPU a compiled update was never faster (docs/explanation/benchmarks.md).
    """
    agent = config.agent
    left_open = isinstance(agent, AgentConfig) and agent.torch_compile == "auto"
    return left_open and device.type == "cuda" and timing.seconds(config) > WORTH_COMPILING


def random_batch(config: TrainConfig, space: spaces.Dict, actions: spaces.Box) -> Batch:
    """Return random values in the form of a replay batch; the same config gives the same batch."""
    generator = torch.Generator().manual_seed(0)
    size, stack = config.replay.batch_size, config.replay.frame_stack

    def observation() -> dict[str, torch.Tensor]:
        return {
            key: modality.random(size, stack, generator)
            for key, modality in modalities_of(space).items()
        }

    return Batch(
        observation(),
        torch.rand((size, *actions.shape), generator=generator) * 2 - 1,
        torch.rand(size, generator=generator),
        torch.full((size,), 0.97),
        observation(),
    )


def _agent(
    config: TrainConfig,
    space: spaces.Dict,
    batch: Batch,
    device: torch.device,
    arithmetic: Arithmetic,
) -> Agent:
    agent = make_agent(
        config.agent_name,
        arithmetic.decided(config.agent),
        space,
        spaces.Box(-1.0, 1.0, batch.action.shape[1:]),
        frame_stack=config.replay.frame_stack,
        seed=0,
        device=device,
    )
    speed_up(agent)
    return agent


def _time_update(name: str, agent: Agent, batch: Batch, device: torch.device) -> float:
    update: Update = lambda step: agent.update(batch, step=step)  # noqa: E731
    warm_up, repeats = 1, REPEATS  # the first update also initialises, e.g. the optimizers
    if device.type == "cuda" and isinstance(agent, Accelerable):  # as in training
        on_device = batch.to(device)
        update, repeats = Recorded(agent, lambda: on_device), REPEATS_ON_GPU
        warm_up = Recorded.WARM_UP + 1

    def timed() -> None:
        metrics = update(0)
        _check_metrics(name, metrics)
        for value in metrics.values():
            float(value)  # reading it waits for the device

    for _ in range(warm_up):
        timed()
    return _median_seconds(timed, repeats)


def _check_metrics(name: str, metrics: Any) -> None:
    """Check what the update of an agent, perhaps the user's own, has returned.

    Raises:
        MerlError: it is no dict of scalar tensors.
    """
    scalars = isinstance(metrics, Mapping) and all(
        isinstance(value, torch.Tensor) and not value.shape for value in metrics.values()
    )
    if not scalars:
        returned = " ".join(repr(metrics).split())[:80]
        raise MerlError(
            f"update() of agent {name!r} returned {returned}: return a dict of scalar tensors"
        )


class _CompileError(MerlError):
    """A compiled update does not run on this machine."""

    def __init__(self, error: Exception) -> None:
        self.reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        super().__init__(
            f"agent.torch-compile yes: the compiled update fails here ({self.reason}): use "
            "--agent.torch-compile no"
        )


def _time_acting(agent: Agent, batch: Batch, device: torch.device) -> float:
    one = {key: value[:1].to(device) for key, value in batch.observation.items()}

    def act() -> None:
        agent.act(one, explore=True, step=0).cpu()

    act()
    return _median_seconds(act)


def _time_step(env: gymnasium.Env[Any, Any]) -> float:
    env.reset(seed=0)
    action = env.action_space.sample()

    def steps() -> None:
        for _ in range(MEASURED_STEPS):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return _median_seconds(steps) / MEASURED_STEPS


def _time_frame(env: gymnasium.Env[Any, Any]) -> float:
    env.reset(seed=0)
    env.render()
    return _median_seconds(env.render)


def _median_seconds(function: Callable[[], object], repeats: int = REPEATS) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return median(seconds)
