"""Networks of an agent, built from its config for an environment's observations."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.agents.config import AgentConfig, ObservationConfig
from merl.core import MerlError
from merl.modalities import Modality, ObservationSpec, modalities_of
from merl.networks.critic import Critic
from merl.networks.encoders import EncoderOptions, make_encoder
from merl.networks.encoders.pretrained import TimmEncoder
from merl.networks.fusion import GROUPS, Concatenation, Fusion
from merl.networks.heads import Actor, GaussianActor, HeadSize
from merl.networks.initialization import orthogonal
from merl.networks.names import module_name
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
        critic: Q_phi1 and Q_phi2, or an ensemble.
        actor_fusion: h_psi of the actor; None if the actor uses the critic's.
        actor: pi_theta.
        policy_average: moving average of the actor and its fusion, which acts in evaluation and
            deployment; None if the newest weights act.
        imitator: copy of the policy that a run starts with; None if the agent has none.
    """

    def __init__(
        self,
        encoders: Encoders,
        critic_fusion: Fusion | Concatenation,
        critic: Critic,
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
        self.imitator: nn.ModuleDict | None = None

    @property
    def senses(self) -> tuple[str, ...]:
        """Observation keys that the actor uses."""
        return self.fusion_of_actor().keys

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Return the actions (B, A) without noise, in [-1, 1]: the policy that is deployed.

        Args:
            observation: the keys of `senses`, as in `Batch`; others are ignored.
        """
        action: Tensor = self.actor.best(self.policy(observation, averaged=True))
        return action

    def policy(self, observation: Mapping[str, Tensor], *, averaged: bool = False) -> Any:
        """Compute the actor's output.

        Args:
            observation: as in `forward`.
            averaged: use the averaged weights, if there are any.
        """
        encoded = self.encoders({key: observation[key] for key in self.senses})
        if averaged and self.policy_average is not None:
            return self.policy_average["actor"](self.policy_average["fusion"](encoded))
        return self.actor(self.actor_latent(encoded))

    def actor_latent(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Fuse the encodings for the actor."""
        latent: Tensor = self.fusion_of_actor()(encoded)
        return latent

    def start_average(self) -> None:
        """Start the moving average of the actor and its fusion, as a copy of them."""
        self.policy_average = self._copy_of_actor()

    def start_imitator(self) -> None:
        """Keep a copy of the actor and its fusion as they are now."""
        self.imitator = self._copy_of_actor()

    def imitated(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Return the actions (B, A) of that copy."""
        assert self.imitator is not None
        action: Tensor = self.imitator["actor"](self.imitator["fusion"](encoded))
        return action

    @torch.no_grad()
    def update_average(self, tau: float) -> None:
        """Update the moving average with weight `tau` for the newest weights."""
        assert self.policy_average is not None
        average: list[Tensor] = list(self.policy_average.parameters())
        recent: list[Tensor] = [*self.fusion_of_actor().parameters(), *self.actor.parameters()]
        torch._foreach_lerp_(average, recent, tau)

    def take_policy(self, other: Networks) -> None:
        """Copy the policy of other networks: encoders, the actor's fusion and the actor.

        If they have a moving average, that is the policy, as in deployment.

        Raises:
            RuntimeError: the parts have other keys or sizes.
        """
        average = other.policy_average
        fusion = other.fusion_of_actor() if average is None else average["fusion"]
        actor = other.actor if average is None else average["actor"]
        self.encoders.load_state_dict(other.encoders.state_dict())
        self.fusion_of_actor().load_state_dict(fusion.state_dict())
        self.actor.load_state_dict(actor.state_dict())
        if self.policy_average is not None:
            self.start_average()
        if self.imitator is not None:
            self.start_imitator()

    def fusion_of_actor(self) -> Fusion | Concatenation:
        """Return the fusion that the actor uses: its own, or the critic's."""
        return self.critic_fusion if self.actor_fusion is None else self.actor_fusion

    def _copy_of_actor(self) -> nn.ModuleDict:
        parts = nn.ModuleDict({"fusion": self.fusion_of_actor(), "actor": self.actor})
        return copy.deepcopy(parts).requires_grad_(False)


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
    spec = observation_spec(config, space, stack)
    for name in ("encoders", "encoder_weights", "frozen_encoders"):
        _named(name.replace("_", "-"), tuple(getattr(config, name)), spec.modalities)
    options = EncoderOptions(config.conv_channels, config.conv_strides, config.mlp_dim)
    encoders = Encoders(
        {key: _encoder(config, key, m, stack, options) for key, m in spec.modalities.items()},
        spec.modalities,
        config.shift_pad,
        config.standardize,
    )
    senses = {key: encoders.features[key] for key in spec.senses}
    share = _share(config, spec.senses)
    critic_fusion = _fusion(config, encoders.features, share)
    actor_fusion = None
    if config.fusion == "decoupled":
        actor_fusion = _fusion(config, senses, share)
    size = HeadSize(config.head_layers, config.hidden_dim, "layer" if config.head_norm else "none")
    critic = Critic(critic_fusion.latent_dim, action_dim, size, _returns(config), config.critics)
    policy = actor((actor_fusion or critic_fusion).latent_dim, action_dim, size)
    networks = Networks(encoders, critic_fusion, critic, actor_fusion, policy)
    orthogonal(networks)
    for head in critic.heads:
        critic.returns.start_at_zero(head.output.bias)
    if config.actor_average is not None:
        networks.start_average()
    return networks


def observation_spec(config: ObservationConfig, space: spaces.Dict, stack: int) -> ObservationSpec:
    """Return what the agent observes, checked against the space.

    Args:
        config: config of the agent.
        space: observation space of the environment.
        stack: number of frames in a stack.

    Raises:
        MerlError: a named key is missing, or the actor has no key; the message gives the way out.
    """
    given = modalities_of(space)
    privileged = _named("privileged", config.privileged, given)
    keys = config.keys
    if keys is None:
        keys = tuple(
            key for key, m in given.items() if m.kind in config.modalities and key not in privileged
        )
    for key in _named("keys", keys, given):
        if key in privileged:
            raise MerlError(
                f"agent.privileged names {key!r}, which the actor uses too: remove it from "
                "--agent.privileged or from --agent.keys"
            )
    if not keys:
        raise MerlError(_nothing_to_use(config, space, given))
    used = {key: m for key, m in given.items() if key in keys}
    used |= {key: given[key] for key in privileged}
    return ObservationSpec(used, privileged, stack)


def _nothing_to_use(
    config: ObservationConfig, space: spaces.Dict, given: Mapping[str, Modality]
) -> str:
    """Return an error message for an actor without keys."""
    what = f"the agent can use no observation among {sorted(space)}"
    if config.keys == ():
        return f"{what}: name some with --agent.keys"
    others = [key for key in given if key not in config.privileged]
    if "state" in others:
        return f"{what}: add --agent.keys state, or use --agent merl_state, ddpg or sac"
    if others:
        kinds = sorted({given[key].kind for key in others})
        return f"{what}: add --agent.modalities {' '.join(kinds)}"
    if given:
        return f"{what}: --agent.privileged leaves no key for the actor"
    return f"{what}: docs/howto/environment.md lists the boxes that agents can use"


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
    group = GROUPS[config.fusion_layer]
    if share % group:
        raise MerlError(
            f"agent.fusion-layer {config.fusion_layer} needs a multiple of {group} per modality, "
            f"not {share}: use agent.latent-dim {group * len(senses)} or a multiple"
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
    return Fusion(features, share, config.fusion_norm, config.fusion_layer)


def _encoder(
    config: AgentConfig, key: str, modality: Modality, stack: int, options: EncoderOptions
) -> nn.Module:
    """Build the encoder of a key; weights from a file are loaded by `load_encoder_weights`."""
    if modality.stacked and config.shift_pad >= min(modality.shape[:2]):
        height, width = modality.shape[:2]
        raise MerlError(
            f"agent.shift-pad {config.shift_pad} is too large for an image of {height}x{width} "
            f"pixels: use at most {min(height, width) - 1}"
        )
    try:
        return make_encoder(
            config.encoders.get(key, modality.encoder), modality, stack, options
        ).requires_grad_(key not in config.frozen_encoders)
    except MerlError as error:
        raise MerlError(f"observation {key!r}: {error}") from None


def user_encoders(config: ObservationConfig) -> tuple[str, ...]:
    """Return the encoders that a config names as `module:Class`."""
    if not isinstance(config, AgentConfig):
        return ()
    return tuple(name for name in config.encoders.values() if ":" in name)


def load_encoder_weights(networks: Networks, config: AgentConfig, home: Path) -> None:
    """Load the weights that the config names into the encoders of a new agent.

    Args:
        networks: networks of the agent.
        config: config of the agent.
        home: the folder to which the names of the files are relative.

    Raises:
        MerlError: a file cannot be read, or the encoder is not a model of timm.
    """
    for key, file in config.encoder_weights.items():
        encoder = networks.encoders.by_key[module_name(key)]
        if not isinstance(encoder, TimmEncoder):
            raise MerlError(
                f"agent.encoder-weights names {key!r}, whose encoder is not a model of timm: name "
                f"one with --agent.encoders.{key}, e.g. resnet18"
            )
        encoder.load(home / file)


def _named(field: str, keys: tuple[str, ...], given: Mapping[str, Modality]) -> tuple[str, ...]:
    """Return the keys that a field names, checked.

    Raises:
        MerlError: a key is named twice or does not exist.
    """
    for key in keys:
        if keys.count(key) > 1:
            raise MerlError(f"agent.{field} names {key!r} twice: name it once")
        if key not in given:
            raise MerlError(
                f"agent.{field} names {key!r}, but the observation has {sorted(given)}: name an "
                f"existing key, or add {key!r} to the observation"
            )
    return keys
