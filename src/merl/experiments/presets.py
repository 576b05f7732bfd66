"""Presets: a name for a whole set of values. They only compose; every value can be overridden."""

from __future__ import annotations

import dataclasses

import tyro

from merl.agents.merl import MERLConfig
from merl.envs.config import EnvConfig
from merl.replay import ReplayConfig
from merl.training.config import EvaluationConfig, TrainConfig

_TASK: str = tyro.MISSING  # the command line asks for it

PRESETS: dict[str, TrainConfig] = {
    # Table 1 of the paper, on pictures as OpenGL draws them.
    "paper": TrainConfig(_TASK, preset="paper"),
    # Made for two cores without a GPU: what learns most per minute (docs/laptop.md).
    "laptop": TrainConfig(
        _TASK,
        preset="laptop",
        steps=200_000,
        # An hour of updates is short and random steps are cheap: begin with some that met a reward.
        random_steps=10_000,
        seed_steps=10_000,
        env=EnvConfig(renderer="warp", image_size=48),
        replay=ReplayConfig(batch_size=128),
        agent=MERLConfig(
            learning_rate=3e-4, conv_strides=(3, 2, 1, 1), shift_pad=2, hidden_dim=256
        ),
        eval=EvaluationConfig(every=10_000, episodes=10, video="last"),
    ),
    # No camera: the simulator's state, small networks, one core (docs/tasks.md).
    "state": TrainConfig(
        _TASK,
        preset="state",
        steps=500_000,
        threads=1,
        env=EnvConfig(renderer="warp", observations=("state",)),
        agent=MERLConfig(vectors=("state",), hidden_dim=256, precision="fp32"),
        eval=EvaluationConfig(every=20_000, episodes=20, video="last"),
    ),
    # The whole pipeline in under a minute; too short to learn anything.
    "smoke": TrainConfig(
        _TASK,
        preset="smoke",
        steps=1000,
        random_steps=250,
        seed_steps=250,
        updates_per_step=0.1,
        env=EnvConfig(renderer="warp", image_size=32),
        replay=ReplayConfig(batch_size=32),
        agent=MERLConfig(conv_strides=(2, 2, 1, 1), shift_pad=2, hidden_dim=128),
        eval=EvaluationConfig(every=500, episodes=2, video="last"),
    ),
}

HEAD_LAYERS = {"move_box": 6, "lift_box": 6}
"""Layers of the heads in preset `paper`, where the task wants others than three (MERL C.1)."""


def preset_for(name: str, task: str) -> TrainConfig:
    """A preset as it is for a task.

    Args:
        name: a key of `PRESETS`.
        task: what is to be learnt; only preset `paper` asks.
    """
    preset = PRESETS[name]
    if name != "paper" or task not in HEAD_LAYERS:
        return preset
    agent = dataclasses.replace(preset.agent, head_layers=HEAD_LAYERS[task])
    return dataclasses.replace(preset, agent=agent)


ABOUT = {
    "paper": "Table 1, OpenGL pictures: for a machine with CUDA",
    "laptop": "made for 2 cores without a GPU: learns in about an hour",
    "state": "learns from the simulator's state in place of camera and joints, on one core",
    "smoke": "the whole pipeline in under a minute: shows that it works, learns nothing",
}
