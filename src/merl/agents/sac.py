"""Soft actor-critic with a learnt temperature (Haarnoja et al. 2018b), based on the DDPG learner.

It differs from the learner in this: the policy is a Gaussian through a tanh; its entropy, times
alpha, is part of the critic's target and of the actor's loss; and alpha is trained so that the
entropy reaches a target. With n-step returns, only the last of the n steps has an entropy term.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
import tyro
from torch import Tensor
from torch.nn.functional import softplus

from merl.agents.config import Positive
from merl.agents.ddpg import DDPG, DDPGConfig
from merl.agents.optimizers import adam, load_optimizer, step_optimizer
from merl.core import Batch, MerlError, UpdateNoise, UpdatePlan
from merl.networks.heads import Actor, GaussianActor
from merl.networks.settings import with_torch_settings


@dataclass(frozen=True)
class SACConfig(DDPGConfig):
    """SAC on the state, with a learnt temperature (Haarnoja et al. 2018b)."""

    temperature: Positive = 1.0
    """Initial value of alpha."""
    target_entropy: float | None = None
    """Target of the policy's entropy, in nats; if not set, minus the dimension of the action."""
    # Unused: the policy itself is random.
    noise_std: Annotated[float, tyro.conf.Suppress] = 0.0
    noise_std_end: Annotated[float | None, tyro.conf.Suppress] = None
    noise_steps: Annotated[int, tyro.conf.Suppress] = 1
    noise_clip: Annotated[float, tyro.conf.Suppress] = 0.0
    noise_correlation: Annotated[float, tyro.conf.Suppress] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.critic_loss != "mse":
            raise MerlError(
                f"agent.critic-loss {self.critic_loss} needs bounded returns, but the entropy "
                "term makes SAC's returns unbounded: use mse"
            )


class SAC(DDPG):
    """Soft actor-critic, with a `GaussianActor`; the arguments are those of `DDPG`."""

    config: SACConfig
    actor_class: ClassVar[type[Actor] | type[GaussianActor]] = GaussianActor

    def __init__(self, config: SACConfig, *spaces: Any, **options: Any) -> None:
        super().__init__(config, *spaces, **options)
        start = math.log(config.temperature)
        self.log_alpha = torch.tensor(start, device=self.device, requires_grad=True)
        self.alpha_optimizer = adam([self.log_alpha], config.learning_rate)

    def optimizers(self) -> list[torch.optim.Adam]:
        """Return the optimizers, which all have the same step size."""
        return [*super().optimizers(), self.alpha_optimizer]

    @with_torch_settings
    @torch.inference_mode()
    def act(self, observation: Mapping[str, Tensor], *, explore: bool, step: int) -> Tensor:
        """Return tanh(u), u ~ N(mu, sigma^2), to explore, else tanh(mu); see `DDPG.act`."""
        if not explore:
            return self.networks.forward(observation)
        mean, log_std = self.networks.policy(observation)
        noise = torch.randn(mean.shape, generator=self.acting, device=self.device)
        return torch.tanh(mean + log_std.exp() * noise)

    def next_action(
        self, next_encoded: Mapping[str, Tensor], noise: UpdateNoise
    ) -> tuple[Tensor, Tensor | float]:
        """Return a ~ pi(o_{t+n}), (B, A), and -alpha log pi(a | o_{t+n}), (B,)."""
        action, log_prob, _ = self._sample(next_encoded, noise.next_noise)
        return action, -self.log_alpha.exp() * log_prob

    def update_actor(
        self, encoded: Mapping[str, Tensor], batch: Batch, noise: Tensor, plan: UpdatePlan
    ) -> dict[str, Tensor]:
        """Move the actor towards higher soft value, then alpha towards the target entropy."""
        with self._arithmetic():
            action, log_prob, mean = self._sample(encoded, noise)
            q = self.q(encoded, action)
        alpha = self.log_alpha.exp().detach()
        loss = (alpha * log_prob - q).mean()
        if self.config.clone_weight:
            error = self.cloning_error(encoded, torch.tanh(mean), batch)
            loss = loss + plan.clone_weight * q.detach().abs().mean() * error
        step_optimizer(self.actor_optimizer, loss, self.actor_parameters)
        entropy = -log_prob.detach().mean()
        target = self.config.target_entropy
        goal = -action.shape[1] if target is None else target
        alpha_loss = self.log_alpha.exp() * (entropy - goal)
        step_optimizer(self.alpha_optimizer, alpha_loss, [self.log_alpha])
        return {
            "actor_loss": loss.detach(),
            "alpha_loss": alpha_loss.detach(),
            "alpha": alpha,
            "entropy": entropy,
            "action_saturation": (torch.tanh(mean.detach()).abs() > 0.95).float().mean(),
        }

    def epsilon(self, noise: Tensor, plan: UpdatePlan) -> Tensor:
        """Return the standard normal noise unchanged: the policy scales it."""
        return noise

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update and the next action depend on."""
        return super().state_dict() | {
            "log_alpha": self.log_alpha.detach(),
            "alpha_optimizer": self.alpha_optimizer.state_dict(),
        }

    @with_torch_settings
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`."""
        super().load_state_dict(state)
        with torch.no_grad():
            self.log_alpha.copy_(state["log_alpha"])
        load_optimizer(self.alpha_optimizer, state["alpha_optimizer"])

    def _sample(
        self, encoded: Mapping[str, Tensor], noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sample an action (B, A), its log pi (B,), and mu (B, A); differentiable in the actor."""
        mean, log_std = self.networks.actor(self.networks.actor_latent(encoded))
        u = mean + log_std.exp() * noise
        gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(u)^2), in a form that stays accurate where tanh is near 1
        squashed = 2 * (math.log(2) - u - softplus(-2 * u))
        return torch.tanh(u), (gaussian - squashed).sum(-1), mean
