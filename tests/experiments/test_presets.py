"""The values of the presets: the paper's numbers, and the changes for tasks and agents."""

import dataclasses

import pytest

from merl.agents import AGENTS
from merl.config import EvaluationConfig, TrainConfig
from merl.core import MerlError
from merl.experiments.presets import PRESETS, PUBLISHED, compose


def test_preset_paper_is_table_1() -> None:
    config = compose("paper", "reach_duplo")
    evaluation = EvaluationConfig(references=True)
    assert config == TrainConfig("reach_duplo", eval=evaluation)  # every default is the paper's
    assert (config.steps, config.random_steps, config.seed_steps) == (1_000_000, 2000, 4000)
    assert (config.updates_per_step, config.action_repeat) == (1, 1)
    assert (config.env.renderer, config.env.image_size, config.env.proprio) == ("gl", 84, "paper")
    replay = config.replay
    assert (replay.capacity, replay.batch_size, replay.frame_stack) == (1_000_000, 256, 3)
    assert (replay.n_step, replay.discount) == (3, 0.99)
    agent = config.agent
    assert (agent.learning_rate, agent.tau, agent.latent_dim) == (1e-4, 0.01, 128)
    assert (agent.noise_std, agent.noise_clip, agent.shift_pad) == (0.2, 0.3, 4)
    assert (agent.conv_channels, agent.conv_strides) == (32, (2, 1, 1, 1))
    assert (agent.hidden_dim, agent.encoders) == (1024, {})


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "paper"])
def test_presets_for_machines_without_opengl_use_raster(preset: str) -> None:
    assert compose(preset, "reach_duplo").env.renderer == "raster"


@pytest.mark.parametrize("preset", PRESETS)
def test_references_are_not_measured_in_a_user_environment_by_default(preset: str) -> None:
    assert compose(preset, "move_box").eval.references
    assert not compose(preset, "my_robot:make").eval.references
    assert not TrainConfig("my_robot:make").eval.references


@pytest.mark.parametrize("preset", PRESETS)
def test_a_user_environment_is_a_single_one_with_few_random_steps(preset: str) -> None:
    config = compose(preset, "my_robot:make")
    assert (config.num_envs, config.synchronous) == (1, True)
    assert config.random_steps <= 5000
    assert config.seed_steps <= 5000


def test_preset_laptop_uses_both_cores_for_merls_own_tasks() -> None:
    config = compose("laptop", "reach_duplo")
    assert config.num_envs > 1
    assert not config.synchronous
    assert config.agent.fusion == "decoupled"


@pytest.mark.parametrize(("task", "layers"), [("reach_duplo", 3), ("move_box", 6), ("lift_box", 6)])
def test_head_layers_of_preset_paper_depend_on_the_task(task: str, layers: int) -> None:
    assert compose("paper", task).agent.head_layers == layers
    assert compose("laptop", task).agent.head_layers == 3


def test_every_preset_accepts_every_agent() -> None:
    for preset, chosen in PRESETS.items():
        assert compose(preset, "lift_box").agent_name == chosen.agent_name
        for name, kind in AGENTS.items():
            agent = kind.config
            config = compose(preset, "lift_box", name)
            assert config.agent_name == name
            assert type(config.agent) is type(agent)
            assert (config.agent.keys, config.agent.modalities) == (agent.keys, agent.modalities)
            for field, value in chosen.agent.items():
                assert getattr(config.agent, field) == value


def test_setting_published_has_the_authors_values() -> None:
    drqv2 = compose("paper", "reach_duplo", "drqv2", "published")
    assert (drqv2.action_repeat, drqv2.updates_per_step) == (2, 0.25)
    # the noise falls over 500,000 actions of two steps each
    assert (drqv2.agent.noise(0), drqv2.agent.noise(500_000)) == (1.0, pytest.approx(0.55))
    assert drqv2.agent.noise(10**7) == pytest.approx(0.1)
    assert drqv2.agent == dataclasses.replace(AGENTS["drqv2"].config, noise_steps=1_000_000)
    ddpg = compose("state", "reach_duplo", "ddpg", "published")
    assert (ddpg.agent.noise_std, ddpg.agent.noise_clip, ddpg.agent.hidden_dim) == (0.1, 0.0, 256)
    assert (ddpg.replay.n_step, ddpg.random_steps, ddpg.seed_steps) == (1, 25_000, 25_000)
    sac = compose("state", "reach_duplo", "sac", "published")
    assert (sac.replay.n_step, sac.agent.learning_rate, sac.agent.tau) == (1, 3e-4, 0.005)
    assert (sac.random_steps, sac.seed_steps) == (10_000, 10_000)
    for name in PUBLISHED:
        assert compose("laptop", "x", name, "published") != compose("laptop", "x", name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("labtop", "x"), "did you mean 'laptop'"),
        (("laptop", "x", "drq"), "did you mean 'drqv2'"),
        (("laptop", "x", "drqv2", "publshed"), "did you mean 'published'"),
        (("laptop", "x", "merl", "published"), "'merl' has no setting published"),
    ],
)
def test_unknown_names_are_refused(arguments: tuple, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(MerlError, match=message):
        compose(*arguments)
