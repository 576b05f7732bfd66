"""The config of a run: frozen dataclasses that define the command line and `config.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from merl.agents import AGENTS
from merl.agents.config import ObservationConfig, decayed
from merl.core import MerlError, check_choice, counted, suggest
from merl.core.choices import HandStart
from merl.core.fields import NOT_EMPTY, Range, check_fields
from merl.envs.config import EnvConfig, UserEnvConfig
from merl.envs.registration import ENV_IDS
from merl.replay import ReplayConfig

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
Setting = Literal["matched", "published"]
"""Source of an agent's values: MERL and the preset, or the agent's authors."""
Video = Literal["each", "last", "none"]
Device = Literal["auto", "cpu", "cuda"]
Steps = Annotated[int, Range(1, 10**12)]
NotNegative = Annotated[int, Range(0)]


@dataclass(frozen=True)
class Source:
    """Where the values of a config come from; a run records it beside the config."""

    preset: str = "custom"
    setting: Setting = "matched"


CUSTOM = Source()
"""The source of a config that is not made from a preset."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of the evaluations: the agent acts without noise, from fixed start states."""

    every: NotNegative = 10_000
    """Steps between evaluations; 0 for no evaluation at all, not even at the end. Then only one
    instance of the environment is made, as a single physical robot requires."""
    episodes: Steps = 10
    """Number of episodes of each evaluation."""
    start: Annotated[tuple[HandStart, ...], NOT_EMPTY] | None = None
    """Start of the hand in evaluations (see `--start`); if not set, the same as in training."""
    max_episode_steps: Steps = 2000
    """Limit in steps for evaluation episodes that do not end earlier."""
    video: Video = "each"
    """Evaluations of which a video is made (of the first episode)."""
    references: bool = False
    """At the end, run 20 episodes with random actions and 20 with zero actions for comparison, if
    merl does not know their returns. On by default for merl's own tasks. In your own environment
    this moves your robot at random."""

    def __post_init__(self) -> None:
        check_fields(self, "eval.")

    def count(self, steps: int) -> int:
        """Return the number of evaluations in a run of `steps` steps."""
        return max(1, steps // self.every) if self.every else 0


@dataclass(frozen=True)
class ActorsConfig:
    """Settings of a run whose environments are on other machines (`merl actor`)."""

    listen: str | None = None
    """HOST:PORT at which the run waits for its --num-envs actors, which act in its place. Another
    host than 127.0.0.1 needs a token."""
    token: Path | None = None
    """File with a secret that the actors know too; if not set, the environment variable
    MERL_TOKEN."""
    weights_every: Steps = 50
    """Updates after which the actors get the newest policy."""

    def __post_init__(self) -> None:
        check_fields(self, "actors.")


@dataclass(frozen=True)
class TrainConfig:
    """Train an agent on a task.

    The defaults here are the values of Table 1. `merl train` takes its defaults from a preset and
    prints the preset's name in its first line.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """Task: reach_duplo or another one of `merl tasks`, a Gymnasium id, or module:function,
    where the function makes an environment."""
    agent_name: tyro.conf.Suppress[str] = "merl"
    """Name of the agent, which `agent` configures: a key of `AGENTS`, or `module:Class`."""
    seed: NotNegative = 0
    """Seed of all randomness in the run."""
    steps: Steps = 1_000_000
    """Number of environment steps."""
    minutes: Annotated[float, Range(0, without=0)] | None = None
    """Time limit of the run in minutes, since start or resume."""
    run_dir: Path | None = None
    """Folder of the run, which must not exist yet; if not set, runs/TASK-AGENT-PRESET-sSEED (with
    -2, -3, ... if that exists)."""
    device: Device = "auto"
    """Device of the networks; auto uses CUDA if it is available."""
    threads: Steps | None = None
    """CPU threads of the update; if not set, one, or several if that is clearly faster."""
    random_steps: NotNegative = 2000
    """Steps with uniformly random actions at the start ("exploration steps" in Table 1)."""
    seed_steps: NotNegative = 4000
    """Steps before the first update ("seed frames" in Table 1)."""
    updates_per_step: Annotated[float, Range(0)] = 1.0
    """Updates per environment step; below 1, there is one update every few steps."""
    action_repeat: Steps = 1
    """Environment steps for which each action is repeated; all other options count environment
    steps."""
    num_envs: Annotated[int, Range(1, 1024)] = 1
    """Number of parallel environments; if more than one, each runs in its own process."""
    synchronous: bool = True
    """Learn only after the environments have finished their step. With --no-synchronous they step
    in worker processes during the update, and an update does not use the newest step yet."""
    worker_restarts: NotNegative = 10
    """Number of times that the worker processes are restarted because one died or did not answer;
    after that, the run is saved and ends."""
    worker_timeout: Annotated[float, Range(0, 10**6, without=0)] = 30.0
    """Seconds within which a worker process must answer."""
    save_every: Annotated[float, Range(0)] = 300.0
    """Seconds between checkpoints; a checkpoint waits for the end of an episode, unless that takes
    much longer."""
    log: tuple[str, ...] = ()
    """Loggers in addition to metrics.csv: tensorboard, wandb, trackio (each is an extra of this
    package)."""
    keep: Steps = 2
    """Number of recent checkpoints to keep, in addition to the best one."""
    demos: Path | None = None
    """Folder of demonstrations (`merl demos`), from which a part of each batch is drawn."""
    demos_ratio: Annotated[float, Range(0, 1, without=0)] = 0.5
    """Share of the demonstrations in each batch, in (0, 1]; at least one sample is of them."""
    demos_ratio_end: Annotated[float, Range(0, 1)] | None = None
    """Final share, reached linearly over `demos_ratio_steps`; if not set, it is constant."""
    demos_ratio_steps: Annotated[int, Range(1, 10**12)] = 500_000
    """Environment steps over which the share changes."""
    demos_pretrain: NotNegative = 0
    """Updates of agent `bc` from the demonstrations before the run, in a run of its own, RUN-bc,
    whose policy the agent starts with (`agent.start-from`)."""
    demos_freeze: bool = False
    """Keep the encoders as this cloning leaves them (`agent.frozen-encoders`): the critic, which at
    first knows nothing, does not train them, and updates take less time."""
    demos_hash: tyro.conf.Suppress[str | None] = None
    """Digest of the demonstrations; recorded when the run starts, checked when it resumes."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(
        default_factory=lambda: EnvConfig(renderer="gl")
    )
    user_env: Annotated[UserEnvConfig, tyro.conf.arg(name="env")] = field(
        default_factory=UserEnvConfig
    )
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    agent: ObservationConfig = field(default_factory=lambda: AGENTS["merl"].config)
    eval: EvaluationConfig = field(default_factory=EvaluationConfig)
    actors: ActorsConfig = field(default_factory=ActorsConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        own_agent = ":" in self.agent_name
        if not own_agent:
            check_choice("agent", self.agent_name, tuple(AGENTS))
        kind = ObservationConfig if own_agent else type(AGENTS[self.agent_name].config)
        if not isinstance(self.agent, kind) or not (own_agent or type(self.agent) is kind):
            raise MerlError(
                f"agent {self.agent_name!r} needs a config of type {kind.__name__}, not "
                f"{type(self.agent).__name__}"
            )
        if self.has_actors and self.random_steps:
            raise MerlError(
                f"random-steps is {self.random_steps}, but the actors act: set it to 0, and give "
                "--random-steps to `merl actor`"
            )
        if self.eval.start is not None and self.has_user_env:
            raise MerlError(
                f"eval.start is for merl's own tasks only: {self.task} sets its own start states; "
                "leave the option out"
            )
        _ = self.evaluated  # making this config checks its values
        if self.replay.batch_size > self.capacity:
            raise MerlError(
                f"replay.batch-size {self.replay.batch_size} is more than the "
                f"{counted(self.capacity, 'step')} that the replay will hold: use a smaller batch "
                "or more steps"
            )

    def demos_share(self, step: int) -> float:
        """Return the share of the demonstrations in a batch after `step` environment steps."""
        return decayed(self.demos_ratio, self.demos_ratio_end, step / self.demos_ratio_steps)

    @property
    def has_user_env(self) -> bool:
        """Return whether the environment is the user's own and not one of merl's tasks."""
        return self.task not in ENV_IDS

    @property
    def evaluated(self) -> TrainConfig:
        """Return this config with `eval.start` as the start of the environment."""
        if self.eval.start is None:
            return self
        env, evaluation = replace(self.env, start=self.eval.start), replace(self.eval, start=None)
        return replace(self, env=env, eval=evaluation)

    @property
    def has_workers(self) -> bool:
        """Return whether the environments run in worker processes."""
        return (self.num_envs > 1 or not self.synchronous) and not self.has_actors

    @property
    def has_actors(self) -> bool:
        """Return whether the environments are those of actors, on other machines."""
        return self.actors.listen is not None

    @property
    def lacks_env(self) -> bool:
        """Return whether only the actors can make the environment, since it is never evaluated."""
        return self.has_actors and self.has_user_env and not self.eval.every

    @property
    def eval_steps(self) -> int:
        """Return the limit of an evaluation episode in actions, each of which may be repeated."""
        return math.ceil(self.eval.max_episode_steps / self.action_repeat)

    @property
    def capacity(self) -> int:
        """Return the capacity of the replay, at most the actions that the whole run takes."""
        return min(self.replay.capacity, math.ceil(self.steps / self.action_repeat))


def override(config: T, values: Mapping[str, Any], prefix: str = "") -> T:
    """Return a config with other values.

    Args:
        config: a config.
        values: {field: value}; the field of a nested config by its dotted name, e.g.
            `agent.noise_std`, a key of a dictionary likewise (`agent.encoders.wrist`). A `-` in the
            name of a field counts as `_`.
        prefix: precedes the names in messages.

    Raises:
        MerlError: a name is unknown, or a value cannot work.
    """
    changes: dict[str, Any] = {}
    nested: dict[str, dict[str, Any]] = {}
    names = [field.name for field in fields(config)]
    for name, value in values.items():
        first, _, rest = name.partition(".")
        first = first.replace("-", "_")
        part: Any = getattr(config, first, None)
        if first not in names or (rest and not (is_dataclass(part) or isinstance(part, dict))):
            raise MerlError(f"config {prefix}{name!r} is unknown: {suggest(first, names)}")
        if rest:
            nested.setdefault(first, {})[rest] = value
        else:
            changes[first] = value
    for first, inner in nested.items():
        part = changes.get(first, getattr(config, first))
        nests = is_dataclass(part)
        changes[first] = override(part, inner, f"{prefix}{first}.") if nests else part | inner
    return replace(config, **changes)


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return the value of every field by its name, as `override` takes them."""
    values: dict[str, Any] = {}
    for field_ in fields(config):
        value = getattr(config, field_.name)
        if is_dataclass(value):
            values |= flat(value, f"{prefix}{field_.name}.")
        else:
            values[prefix + field_.name] = value
    return values
