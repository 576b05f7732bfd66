"""MERL: DDPG, given the right multimodal representation. Read it beside Algorithm 1 of the paper.

The procedures are the learner's (`merl.agents.ddpg`); this file says what MERL puts into it:

    Algorithm 1                           here
    f_xi, image encoder                   encoders.images[key]: four convolutions, random shift
    g_zeta, proprioception encoder        encoders.vectors[key]: identity, or an MLP
    h_psi_critic, h_psi_actor             critic_fusion, actor_fusion: Linear, LayerNorm, tanh
    pi_theta, Q_phi1 and Q_phi2           actor, critic: MLPs with LayerNorm and ReLU
    Q_phi1-bar, Q_phi2-bar                critic_target: the Q-heads alone are averaged
    UPDATECRITIC, UPDATEACTOR             DDPG.update_critic, DDPG.update_actor

Where the paper is silent or contradicts itself, `docs/paper.md` says what was chosen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

import torch
from gymnasium import spaces

from merl.agents.ddpg import DDPG, DDPGConfig, Networks
from merl.core import MerlError, check_choice, is_image, is_vector
from merl.networks.encoders import ConvEncoder, VectorEncoder
from merl.networks.fusion import Fusion, Squash
from merl.networks.heads import Actor, HeadSize, TwinCritic
from merl.networks.initialization import orthogonal
from merl.networks.representation import Encoders

WIDEST = 65_536
"""More than any layer here has ever been given."""


@dataclass(frozen=True)
class MERLConfig(DDPGConfig):
    """What MERL is made of; the values are Table 1's and Appendix C.1's."""

    images: tuple[str, ...] | None = None
    """Image keys to see; every one that the environment gives, if not set."""
    vectors: tuple[str, ...] | None = None
    """Vector keys to feel; every one that the environment gives but `state`, if not set."""
    latent_dim: int = 128
    """d, the length of the fused representation, split evenly over the modalities."""
    fusion_norm: bool = True
    """LayerNorm in the fusion (Figure 3c)."""
    squash: Squash = "tanh"
    """What bounds the fused representation: tanh, or a softmax over groups of eight."""
    shift_pad: int = 4
    """Random shift: how many pixels to each side."""
    conv_channels: int = 32
    """Channels of each of the image encoder's convolutions."""
    conv_strides: tuple[int, ...] = (2, 1, 1, 1)
    """Strides of the image encoder's convolutions."""
    vector_encoder_dim: int = 0
    """Width of the MLP that encodes each vector; 0 is the identity (Figure 5)."""
    standardize: bool = False
    """Bring the numbers of a vector to one scale, by the mean and the deviation of the first
    batches; the paper takes them as they are."""
    head_layers: int = 3
    """Linear layers of actor and critic, the output layer counted (paper: 3 for reach, else 6)."""
    hidden_dim: int = 1024
    """Width of the hidden layers of actor and critic."""
    head_norm: bool = True
    """LayerNorm in the hidden layers of actor and critic."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("latent_dim", "conv_channels", "head_layers", "hidden_dim"):
            if not 1 <= getattr(self, name) <= WIDEST:
                flag = name.replace("_", "-")
                raise MerlError(
                    f"agent.{flag} must be at least 1 and at most {WIDEST}, "
                    f"not {getattr(self, name)}"
                )
        check_choice("agent.squash", self.squash, get_args(Squash))
        for name in ("shift_pad", "vector_encoder_dim"):
            if not 0 <= getattr(self, name) <= WIDEST:
                flag = name.replace("_", "-")
                raise MerlError(
                    f"agent.{flag} must be at least 0 and at most {WIDEST}, "
                    f"not {getattr(self, name)}"
                )
        if not self.conv_strides or min(self.conv_strides) < 1:
            raise MerlError(
                f"agent.conv-strides {self.conv_strides} must name a stride of at least 1 for each "
                "convolution"
            )


def modalities(config: MERLConfig, space: spaces.Dict) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The image keys and the vector keys that the agent consumes, checked against the space."""
    images = _keys("images", config.images, [k for k, s in space.items() if is_image(s)])
    given = [k for k, s in space.items() if is_vector(s)]
    vectors = _keys("vectors", config.vectors, given, default=[k for k in given if k != "state"])
    if not images and not vectors:
        hint = (
            "name it with --agent.vectors state"
            if "state" in given
            else ("an image is a uint8 box (H, W, C), a vector a float box (n,)")
        )
        raise MerlError(f"MERL finds nothing to sense among {sorted(space)}: {hint}")
    return images, vectors


def make_networks(config: MERLConfig, space: spaces.Dict, action_dim: int, stack: int) -> Networks:
    """Build and initialise MERL's networks for stacks of `stack` frames (torch's global seed)."""
    images, vectors = modalities(config, space)
    encoders = Encoders(
        {key: _image_encoder(config, space[key], stack) for key in images},
        {key: _vector_encoder(config, space[key]) for key in vectors},
        pad=config.shift_pad,
    )
    critic_fusion, actor_fusion = (
        Fusion(encoders.features, config.latent_dim, config.fusion_norm, config.squash)
        for _ in range(2)
    )
    size = HeadSize(config.head_layers, config.hidden_dim, config.head_norm)
    critic = TwinCritic(config.latent_dim, action_dim, size)
    actor = Actor(config.latent_dim, action_dim, size)
    networks = Networks(encoders, critic_fusion, critic, actor_fusion, actor)
    orthogonal(networks)
    return networks


def make_merl(
    config: MERLConfig,
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    *,
    frame_stack: int,
    seed: int,
    device: torch.device,
) -> DDPG:
    """MERL for these spaces: the learner over MERL's networks, initialised from `seed`."""
    torch.manual_seed(seed)
    networks = make_networks(config, observation_space, action_space.shape[0], frame_stack)
    return DDPG(networks, config, seed=seed, device=device)


def _image_encoder(config: MERLConfig, space: spaces.Space[Any], stack: int) -> ConvEncoder:
    assert space.shape is not None
    height, width, channels = space.shape
    if config.shift_pad >= min(height, width):
        raise MerlError(
            f"agent.shift-pad {config.shift_pad} moves a picture of {height}x{width} pixels out of "
            f"sight: give at most {min(height, width) - 1}"
        )
    return ConvEncoder(stack * channels, (height, width), config.conv_channels, config.conv_strides)


def _vector_encoder(config: MERLConfig, space: spaces.Space[Any]) -> VectorEncoder:
    assert space.shape is not None
    return VectorEncoder(space.shape[0], config.vector_encoder_dim, config.standardize)


def _keys(
    kind: str, chosen: tuple[str, ...] | None, given: list[str], default: list[str] | None = None
) -> tuple[str, ...]:
    if chosen is None:
        return tuple(given if default is None else default)
    for key in chosen:
        if key not in given:
            raise MerlError(f"agent.{kind} names {key!r}, but the environment gives {given}")
    return chosen
