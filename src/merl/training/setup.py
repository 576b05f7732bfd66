"""Preparation of a run before its first step: environments, agent, timing of this machine."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal

import gymnasium
import torch
from gymnasium import spaces

from merl.accelerate.speed_up import speed_up
from merl.acting.env_checks import check_instances
from merl.acting.environments import Environments, InProcessEnvs
from merl.acting.instances import EnvSpaces
from merl.acting.run_env import make_run_env, recipe, run_spaces, run_spec
from merl.acting.still import StillEnvs
from merl.acting.workers import WorkerEnvs, check_sendable
from merl.agents import imitates, make_agent
from merl.agents.config import AgentConfig, ObservationConfig
from merl.agents.ddpg import DDPG
from merl.agents.networks import load_encoder_weights, make_networks, user_encoders
from merl.config import CUSTOM, Source, TrainConfig
from merl.core import Agent, MerlError, counted, user_code
from merl.core.resources import available_memory, keep_freed_memory
from merl.demos.demonstrations import Demonstrations
from merl.envs.user_env import MakeEnv, load_module
from merl.evaluation.policy import load_policy
from merl.evaluation.video import MIN_SIDE
from merl.replay import ReplayBuffer, ReplaySpec, check_fits
from merl.replay.mixing import MixedReplay
from merl.runs.resume import left_open
from merl.runs.run_folder import refuse_existing, run_path
from merl.training.corrections import Corrections
from merl.training.loop import Progress, Randomness
from merl.training.timing import measure


class Setup:
    """Environments, agent, progress and random streams of a run.

    Attributes:
        config: the run's config, with fixed values of `device`, `threads`, and the agent's
            `precision`, `torch_compile` and `critic_high`.
        left_open: names of the fields that the given config left open.
        make: makes the environment, if the config does not name it; else None.
        timing: time of a step and of an update on this machine.
        env: the environment for training.
        eval_env: the environment for evaluation; None without evaluations (`eval.every` is 0).
        home: the working folder at the start; a relative run folder is relative to it.
        records_video: whether `eval_env` renders images.
        spec: what the agent observes.
        space: the observation space, with the keys that the agent uses.
        action_space: the action space.
        replay_spec: what the replay stores.
        device: device of the networks.
        demos: the demonstrations; None if the run has none.
        agent: the learner.
        progress: counts of steps, updates and episodes.
        randomness: the random streams of the run.
    """

    def __init__(
        self,
        config: TrainConfig,
        env: gymnasium.Env[Any, Any],
        eval_env: gymnasium.Env[Any, Any] | None,
        home: Path,
        replay_spec: ReplaySpec,
        make: MakeEnv | None,
    ) -> None:
        self.env, self.eval_env, self.home, self.make = env, eval_env, home, make
        self.replay_spec = replay_spec
        self.records_video = eval_env is not None and eval_env.render_mode == "rgb_array"
        self.spec = run_spec(config, env)
        self.space, self.action_space = run_spaces(config, env)
        self.device = choose_device(config.device)
        bounded(config.agent, config)  # reject bad values before timing
        check_memory(config, self.space, self.action_space)
        keep_freed_memory()
        # Without evaluations there are no videos: do not time their frames.
        timed = config
        if eval_env is None:
            timed = dataclasses.replace(config, eval=dataclasses.replace(config.eval, video="none"))
        self.demos, config = load_demos(config, self.space, self.action_space, home)
        self.left_open = left_open(config)
        self.timing = measure(timed, env, eval_env or env, self.space, self.device)
        best = self.timing.best
        torch.set_num_threads(best.threads)
        self.config = dataclasses.replace(
            config,
            threads=best.threads,
            device=device_name(config.device),
            agent=bounded(best.decided(config.agent), config),
        )
        self.progress, self.randomness = Progress(), Randomness(config.seed)
        self.agent: Agent = make_agent(
            config.agent_name,
            self.config.agent,
            self.space,
            self.action_space,
            frame_stack=config.replay.frame_stack,
            seed=self.randomness.agent,
            device=self.device,
            threads=best.threads,
        )
        speed_up(self.agent)

    def make_environments(self) -> Environments:
        """Return the environments that the run trains in: `env`, or worker processes.

        An agent that imitates moves nothing while it trains, and actors act elsewhere.
        """
        if self.imitates or self.config.has_actors:
            return StillEnvs(self.space, self.action_space, self.config.num_envs)
        if self.config.has_workers:
            count, timeout = self.config.num_envs, self.config.worker_timeout
            return WorkerEnvs(recipe(self.config, self.make), self.env, count, timeout)
        return InProcessEnvs(self.env)

    @property
    def imitates(self) -> bool:
        """Whether the agent learns from demonstrations alone."""
        return imitates(self.config.agent_name)

    def batches_from(
        self, replay: ReplayBuffer, corrections: Corrections | None
    ) -> ReplayBuffer | MixedReplay:
        """Return the source of batches: the run's replay, with its demonstrations if it has any."""
        if self.demos is None:
            return replay
        demos = [self.demos] if corrections is None else [self.demos, corrections.replay]
        return MixedReplay(replay, demos, self.config.demos_ratio)

    @classmethod
    @contextmanager
    def prepare(
        cls,
        config: TrainConfig,
        *,
        new: bool,
        source: Source = CUSTOM,
        make: MakeEnv | None = None,
    ) -> Iterator[Setup]:
        """Make environments and agent of a run, and check its config; write no files.

        Args:
            config: the config of the run.
            new: whether the run is new: its folder must not exist, its replay must fit, and the
                modules of the user's environment and encoders may be in the working folder.
            source: where the config's values come from; it names the folder of a new run.
            make: makes the environment, if the config does not name it.

        Raises:
            MerlError: a device, a renderer, an observation or a folder is not available, or a size
                does not fit.
        """
        choose_device(config.device)
        processors = os.cpu_count() or 1
        if config.threads is not None and config.threads > processors:
            raise MerlError(
                f"threads is {config.threads}, but this machine has "
                f"{counted(processors, 'processor')}: use at most {processors}"
            )
        home = Path.cwd()  # before user code runs, which may change the working folder
        if new:
            refuse_existing(run_path(config, source, home))
            if config.has_user_env and ":" in config.task and make is None:
                load_module(config.task, home)
            for name in user_encoders(config.agent):
                user_code.load_module(name, home, kind="encoder")
        if config.has_workers:
            check_sendable(recipe(config, make), config.num_envs)
        with ExitStack() as stack:
            env = make_run_env(config, make)
            stack.callback(env.close)
            replay_spec = ReplaySpec.of(
                config.replay,
                *run_spaces(config, env),
                capacity=config.capacity,
                rings=config.num_envs,
            )
            if new:
                check_fits(replay_spec, run_path(config, source, home))
            eval_env = None
            if config.eval.every:
                size = max(config.env.render_size, MIN_SIDE)
                # Without videos, avoid the reset that tests whether a user's environment renders.
                mode = None if config.has_user_env and config.eval.video == "none" else "rgb_array"
                eval_env = make_run_env(config.evaluated, make, render_mode=mode, render_size=size)
                stack.callback(eval_env.close)
                expected = EnvSpaces.of(env)
                expected.check(EnvSpaces.of(eval_env), "the one for evaluations")
                if config.has_user_env:
                    check_instances(env, eval_env)
            yield cls(config, env, eval_env, home, replay_spec, make)


def bounded(agent: ObservationConfig, config: TrainConfig) -> ObservationConfig:
    """Return an agent's config with a value of `critic_high`, if its critic predicts a histogram.

    Rewards of merl's tasks are at most 1 a step; an action may take several.

    Raises:
        MerlError: the discount gives no bound of the returns, or one that is not above
            `critic_low`.
    """
    discount = config.replay.discount
    if not isinstance(agent, AgentConfig):
        return agent
    if agent.critic_loss == "mse" or agent.critic_high is not None:
        return agent
    if discount == 1.0:
        raise MerlError(
            "with replay.discount 1 returns have no upper bound, but agent.critic-loss "
            f"{agent.critic_loss} needs one: set --agent.critic-high"
        )
    high = round(config.action_repeat / (1.0 - discount), 6)  # 100, not 99.99999999999991
    return dataclasses.replace(agent, critic_high=high)


def load_demos(
    config: TrainConfig, space: spaces.Dict, action_space: spaces.Box, home: Path
) -> tuple[ReplayBuffer | None, TrainConfig]:
    """Load the demonstrations of a run; return the config with their place and digest.

    Raises:
        MerlError: they cannot be read, do not fit the run, or are not those that it began with.
    """
    if config.demos is None:
        if imitates(config.agent_name):
            raise MerlError(
                f"agent {config.agent_name} learns from demonstrations alone: name a folder of "
                "them with --demos; `merl demos record` makes one"
            )
        if isinstance(config.agent, AgentConfig) and config.agent.clone_weight:
            raise MerlError(
                f"agent.clone-weight {config.agent.clone_weight} clones demonstrations: name a "
                "folder of them with --demos"
            )
        return None, config
    found = Demonstrations.open(home / config.demos)
    if found.task != config.task:
        raise MerlError(
            f"{found.path} holds demonstrations of {found.task}, not of {config.task}: name others "
            "with --demos"
        )
    if config.action_repeat > 1:
        raise MerlError(
            f"action-repeat {config.action_repeat} does not fit demonstrations, which have an "
            "action for every step: use --action-repeat 1"
        )
    for name in () if config.has_user_env else ("reward", "occluded"):
        value = config.env.form[name]
        if found.options.get(name, value) != value:
            raise MerlError(
                f"{found.path} was recorded with {name} {found.options[name]}, and the run has "
                f"{value}: their rewards do not mix"
            )
    loaded = found.load(config.replay, space, action_space)  # this checks the files
    digest = found.digest()
    if config.demos_hash not in (None, digest):
        raise MerlError(
            f"{found.path} holds other demonstrations than those with which the run began: restore "
            "them, or name their folder with --demos"
        )
    return loaded, dataclasses.replace(config, demos=found.path, demos_hash=digest)


def load_initial_weights(agent: Agent, home: Path) -> None:
    """Load the weights that the agent's config names, into an agent that starts to train.

    Args:
        agent: the agent; only merl's own have such weights.
        home: the folder to which names of files and runs are relative.

    Raises:
        MerlError: a file or a run cannot be read, or does not fit the agent.
    """
    if not isinstance(agent, DDPG):
        return
    load_encoder_weights(agent.networks, agent.config, home)
    source = agent.config.start_from
    if source is None:
        return
    other = load_policy(home / source).agent
    try:
        if not isinstance(other, DDPG):
            raise RuntimeError("it is the policy of an agent of another kind")
        agent.take_policy(other)
    except RuntimeError as error:
        first = str(error).split(":\n", 1)[-1].strip().splitlines()[0]
        raise MerlError(
            f"agent.start-from {source} does not fit: {first}: train both with the same keys, "
            "encoders and sizes"
        ) from None


def choose_device(name: str) -> torch.device:
    """Return the device of that name; "auto" is CUDA if available.

    Raises:
        MerlError: CUDA is requested and not available.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise MerlError("--device cuda: no CUDA device was found; use --device cpu or auto")
    if name == "cuda":  # shapes are fixed: timing cuDNN's convolution algorithms once pays off
        torch.backends.cudnn.benchmark = True
    return torch.device(name)


def device_name(name: str) -> Literal["cpu", "cuda"]:
    """Return the name of the device that `choose_device` chooses."""
    return "cuda" if choose_device(name).type == "cuda" else "cpu"


def check_memory(config: TrainConfig, space: spaces.Dict, action_space: spaces.Box) -> None:
    """Reject networks or batches that cannot fit into the memory of this process.

    The estimate counts the weights with gradient, Adam's moments and average, and the batch's
    inputs with the output of one layer. An update takes more, so nothing that fits is rejected.

    Raises:
        MerlError: the networks or the batch are too large.
    """
    weights = 0
    if isinstance(config.agent, AgentConfig):
        with torch.device("meta"):
            networks = make_networks(
                config.agent, space, action_space.shape[0], config.replay.frame_stack
            )
        weights = 5 * 4 * sum(parameter.numel() for parameter in networks.parameters())
    stack, size = config.replay.frame_stack, config.replay.batch_size
    inputs = 2 * 5 * size * sum(math.prod(s.shape or ()) * stack for s in space.values())
    available = available_memory()
    for name, need in (("networks of agent.*", weights), (f"replay.batch-size {size}", inputs)):
        if need > available:
            raise MerlError(
                f"{name} would take {need / 1e9:.3g} GB or more, but {available / 1e9:.3g} GB of "
                "memory are available: use smaller values"
            )
