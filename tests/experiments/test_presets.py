"""Presets are values: the paper's numbers, and what a task changes in them."""

import dataclasses

import pytest

from merl.experiments.presets import ABOUT, PRESETS, preset_for
from merl.training.config import TrainConfig


def test_preset_paper_is_table_1() -> None:
    config = PRESETS["paper"]
    assert config == TrainConfig(config.task)  # every default is the paper's
    assert (config.steps, config.random_steps, config.seed_steps) == (1_000_000, 2000, 4000)
    assert config.updates_per_step == 1
    assert (config.env.renderer, config.env.image_size, config.env.proprio) == ("gl", 84, "paper")
    replay = config.replay
    assert (replay.capacity, replay.batch_size, replay.frame_stack) == (1_000_000, 256, 3)
    assert (replay.n_step, replay.discount) == (3, 0.99)
    agent = config.agent
    assert (agent.learning_rate, agent.tau, agent.latent_dim) == (1e-4, 0.01, 128)
    assert (agent.noise_std, agent.noise_clip, agent.shift_pad) == (0.2, 0.3, 4)
    assert (agent.conv_channels, agent.conv_strides) == (32, (2, 1, 1, 1))
    assert (agent.hidden_dim, agent.vector_encoder_dim) == (1024, 0)


@pytest.mark.parametrize(("task", "layers"), [("reach_duplo", 3), ("move_box", 6), ("lift_box", 6)])
def test_the_heads_of_preset_paper_follow_the_task(task: str, layers: int) -> None:
    config = preset_for("paper", task)
    assert config.agent.head_layers == layers
    agent = dataclasses.replace(config.agent, head_layers=3)
    assert dataclasses.replace(config, agent=agent) == PRESETS["paper"]
    for name in ("laptop", "state", "smoke"):
        assert preset_for(name, task) is PRESETS[name]


def test_every_preset_says_what_it_is_for() -> None:
    assert ABOUT.keys() == PRESETS.keys()
    assert all(config.preset == name for name, config in PRESETS.items())
