"""Networks of an agent, built from its config for an environment's observations."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.agents.config import AgentConfig, ObservationConfig
from merl.core import MerlError, is_image, is_vector
from merl.networks.critic import TwinCritic
from merl.networks.encoders import ConvEncoder, VectorEncoder
from merl.networks.fusion import SIMNORM_GROUP, Concatenation, Fusion
from merl.networks.heads import Actor, GaussianActor, HeadSize
from merl.networks.initialization import orthogonal
from merl.networks.representation import Encoders
from merl.networks.returns import HLGauss, Returns, Scalar

DEFAULT_HIGH = 100.0
"""Highest return for rewards in [0, 1] and a discount of 0.99."""
LEAST_SHARE = 2
"""Minimum length of a modality's part of the fused representation."""


class Networks(nn.Module):
    """Networks of Algorithm 1, without the targets.

    Attributes:
        encoders: f_xi and g_zeta, trained by the critic's loss.
        critic_fusion: h_psi of the critic.
        critic: Q_phi1 and Q_phi2.
        actor_fusion: h_psi of the actor; None if the actor uses the critic's.
        actor: pi_theta.
        policy_average: moving average of the actor and its fusion, which acts in evaluation and
            deployment; None if the newest weights act.
    """

    def __init__(
        self,
        encoders: Encoders,
        critic_fusion: Fusion | Concatenation,
        critic: TwinCritic,
        actor_fusion: Fusion | Concatenation | None,
        actor: Actor | GaussianActor,
    ) -> None:
        super().__init__()
        self.encoders = encoders
        self.critic_fusion = critic_fusion
        self.critic = critic
        self.actor_fusion = actor_fusion
        self.actor = actor
        self.policy_average: nn.ModuleDict | None = None

    @property
    def senses(self) -> tuple[str, ...]:
        """Observation keys that the actor uses."""
        return self._fusion_of_actor().modalities

    def actor_latent(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Fuse the encodings for the actor."""
        latent: Tensor = self._fusion_of_actor()(encoded)
        return latent

    def policy(self, encoded: Mapping[str, Tensor], *, averaged: bool = False) -> Any:
        """Compute the actor's output from the encodings.

        Args:
            encoded: {key: (B, F_key)}.
            averaged: use the averaged weights, if there are any.
        """
        if averaged and self.policy_average is not None:
            return self.policy_average["actor"](self.policy_average["fusion"](encoded))
        return self.actor(self.actor_latent(encoded))

    def start_average(self) -> None:
        """Start the moving average of the actor and its fusion, as a copy of them."""
        recent = nn.ModuleDict({"fusion": self._fusion_of_actor(), "actor": self.actor})
        self.policy_average = copy.deepcopy(recent).requires_grad_(False)

    @torch.no_grad()
    def update_average(self, tau: float) -> None:
        """Update the moving average with weight `tau` for the newest weights."""
        assert self.policy_average is not None
        average: list[Tensor] = list(self.policy_average.parameters())
        recent: list[Tensor] = [*self._fusion_of_actor().parameters(), *self.actor.parameters()]
        torch._foreach_lerp_(average, recent, tau)

    def _fusion_of_actor(self) -> Fusion | Concatenation:
        return self.critic_fusion if self.actor_fusion is None else self.actor_fusion


def make_networks(
    config: AgentConfig,
    space: spaces.Dict,
    action_dim: int,
    stack: int,
    actor: type[Actor] | type[GaussianActor] = Actor,
) -> Networks:
    """Build and initialise an agent's networks, with torch's global random generator.

    Args:
        config: config of the agent.
        space: observation space of the environment.
        action_dim: A.
        stack: number of frames in an image stack.
        actor: class of the actor.

    Raises:
        MerlError: the space lacks a key that the agent uses, or the config does not fit the space.
    """
    images, vectors = modalities(config, space)
    encoders = Encoders(
        {key: _image_encoder(config, key, space[key], stack) for key in images},
        {
            key: _vector_encoder(config, space[key])
            for key in (*vectors, *privileged_keys(config, space))
        },
        pad=config.shift_pad,
    )
    senses = {key: encoders.features[key] for key in (*images, *vectors)}
    share = _share(config, tuple(senses))
    critic_fusion = _fusion(config, encoders.features, share)
    actor_fusion = None
    if config.fusion == "decoupled":
        actor_fusion = _fusion(config, senses, share)
    size = HeadSize(config.head_layers, config.hidden_dim, "layer" if config.head_norm else "none")
    critic = TwinCritic(critic_fusion.latent_dim, action_dim, size, _returns(config))
    policy = actor((actor_fusion or critic_fusion).latent_dim, action_dim, size)
    networks = Networks(encoders, critic_fusion, critic, actor_fusion, policy)
    orthogonal(networks)
    for head in (critic.q1, critic.q2):
        critic.returns.start_at_zero(head.output.bias)
    if config.actor_average is not None:
        networks.start_average()
    return networks


def modalities(
    config: ObservationConfig, space: spaces.Dict
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the image keys and the vector keys that the actor uses, checked against the space.

    Raises:
        MerlError: a named key is missing, or no key is left; the message gives the way out.
    """
    images = _keys("images", config.images, [k for k, s in space.items() if is_image(s)])
    given = [k for k, s in space.items() if is_vector(s)]
    actors = [key for key in given if key not in config.privileged]
    vectors = _keys("vectors", config.vectors, given, default=actors)
    if not images and not vectors:
        if config.vectors == () and config.images == ():
            hint = "name some with --agent.images or --agent.vectors"
        elif config.vectors == ():
            others = "merl_state, ddpg or sac" if given == ["state"] else "proprio"
            hint = f"add an image, a uint8 Box (H, W, C), or use --agent {others}"
        elif given:
            hint = "--agent.privileged leaves no vector for the actor"
        elif config.images == ():
            hint = "add a vector, a float Box (n,), or use --agent drqv2"
        else:
            hint = "an image is a uint8 Box (H, W, C), a vector is a float Box (n,)"
        raise MerlError(f"the agent can use no observation among {sorted(space)}: {hint}")
    return images, vectors


def privileged_keys(config: ObservationConfig, space: spaces.Dict) -> tuple[str, ...]:
    """Return the vector keys that only the critic observes.

    Raises:
        MerlError: a key is missing, or the actor uses it too.
    """
    given = [k for k, s in space.items() if is_vector(s)]
    keys = _keys("privileged", config.privileged, given)
    _, vectors = modalities(config, space)
    for key in keys:
        if key in vectors:
            raise MerlError(
                f"agent.privileged names {key!r}, which the actor uses too: remove it from "
                "--agent.privileged or from --agent.vectors"
            )
    return keys


def _share(config: AgentConfig, senses: tuple[str, ...]) -> int:
    """Return the length of each modality's part of d, rounded down.

    d is divided among the actor's modalities; each privileged key adds a part of the same length.

    Raises:
        MerlError: d is too small for these modalities, or does not fit the groups of `simnorm`.
    """
    share = config.latent_dim // len(senses)
    # LayerNorm would make a single number constant.
    if config.latent_dim and share < LEAST_SHARE:
        raise MerlError(
            f"agent.latent-dim {config.latent_dim} leaves {share} for each of {len(senses)} "
            f"modalities ({', '.join(senses)}): use at least {LEAST_SHARE * len(senses)}"
        )
    if config.squash == "simnorm" and share % SIMNORM_GROUP:
        raise MerlError(
            f"agent.squash simnorm needs a multiple of {SIMNORM_GROUP} per modality, not {share}: "
            f"use agent.latent-dim {SIMNORM_GROUP * len(senses)} or a multiple"
        )
    return share


def _returns(config: AgentConfig) -> Returns:
    """Return the representation of the return by the critic's output."""
    if config.critic_loss == "mse":
        return Scalar()
    high = DEFAULT_HIGH if config.critic_high is None else config.critic_high
    return HLGauss(config.critic_low, high, config.critic_bins)


def _fusion(config: AgentConfig, features: Mapping[str, int], share: int) -> Fusion | Concatenation:
    """Build a fusion with `share` numbers per modality; 0: a concatenation."""
    if share == 0:
        return Concatenation(features)
    return Fusion(features, share, config.fusion_norm, config.squash)


def _image_encoder(
    config: AgentConfig, key: str, space: spaces.Space[Any], stack: int
) -> ConvEncoder:
    assert isinstance(space, spaces.Box)
    height, width, channels = space.shape
    if config.shift_pad >= min(height, width):
        raise MerlError(
            f"agent.shift-pad {config.shift_pad} is too large for an image of {height}x{width} "
            f"pixels: use at most {min(height, width) - 1}"
        )
    try:
        return ConvEncoder(
            stack * channels,
            (height, width),
            config.conv_channels,
            config.conv_strides,
            (int(space.low.min()), int(space.high.max())),
        )
    except MerlError as error:
        raise MerlError(f"observation {key!r}: {error}") from None


def _vector_encoder(config: AgentConfig, space: spaces.Space[Any]) -> VectorEncoder:
    assert space.shape is not None
    return VectorEncoder(space.shape[0], config.vector_encoder_dim, config.standardize)


def _keys(
    kind: str, chosen: tuple[str, ...] | None, given: list[str], default: list[str] | None = None
) -> tuple[str, ...]:
    if chosen is None:
        return tuple(given if default is None else default)
    for key in chosen:
        if chosen.count(key) > 1:
            raise MerlError(f"agent.{kind} names {key!r} twice: name it once")
        if key not in given:
            there = f"gives {given}" if given else f"gives no {kind.split('-')[-1]}"
            raise MerlError(
                f"agent.{kind} names {key!r}, but the environment {there}: name an existing key "
                f"with --agent.{kind}, or add {key!r} to the observation"
            )
    return chosen
