"""MERL's config: Table 1, the modalities that it uses, and rejected values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from merl.agents import make_agent
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.agents.networks import observation_spec
from merl.core import Batch, MerlError

SPACE = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (84, 84, 3), np.uint8),
        "proprio": spaces.Box(-np.inf, np.inf, (24,), np.float32),
    }
)
WITH_STATE = spaces.Dict({**SPACE, "state": spaces.Box(-np.inf, np.inf, (40,), np.float32)})


def make(config: MERLConfig, space: spaces.Dict = SPACE) -> DDPG:
    action_space = spaces.Box(-1, 1, (9,), np.float32)
    device = torch.device("cpu")
    return make_agent("merl", config, space, action_space, frame_stack=3, seed=0, device=device)


def test_defaults_are_those_of_table_1() -> None:
    config = MERLConfig()
    assert config.learning_rate == 1e-4
    assert config.tau == 0.01
    assert config.noise_std == 0.2
    assert config.noise_clip == 0.3
    assert config.hidden_dim == 1024
    assert config.latent_dim == 128
    assert (config.shift_pad, config.conv_channels, config.conv_strides) == (4, 32, (2, 1, 1, 1))
    assert (config.target, config.fusion_layer, config.encoders) == ("heads", "tanh", {})


def test_networks_have_as_many_weights_as_in_the_paper() -> None:
    """Sizes are from C.1."""

    def size(module: torch.nn.Module) -> int:
        return sum(p.numel() for p in module.parameters())

    def layer(n: int, m: int, norm: bool = True) -> int:
        return n * m + m + 2 * m * norm

    networks = make(MERLConfig(head_layers=6)).networks
    assert size(networks.encoders) == (27 * 3 + 1) * 32 + 3 * (9 * 32 + 1) * 32
    fusion = layer(39_200, 64) + layer(24, 64)
    assert size(networks.critic_fusion) == size(networks.actor_fusion) == fusion
    hidden = 4 * layer(1024, 1024)
    assert size(networks.actor) == layer(128, 1024) + hidden + layer(1024, 9, norm=False)
    one = layer(128 + 9, 1024) + hidden + layer(1024, 1, norm=False)
    assert size(networks.critic) == 2 * one


def test_all_modalities_are_used_unless_keys_are_named() -> None:
    def senses(**values: Any) -> tuple[str, ...]:
        return observation_spec(MERLConfig(**values), WITH_STATE, 3).senses

    assert senses() == ("image", "proprio", "state")
    assert senses(keys=("state", "image")) == ("image", "state")
    assert senses(modalities=("vector", "sequence")) == ("proprio", "state")
    assert senses(privileged=("state",)) == ("image", "proprio")


def test_share_of_a_modality_is_rounded_down() -> None:
    networks = make(MERLConfig(latent_dim=127)).networks
    assert networks.critic_fusion.latent_dim == 126
    assert {p.out_features for p in networks.critic_fusion.projections.values()} == {63}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"keys": ("camera",)}, r"names 'camera', but the observation has \['image', 'proprio'\]"),
        ({"keys": ()}, "name some with --agent.keys"),
        ({"keys": ("proprio", "proprio")}, "names 'proprio' twice"),
        ({"modalities": ("depth",)}, "add --agent.modalities image vector"),
        ({"encoders": {"wrist": "conv"}}, "agent.encoders names 'wrist'"),
        ({"frozen_encoders": ("wrist",)}, "agent.frozen-encoders names 'wrist'"),
        (
            {"encoders": {"image": "conv1d"}},
            "'image': encoder 'conv1d' does not fit a key of kind image: choose from conv",
        ),
        ({"encoders": {"proprio": "ident"}}, "'ident' is unknown: did you mean 'identity'"),
        ({"encoder_weights": {"touch": "x"}}, "agent.encoder-weights names 'touch'"),
        ({"latent_dim": 3}, "3 leaves 1 for each of 2 modalities"),
        (
            {"latent_dim": 3, "privileged": ("state",)},
            r"each of 2 modalities \(image, proprio\): use at least 4",
        ),
        (
            {"latent_dim": 24, "fusion_layer": "simnorm"},
            "multiple of 8 per modality, not 12: use .* 16",
        ),
        (
            {"latent_dim": 120, "fusion_layer": "simnorm", "privileged": ("state",)},
            "not 60: use agent.latent-dim 16",
        ),
        ({"conv_strides": (4, 4, 4, 4)}, "84x84 pixels is too small"),
    ],
)
def test_config_that_does_not_fit_the_space_is_rejected(
    config: dict[str, Any], message: str
) -> None:
    with pytest.raises(MerlError, match=message):
        make(MERLConfig(**config), WITH_STATE if "privileged" in config else SPACE)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("learning_rate_end", 0.0),
        ("learning_rate_steps", 0),
        ("actor_average", 0.0),
        ("tau", 0.0),
        ("tau", 1.01),
        ("noise_std", -0.1),
        ("noise_clip", -0.1),
        ("latent_dim", -1),
        ("hidden_dim", 0),
        ("head_layers", 0),
        ("conv_channels", 0),
        ("shift_pad", -1),
    ],
)
def test_error_names_the_invalid_number(name: str, value: float) -> None:
    with pytest.raises(MerlError, match=f"agent.{name.replace('_', '-')} must .* not {value}"):
        MERLConfig(**{name: value})


def test_observation_keys_may_have_any_name() -> None:
    """Torch's `ModuleDict` rejects dots and the names of its own methods."""
    space = spaces.Dict(
        {
            "type": spaces.Box(0, 255, (16, 16, 3), np.uint8),
            "wrist camera": spaces.Box(0, 255, (20, 20, 1), np.uint8),
            "arm.joints": spaces.Box(-1, 1, (3,), np.float32),
            "training": spaces.Box(-1, 1, (2,), np.float32),
        }
    )
    agent = make(MERLConfig(latent_dim=8, hidden_dim=8), space)
    observation = {
        "type": torch.zeros((1, 3, 16, 16, 3), dtype=torch.uint8),
        "wrist camera": torch.zeros((1, 3, 20, 20, 1), dtype=torch.uint8),
        "arm.joints": torch.zeros((1, 3)),
        "training": torch.zeros((1, 2)),
    }
    assert agent.act(observation, explore=False, step=0).shape == (1, 9)
    batch = Batch(
        observation, torch.zeros((1, 9)), torch.zeros(1), torch.ones(1), dict(observation)
    )
    assert set(agent.draw(len(batch.action), agent.plan(0)).shifts) == {"type", "wrist camera"}
    agent.update(batch, step=0)
