"""Behaviour cloning: MERL's networks, trained to repeat the actions of demonstrations.

It is the baseline of learning from demonstrations: no reward, no critic, no experience of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from merl.agents.cloning import cloning_loss
from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.optimizers import adam, set_step_size, step_optimizer
from merl.core import Batch, UpdateNoise, UpdatePlan
from merl.networks.settings import with_torch_settings


@dataclass(frozen=True)
class BCConfig(AgentConfig):
    """Behaviour cloning with MERL's networks."""


class BC(DDPG):
    """Actor that is trained on demonstrations alone; the arguments are those of `DDPG`.

    Unlike in `DDPG`, the actor's loss trains the encoders. The critic is not trained.
    """

    def __init__(self, config: BCConfig, *spaces: Any, **options: Any) -> None:
        super().__init__(config, *spaces, **options)
        networks = self.networks
        self.actor_parameters = [
            *(p for p in networks.encoders.parameters() if p.requires_grad),
            *networks.fusion_of_actor().parameters(),  # also one shared with the critic
            *networks.actor.parameters(),
        ]
        self.actor_optimizer = adam(self.actor_parameters, config.learning_rate)

    @with_torch_settings
    def learn(self, batch: Batch, noise: UpdateNoise, plan: UpdatePlan) -> dict[str, Tensor]:
        """Augment and encode the demonstrations, and clone their actions."""
        set_step_size(self.actor_optimizer, plan.step_size)
        networks = self.networks
        networks.encoders.observe(batch.observation)
        with self._arithmetic():
            encoded = networks.encoders(batch.observation, noise.shifts)
            mean = networks.actor(networks.actor_latent(encoded))
        loss = cloning_loss(mean, batch)
        step_optimizer(self.actor_optimizer, loss, self.actor_parameters)
        if self.config.actor_average is not None:
            networks.update_average(self.config.actor_average)
        return {"actor_loss": loss.detach()}
