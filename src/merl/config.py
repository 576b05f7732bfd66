"""What a run is: one frozen value that the command line is made from and `config.json` records."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from merl.agents import AGENTS
from merl.agents.config import AgentConfig
from merl.core import MerlError, check_choice, counted
from merl.envs.config import EnvConfig, StartName, UserEnvConfig
from merl.envs.registration import ENV_IDS
from merl.replay import ReplayConfig

Setting = Literal["matched", "published"]

MOST_STEPS = 10**12
"""Far beyond what anyone will wait for."""
MOST_ENVS = 1024
"""Processes that one machine may bear."""


@dataclass(frozen=True)
class EvaluationConfig:
    """How often the agent shows what it has learnt: without noise, on the same fixed starts."""

    every: int = 10_000
    """Steps between evaluations; 0 for none, at the end neither: then the environment is made only
    once, as a single device needs it."""
    episodes: int = 10
    """Episodes of each evaluation."""
    start: tuple[StartName, ...] | None = None
    """Where the hand starts in evaluations (see `--start`); as in training, if not set."""
    max_episode_steps: int = 2000
    """Steps after which an episode of an evaluation is cut, if it has not ended by itself."""
    video: Literal["each", "last", "none"] = "each"
    """Which evaluations to film (their first episode)."""
    references: bool = False
    """At the end, take 20 episodes each of random actions and of none to compare with, where merl
    does not know their returns. Set for merl's own tasks; on an environment of your own it moves
    your robot at random."""

    def __post_init__(self) -> None:
        for name, least in (("every", 0), ("episodes", 1), ("max_episode_steps", 1)):
            if getattr(self, name) < least:
                flag = name.replace("_", "-")
                raise MerlError(f"eval.{flag} must be at least {least}, not {getattr(self, name)}")

    def count(self, steps: int) -> int:
        """Return the number of evaluations of a run of `steps` steps."""
        return max(1, steps // self.every) if self.every else 0


@dataclass(frozen=True)
class TrainConfig:
    """Train an agent on a task.

    Without a preset these are Table 1's values; `merl train` takes them from the preset that it
    names in its first line.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """What is to be learnt: reach_duplo, move_box, lift_box, a Gymnasium id, or module:function
    that makes an environment."""
    preset: str = "paper"
    """paper, laptop, state or smoke: which set of values the others are taken from."""
    agent_name: Annotated[str, tyro.conf.arg(name="agent", metavar="|".join(AGENTS))] = "merl"
    """Who learns. merl: camera and joints; drqv2: camera; proprio: joints; merl_state, ddpg, sac:
    the state."""
    setting: Setting = "matched"
    """Whose numbers the agent has: MERL's and the preset's (matched), or its authors'
    (published)."""
    seed: int = 0
    """The seed of everything random in the run."""
    steps: int = 1_000_000
    """Environment steps."""
    measure: bool = False
    """Time an environment of your own before the run begins, as merl's own tasks are, with 75
    random steps; if not set, the first steps of the run are timed."""
    minutes: float | None = None
    """Stop after this many minutes (since start or resume), if the steps are not done before."""
    run_dir: Path | None = None
    """The run's folder, which must not exist yet; runs/TASK-AGENT-PRESET-sSEED (or -2, -3, ...) if
    not set."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the networks live; auto takes CUDA where it is there."""
    threads: int | None = None
    """Processor threads of the update; if not set, one, or all where that is clearly faster."""
    random_steps: int = 2000
    """Steps of uniformly random actions at the start ("exploration steps" in Table 1)."""
    seed_steps: int = 4000
    """Steps before the first update ("seed frames" in Table 1)."""
    updates_per_step: float = 1.0
    """Updates for each environment step; below 1, an update every few steps."""
    action_repeat: int = 1
    """Environment steps for which an action is held; all steps here are environment steps."""
    num_envs: int = 1
    """Environments that act at the same time; more than one, each has a process of its own."""
    synchronous: bool = True
    """The learner waits for the environments' steps. If not (--no-synchronous), they act in
    processes of their own while it learns, and an update does not know the newest step yet."""
    worker_restarts: int = 10
    """How often environments' processes are started again when one dies or does not answer, before
    the run is saved and ended."""
    worker_timeout: float = 30.0
    """Seconds in which an environment's process has to answer."""
    save_every: float = 300.0
    """Seconds between checkpoints; each waits for the end of an episode, unless that takes much
    longer."""
    keep: int = 2
    """How many of the last checkpoints are kept, beside the best."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(
        default_factory=lambda: EnvConfig(renderer="gl")
    )
    user_env: Annotated[UserEnvConfig, tyro.conf.arg(name="env")] = field(
        default_factory=UserEnvConfig
    )
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    agent: AgentConfig = field(default_factory=lambda: AGENTS["merl"])
    eval: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        check_choice("agent", self.agent_name, tuple(AGENTS))
        kind = type(AGENTS[self.agent_name])
        if type(self.agent) is not kind:
            raise MerlError(
                f"agent {self.agent_name!r} is made from a {kind.__name__}, not from a "
                f"{type(self.agent).__name__}"
            )
        most = {"num_envs": MOST_ENVS}
        for name in ("steps", "keep", "action_repeat", "num_envs"):
            if not 1 <= getattr(self, name) <= most.get(name, MOST_STEPS):
                raise MerlError(
                    f"{name.replace('_', '-')} must be at least 1 and at most "
                    f"{most.get(name, MOST_STEPS):,}, not {getattr(self, name)}"
                )
        for name in ("random_steps", "seed_steps", "seed", "worker_restarts"):
            if getattr(self, name) < 0:
                flag = name.replace("_", "-")
                raise MerlError(f"{flag} must be at least 0, not {getattr(self, name)}")
        if self.minutes is not None and not self.minutes > 0:
            raise MerlError(f"minutes must be above 0, not {self.minutes}")
        if not 0 < self.worker_timeout <= 1e6:  # some 2e6 s are more than a poll can wait
            raise MerlError(
                f"worker-timeout must be above 0 and at most 1e6 seconds, not {self.worker_timeout}"
            )
        if self.eval.start is not None and self.own_env:
            raise MerlError(
                f"eval.start is for merl's own tasks: {self.task} decides where it starts"
            )
        _ = self.evaluated  # its values are checked
        if self.threads is not None and self.threads < 1:
            raise MerlError(f"threads must be at least 1, not {self.threads}")
        for name in ("updates_per_step", "save_every"):
            if not 0 <= getattr(self, name) < math.inf:
                flag = name.replace("_", "-")
                raise MerlError(f"{flag} must be finite and at least 0, not {getattr(self, name)}")
        if self.replay.batch_size > self.capacity:
            raise MerlError(
                f"replay.batch-size {self.replay.batch_size} is more than the "
                f"{counted(self.capacity, 'step')} of the run, which is all that the replay will "
                "hold: use a smaller batch or more steps"
            )

    @property
    def own_env(self) -> bool:
        """Whether the environment is the user's own, not one of merl's tasks."""
        return self.task not in ENV_IDS

    @property
    def evaluated(self) -> TrainConfig:
        """The same with the environment that evaluations take place in."""
        if self.eval.start is None:
            return self
        env, evaluation = replace(self.env, start=self.eval.start), replace(self.eval, start=None)
        return replace(self, env=env, eval=evaluation)

    @property
    def has_workers(self) -> bool:
        """Whether environments act in processes of their own."""
        return self.num_envs > 1 or not self.synchronous

    @property
    def eval_steps(self) -> int:
        """Actions after which an episode of an evaluation is cut; each may be held for steps."""
        return math.ceil(self.eval.max_episode_steps / self.action_repeat)

    @property
    def capacity(self) -> int:
        """Steps that the replay holds: no more than the run takes, a held action counted once."""
        return min(self.replay.capacity, math.ceil(self.steps / self.action_repeat))
