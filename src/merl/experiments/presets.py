"""Presets: named sets of config values. Every value can be overridden."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import torch
import tyro

from merl.agents import AGENTS, find_agent, imitates
from merl.agents.config import AgentConfig
from merl.config import EvaluationConfig, Setting, TrainConfig, override
from merl.core import MerlError, check_choice
from merl.envs.config import EnvConfig
from merl.envs.registration import ENV_IDS
from merl.replay import ReplayConfig

_TASK: str = tyro.MISSING  # the command line asks for it


@dataclass(frozen=True)
class Preset:
    """Values of a preset.

    Attributes:
        about: purpose of the preset, in one line.
        config: all values except the agent's.
        agent: values of the agent's config that differ from the agent's defaults, for every agent
            that is based on merl's learner.
        agent_name: the default agent.
        for_user_env: values that differ for a user's own environment. It may be a robot: there is
            only one, and its steps cost more than updates.
    """

    about: str
    config: TrainConfig
    agent: Mapping[str, Any] = field(default_factory=dict)
    agent_name: str = "merl"
    for_user_env: Mapping[str, Any] = field(default_factory=dict)


_SMALL: dict[str, Any] = {
    "learning_rate": 3e-4,
    "hidden_dim": 256,
    "actor_average": 0.001,
    "learning_rate_end": 1e-4,
    "learning_rate_steps": 400_000,
}
"""Values of a learner for a processor, whatever it observes (docs/explanation/laptop.md)."""
_LAPTOP = Preset(
    "made for 2 cores without a GPU: learns in half an hour",  # docs/explanation/laptop.md
    TrainConfig(
        _TASK,
        steps=1_000_000,
        random_steps=20_000,
        seed_steps=20_000,
        updates_per_step=0.0625,
        num_envs=16,
        synchronous=False,
        env=EnvConfig(renderer="raster", image_size=24, samples=3),
        replay=ReplayConfig(batch_size=128, frame_stack=2),
        eval=EvaluationConfig(every=40_000, episodes=10, video="last"),
    ),
    {**_SMALL, "conv_strides": (2, 2, 1), "shift_pad": 1},
    for_user_env={
        "steps": 150_000,
        "random_steps": 1000,
        "seed_steps": 2000,
        "updates_per_step": 1.0,
        "num_envs": 1,
        "synchronous": True,
    },
)
_DEMOS = Preset(
    "learns from demonstrations (--demos), then from its own experience too, on one core",
    dataclasses.replace(
        _LAPTOP.config,
        steps=500_000,
        random_steps=0,
        seed_steps=1000,
        updates_per_step=0.25,
        num_envs=1,
        synchronous=True,
        demos_ratio=0.25,
        demos_pretrain=30_000,
        env=dataclasses.replace(
            _LAPTOP.config.env,
            observations=("image", "wrist", "proprio", "touch"),
            reward="staged",
        ),
        eval=EvaluationConfig(every=40_000, episodes=50, video="last"),
    ),
    {**_LAPTOP.agent, "clone_weight": 1.5, "clone_better": True, "noise_std": 0.1},
    for_user_env={"steps": 100_000, "demos_pretrain": 10_000, "updates_per_step": 1.0},
)

PRESETS: dict[str, Preset] = {
    "paper": Preset(
        "Table 1, OpenGL images: for a machine with CUDA",
        TrainConfig(_TASK, env=EnvConfig(renderer="gl")),
    ),
    "laptop": _LAPTOP,
    "demos": _DEMOS,
    "state": Preset(
        "learns from the simulator's state in place of camera and joints, on one core",
        TrainConfig(
            _TASK,
            steps=500_000,
            threads=1,
            random_steps=20_000,
            seed_steps=20_000,
            updates_per_step=0.25,
            env=EnvConfig(renderer="raster", state="relative"),
            replay=ReplayConfig(batch_size=128),
            eval=EvaluationConfig(every=20_000, episodes=20, video="last"),
        ),
        {**_SMALL, "standardize": True, "precision": "fp32"},
        "merl_state",
        for_user_env={"random_steps": 5000, "seed_steps": 5000, "updates_per_step": 1.0},
    ),
    "smoke": Preset(
        "the whole pipeline in under a minute: shows that it works, learns nothing",
        TrainConfig(
            _TASK,
            steps=1000,
            random_steps=250,
            seed_steps=250,
            updates_per_step=0.1,
            env=EnvConfig(renderer="raster", image_size=32),
            replay=ReplayConfig(batch_size=32),
            eval=EvaluationConfig(every=500, episodes=2, video="last"),
        ),
        {"conv_strides": (2, 2, 1, 1), "shift_pad": 2, "hidden_dim": 128},
    ),
}

_EVERY_STEP = {"updates_per_step": 1.0, "replay.batch_size": 256, "replay.n_step": 1}
HEAD_LAYERS = {"move_box": 6, "lift_box": 6}
"""Layers of MERL's heads in preset `paper`, for tasks with other than three (MERL C.1)."""


IMITATING = {
    "demos_ratio": 1.0,
    "demos_ratio_end": None,
    "demos_pretrain": 0,
    "num_envs": 1,
    "synchronous": True,
    "updates_per_step": 1.0,
    "random_steps": 0,
    "seed_steps": 0,
    "steps": 30_000,
}
"""Values of an agent that learns from demonstrations alone: its steps move nothing, and each is an
update."""

PUBLISHED: dict[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    # DrQ-v2's repository, for its tasks of medium difficulty: each action is held for two steps, an
    # update every second action, 2000 random actions, noise that falls over 500,000 actions.
    "drqv2": (
        {
            "action_repeat": 2,
            "updates_per_step": 0.25,
            "random_steps": 4000,
            "seed_steps": 4000,
            "replay.batch_size": 256,
        },
        {"noise_steps": 1_000_000},
    ),
    # TD3's repository; its DDPG has noise in its actions and none in its updates.
    "ddpg": (
        {"random_steps": 25_000, "seed_steps": 25_000, **_EVERY_STEP},
        {
            "learning_rate": 3e-4,
            "tau": 0.005,
            "hidden_dim": 256,
            "noise_std": 0.1,
            "noise_clip": 0.0,
        },
    ),
    # Haarnoja et al. 2018b, Table 1; SAC's repository begins with ten episodes of random actions.
    "sac": (
        {"random_steps": 10_000, "seed_steps": 10_000, **_EVERY_STEP},
        {"learning_rate": 3e-4, "tau": 0.005, "hidden_dim": 256},
    ),
}
"""Values that replace the preset's with `--setting published` (docs/explanation/agents/): those of
the run and those of the agent's config."""


def default_preset() -> str:
    """Return the preset for this machine: `paper` with CUDA, else `laptop`."""
    return "paper" if torch.cuda.is_available() else "laptop"


def compose(
    preset: str, task: str, agent: str | None = None, setting: Setting = "matched"
) -> TrainConfig:
    """Return the config of a preset, task, agent and setting.

    Args:
        preset: a key of `PRESETS`.
        task: the name of the task.
        agent: a key of `AGENTS`, or `module:Class`, which may be in the working folder; by default
            the preset's agent.
        setting: `matched`: the preset's values for the agent, which are MERL's; `published`: the
            values of the agent's authors.

    Raises:
        MerlError: the agent has no published setting, or a name is unknown.
    """
    check_choice("preset", preset, tuple(PRESETS))
    chosen = PRESETS[preset]
    name = agent or chosen.agent_name
    base = find_agent(name, Path.cwd()).config
    check_choice("setting", setting, get_args(Setting))
    config = dataclasses.replace(chosen.config, task=task)
    # A user's environment may be a robot, which must not move unless asked.
    config = override(
        config, chosen.for_user_env if config.has_user_env else {"eval.references": True}
    )
    if imitates(name):
        config = override(config, IMITATING)
    values = _agent_values(base, preset, config) if isinstance(base, AgentConfig) else {}
    if setting == "published":
        if name not in PUBLISHED:
            raise MerlError(
                f"agent {name!r} has no setting published: choose from {', '.join(PUBLISHED)}; for "
                "the paper's values use preset paper"
            )
        config, values = override(config, PUBLISHED[name][0]), dict(PUBLISHED[name][1])
    if base.keys and name in AGENTS and task not in ENV_IDS:  # only merl's tasks have `state`
        values |= {"keys": None, "modalities": ("vector", "sequence")}
    made = dataclasses.replace(base, **values)
    return dataclasses.replace(config, agent_name=name, agent=made)


def _agent_values(base: AgentConfig, preset: str, config: TrainConfig) -> dict[str, Any]:
    """Return the values of a preset for an agent that is based on merl's learner."""
    values = dict(PRESETS[preset].agent)
    if preset == "paper" and base.head_norm:
        values["head_layers"] = HEAD_LAYERS.get(config.task, base.head_layers)
    if base.noise_std_end is not None:  # the noise falls within the run
        values["noise_steps"] = min(base.noise_steps, config.steps // 2)
    return values
