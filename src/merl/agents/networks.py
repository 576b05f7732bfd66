"""An agent's networks: what its config declares, built for the senses that an environment gives."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.agents.config import AgentConfig
from merl.core import MerlError, is_image, is_vector
from merl.networks.critic import TwinCritic
from merl.networks.encoders import ConvEncoder, VectorEncoder
from merl.networks.fusion import SIMNORM_GROUP, Concatenation, Fusion
from merl.networks.heads import Actor, GaussianActor, HeadSize
from merl.networks.initialization import orthogonal
from merl.networks.representation import Encoders
from merl.networks.returns import HLGauss, Returns, Scalar

DEFAULT_HIGH = 100.0
"""The highest return of rewards in [0, 1] with a discount of 0.99."""
LEAST_SHARE = 2
"""Numbers of the fused representation that a modality must have."""


class Networks(nn.Module):
    """The parametric networks of Algorithm 1, without the targets.

    Attributes:
        encoders: f_xi and g_zeta, learnt by the critic's loss.
        critic_fusion: h_psi of the critic.
        critic: Q_phi1 and Q_phi2.
        actor_fusion: h_psi of the actor; None where it uses the critic's.
        actor: pi_theta.
        policy_average: an average of the actor and its fusion, which acts in evaluation and
            deployment; None where the newest weights do.
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
        """The keys that the actor acts on."""
        return self._fusion_of_actor().modalities

    def actor_latent(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """What the actor sees: the encodings, fused."""
        latent: Tensor = self._fusion_of_actor()(encoded)
        return latent

    def policy(self, encoded: Mapping[str, Tensor], *, averaged: bool = False) -> Any:
        """What the actor makes of the encodings.

        Args:
            encoded: {key: (B, F_key)}.
            averaged: use the average of its weights, where one is kept.
        """
        if averaged and self.policy_average is not None:
            return self.policy_average["actor"](self.policy_average["fusion"](encoded))
        return self.actor(self.actor_latent(encoded))

    def start_average(self) -> None:
        """Keep an average of the actor and its fusion from now on, equal to them so far."""
        recent = nn.ModuleDict({"fusion": self._fusion_of_actor(), "actor": self.actor})
        self.policy_average = copy.deepcopy(recent).requires_grad_(False)

    @torch.no_grad()
    def update_average(self, tau: float) -> None:
        """Move the average towards the newest weights by the share `tau`."""
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
    """Build and initialise an agent's networks (from torch's global seed).

    Args:
        config: what they are made of.
        space: what the environment gives.
        action_dim: A.
        stack: frames of an image that are seen at once.
        actor: the kind of policy.

    Raises:
        MerlError: the space lacks what the agent consumes, or the config does not fit it.
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


def modalities(config: AgentConfig, space: spaces.Dict) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The image keys and the vector keys that the agent acts on, checked against the space.

    Raises:
        MerlError: naming the key that is missing, and how to get it.
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
            hint = f"it needs an image, a uint8 box (H, W, C), or take --agent {others}"
        elif given:
            hint = "--agent.privileged leaves the actor nothing"
        elif config.images == ():
            hint = "it needs a vector, a box of n numbers, or take --agent drqv2"
        else:
            hint = "an image is a uint8 box (H, W, C), a vector a float box (n,)"
        raise MerlError(f"the agent finds nothing to sense among {sorted(space)}: {hint}")
    return images, vectors


def privileged_keys(config: AgentConfig, space: spaces.Dict) -> tuple[str, ...]:
    """The vector keys that the critic has beyond the actor's.

    Raises:
        MerlError: a key is missing, is the actor's too, or the fusion is shared.
    """
    given = [k for k, s in space.items() if is_vector(s)]
    keys = _keys("privileged", config.privileged, given)
    _, vectors = modalities(config, space)
    for key in keys:
        if key in vectors:
            raise MerlError(f"agent.privileged names {key!r}, which the actor has already")
    if keys and config.fusion != "decoupled":
        raise MerlError(
            f"agent.privileged {keys} needs a fusion of the critic's own: use --agent.fusion "
            f"decoupled in place of {config.fusion}"
        )
    return keys


def _share(config: AgentConfig, senses: tuple[str, ...]) -> int:
    """What each modality has of d, rounded down; with an informed critic, what the actor's have.

    Raises:
        MerlError: d is too small for so many, or for the groups of `simnorm`.
    """
    share = config.latent_dim // len(senses)
    # Of a single number LayerNorm leaves nothing.
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
    """The form of the critic's output."""
    if config.critic_loss == "mse":
        return Scalar()
    high = DEFAULT_HIGH if config.critic_high is None else config.critic_high
    return HLGauss(config.critic_low, high, config.critic_bins)


def _fusion(config: AgentConfig, features: Mapping[str, int], share: int) -> Fusion | Concatenation:
    """For these modalities, so many numbers each."""
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
            f"agent.shift-pad {config.shift_pad} moves a picture of {height}x{width} pixels out of "
            f"sight: give at most {min(height, width) - 1}"
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
            raise MerlError(f"agent.{kind} names {key!r} twice: once is enough")
        if key not in given:
            there = f"gives {given}" if given else f"gives no {kind.split('-')[-1]}"
            raise MerlError(
                f"agent.{kind} names {key!r}, but the environment {there}: name what there is with "
                f"--agent.{kind}, or have it give {key!r}"
            )
    return chosen
