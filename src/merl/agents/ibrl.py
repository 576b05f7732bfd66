"""IBRL: the better of the actor's action and a cloned policy's (Hu et al. 2024, arXiv:2311.02198).

It differs from the learner in this: a copy of the policy that the run starts with stays as it is
and proposes an action too. Acting takes the proposal to which the critic gives the higher value,
and so does the critic's target, which then is the value of this better action. Both policies use
the same encoders, which are therefore not trained; the paper trains an encoder for each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.core import MerlError, UpdateNoise
from merl.networks.settings import with_torch_settings


@dataclass(frozen=True)
class IBRLConfig(MERLConfig):
    """MERL whose critic chooses between the actor's action and a cloned policy's."""


class IBRL(DDPG):
    """DDPG with a cloned policy beside the actor; the arguments are those of `DDPG`.

    Raises:
        MerlError: the run starts with no policy, an encoder is trained, or the critic has
            privileged keys, which are unknown when a deployed policy acts.
    """

    def __init__(self, config: IBRLConfig, *spaces: Any, **options: Any) -> None:
        super().__init__(config, *spaces, **options)
        trained = any(weight.requires_grad for weight in self.networks.encoders.parameters())
        if trained or config.start_from is None:
            raise MerlError(
                "agent ibrl needs a cloned policy and its encoders as they are: clone with --demos "
                "DIR --demos-pretrain UPDATES, or name a run and all keys with encoders with "
                "--agent.start-from and --agent.frozen-encoders"
            )
        if config.privileged:
            raise MerlError(
                f"agent ibrl chooses actions by its critic, which must not need "
                f"agent.privileged {config.privileged}: remove it"
            )
        self.networks.start_imitator()

    @with_torch_settings
    @torch.inference_mode()
    def act(self, observation: Mapping[str, Tensor], *, explore: bool, step: int) -> Tensor:
        """Return the better of `DDPG.act` and the cloned policy's action, (B, A) in [-1, 1]."""
        own = super().act(observation, explore=explore, step=step)
        networks = self.networks
        encoded = networks.encoders({key: observation[key] for key in self.senses})
        cloned, latent = networks.imitated(encoded), networks.critic_fusion(encoded)
        of_own, of_cloned = (networks.critic.rating(latent, action) for action in (own, cloned))
        return better(own, cloned, of_own, of_cloned)

    def next_action(
        self, next_encoded: Mapping[str, Tensor], noise: UpdateNoise
    ) -> tuple[Tensor, Tensor | float]:
        """Return the better of `DDPG.next_action` and the cloned policy's action, (B, A), and 0."""
        own, bonus = super().next_action(next_encoded, noise)
        cloned = self.networks.imitated(next_encoded)
        of_own, of_cloned = (
            self.target_q(next_encoded, action, noise.pair) for action in (own, cloned)
        )
        return better(own, cloned, of_own, of_cloned), bonus


def better(own: Tensor, cloned: Tensor, of_own: Tensor, of_cloned: Tensor) -> Tensor:
    """Return, for each row, the action (B, A) of the higher value (B,); the own one if equal."""
    return torch.where((of_cloned > of_own).unsqueeze(-1), cloned, own)
