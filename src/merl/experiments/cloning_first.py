"""Training that begins with cloning: a run of agent `bc`, then a run that starts with its policy.

Both are ordinary runs: RUN-bc, which stays as the baseline, and RUN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TypeVar

from merl.agents import AGENTS
from merl.agents.bc import BCConfig
from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.ibrl import IBRL
from merl.config import ActorsConfig, Source, TrainConfig, override
from merl.core import CONFIG_FILE, MerlError
from merl.experiments.presets import IMITATING
from merl.runs.run import Run
from merl.runs.run_folder import run_path

Result = TypeVar("Result")
NOT_CLONED = ("clone_weight", "clone_better", "clone_steps", "start_from")
"""Values of the agent's config that are for what follows the cloning."""


def clone_first(
    config: TrainConfig,
    source: Source,
    begin: Callable[[TrainConfig], Result],
    go_on: Callable[[Run, TrainConfig], Result],
    is_over: Callable[[Result], bool],
) -> tuple[TrainConfig, Result | None]:
    """Train the run of agent `bc` that a config asks for, unless that is done.

    Args:
        config: the config; without `demos_pretrain`, it is returned as it is.
        source: where its values come from.
        begin: trains a new run.
        go_on: resumes a run with a config.
        is_over: returns, for the result of these, whether the whole training was stopped.

    Returns:
        The config of the run that starts with the cloned policy, and the result if the cloning was
        stopped, else None.

    Raises:
        MerlError: the agent cannot start with a cloned policy, or there are no demonstrations.
    """
    if not config.demos_pretrain:
        return config, None
    folder = run_path(config, source)
    cloned = folder.with_name(f"{folder.name}-bc")
    first = _cloning(config, cloned)
    exists = (cloned / CONFIG_FILE).exists()
    result = go_on(Run.open(cloned), first) if exists else begin(first)
    agent = override(config.agent, {"start_from": cloned})
    if _freezes(config):
        keys, _ = Run.open(cloned).spaces()
        trained = tuple(key for key in keys if key not in agent.privileged)
        agent = override(agent, {"frozen_encoders": trained})
    then = replace(config, run_dir=folder, demos_pretrain=0, agent=agent)
    return then, result if is_over(result) else None


def starts_cloned(config: TrainConfig, run: Run) -> TrainConfig:
    """Return the config with which a run that `clone_first` prepared is resumed.

    A run that did not start with RUN-bc differs from it in `agent.start_from`.
    """
    if not config.demos_pretrain:
        return config
    names = ("start_from", "frozen_encoders") if _freezes(config) else ("start_from",)
    begun = {name: getattr(run.config.agent, name, None) for name in names}
    cloned = run.path.with_name(f"{run.path.name}-bc")
    if getattr(begun["start_from"], "name", None) != cloned.name:  # the folders may have moved
        begun["start_from"] = cloned
    return replace(config, demos_pretrain=0, agent=override(config.agent, begun))


def _freezes(config: TrainConfig) -> bool:
    return config.demos_freeze or config.agent_name == "ibrl"


def _cloning(config: TrainConfig, folder: Path) -> TrainConfig:
    """Return the config of agent `bc` with the same networks, for as many updates as asked."""
    agent, kind = config.agent, AGENTS.get(config.agent_name)
    if kind is None or kind.make not in (DDPG, IBRL) or not isinstance(agent, AgentConfig):
        raise MerlError(
            f"demos-pretrain {config.demos_pretrain} clones into MERL's actor, which agent "
            f"{config.agent_name} does not have: use --demos-pretrain 0"
        )
    if agent.start_from is not None:
        raise MerlError(
            f"agent.start-from {agent.start_from} and demos-pretrain {config.demos_pretrain} both "
            "name a policy to start with: leave one of them out"
        )
    if config.demos is None:
        raise MerlError(
            f"demos-pretrain {config.demos_pretrain} clones demonstrations: name a folder of them "
            "with --demos (`merl demos record` makes one), or use --demos-pretrain 0"
        )
    names = [field.name for field in fields(AgentConfig) if field.name not in NOT_CLONED]
    bc = BCConfig(**{name: getattr(agent, name) for name in names})
    every = min(config.eval.every, -(-config.demos_pretrain // 3))
    values = IMITATING | {"steps": config.demos_pretrain, "run_dir": folder, "eval.every": every}
    return override(replace(config, agent_name="bc", agent=bc, actors=ActorsConfig()), values)
