"""The learner: DDPG with n-step returns and clipped double Q (MERL 4.2, Algorithm 1; DrQ-v2).

What is learnt from is a batch of (o_t, a_t, r_{t:t+n-1}, o_{t+n}); what an agent makes of its
observations is the business of the networks that it declares. The methods below read beside
Algorithm 1: `update_critic`, `update_actor`, `update_target`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from merl.core import Batch, MerlError, check_choice
from merl.networks.augmentation import draw_shifts
from merl.networks.fusion import Fusion
from merl.networks.heads import Actor, TwinCritic
from merl.networks.representation import Encoders

Precision = Literal["auto", "fp32", "bf16"]
Target = Literal["heads", "heads_and_fusion"]


@dataclass(frozen=True)
class DDPGConfig:
    """How the learner learns; the values are Table 1's."""

    learning_rate: float = 1e-4
    """Adam's step size, for every network."""
    tau: float = 0.01
    """How far the target network moves towards the critic at each update, in (0, 1]."""
    noise_std: float = 0.2
    """Standard deviation of the exploration noise, also used in both updates."""
    noise_clip: float = 0.3
    """Bound of the noise in both updates; when acting it is not clipped."""
    target: Target = "heads"
    """What has an averaged copy: the Q-heads (MERL), or the critic's fusion too, as DrQ-v2's target
    covers its trunk."""
    precision: Precision = "auto"
    """Arithmetic of the update: fp32, bf16 (weights, norms, targets and losses stay fp32), or auto,
    which times both once."""

    def __post_init__(self) -> None:
        if not 0 < self.learning_rate < math.inf:
            raise MerlError(f"agent.learning-rate must be above 0, not {self.learning_rate}")
        check_choice("agent.precision", self.precision, get_args(Precision))
        check_choice("agent.target", self.target, get_args(Target))
        if not 0 < self.tau <= 1:
            raise MerlError(f"agent.tau must lie in (0, 1], not {self.tau}")
        if not 0 <= self.noise_std < math.inf:
            raise MerlError(f"agent.noise-std must be at least 0, not {self.noise_std}")
        if not self.noise_clip >= 0:
            raise MerlError(f"agent.noise-clip must be at least 0, not {self.noise_clip}")


class Networks(nn.Module):
    """The parametric networks of Algorithm 1, without the targets.

    Attributes:
        encoders: f_xi and g_zeta, learnt by the critic's loss.
        critic_fusion: h_psi of the critic.
        critic: Q_phi1 and Q_phi2.
        actor_fusion: h_psi of the actor.
        actor: pi_theta.
    """

    def __init__(
        self,
        encoders: Encoders,
        critic_fusion: Fusion,
        critic: TwinCritic,
        actor_fusion: Fusion,
        actor: Actor,
    ) -> None:
        super().__init__()
        self.encoders = encoders
        self.critic_fusion = critic_fusion
        self.critic = critic
        self.actor_fusion = actor_fusion
        self.actor = actor


@dataclass(frozen=True)
class Draws:
    """The random numbers of one update.

    Attributes:
        shifts: crops of o_t, per image key int64 (B, 2).
        next_shifts: crops of o_{t+n}, likewise.
        next_noise: epsilon of the target's action, clipped, (B, A).
        actor_noise: epsilon of the actor's action, clipped, (B, A).
    """

    shifts: dict[str, Tensor]
    next_shifts: dict[str, Tensor]
    next_noise: Tensor
    actor_noise: Tensor


class DDPG:
    """The off-policy actor-critic of the paper.

    Args:
        networks: freshly initialised; moved to `device`.
        config: how to learn; `precision` "auto" counts as fp32 here.
        seed: of the noise and the shifts.
        device: where everything lives.
    """

    def __init__(
        self, networks: Networks, config: DDPGConfig, *, seed: int, device: torch.device
    ) -> None:
        self.config = config
        self.device = device
        self.networks = networks.to(device)
        # The target fuses with the most recent weights unless its config averages them too.
        self.critic_target = nn.ModuleDict(copy.deepcopy(self._averaged())).requires_grad_(False)
        self.critic_parameters = [
            *networks.encoders.parameters(),
            *networks.critic_fusion.parameters(),
            *networks.critic.parameters(),
        ]
        self.actor_parameters = [*networks.actor_fusion.parameters(), *networks.actor.parameters()]
        self.critic_optimizer = self._adam(self.critic_parameters)
        self.actor_optimizer = self._adam(self.actor_parameters)
        words = np.random.SeedSequence(seed).generate_state(2)
        self.acting, self.learning = (
            torch.Generator(device).manual_seed(int(word)) for word in words
        )

    # Acting ---------------------------------------------------------------------------------

    @torch.inference_mode()
    def act(self, observation: Mapping[str, Tensor], *, explore: bool) -> Tensor:
        """a_t = pi(h_actor(f(o_image), g(o_prop))) + epsilon, epsilon ~ N(0, sigma^2) not clipped.

        Args:
            observation: images uint8 (B, K, H, W, C), vectors float32 (B, n), on the device.
            explore: add the noise.

        Returns:
            Actions (B, A), in [-1, 1].
        """
        networks = self.networks
        mean: Tensor = networks.actor(networks.actor_fusion(networks.encoders(observation)))
        if not explore:
            return mean
        noise = torch.randn(mean.shape, generator=self.acting, device=self.device)
        return (mean + self.config.noise_std * noise).clamp(-1.0, 1.0)

    # Learning -------------------------------------------------------------------------------

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step on critic, encoders and actor, and one step of the target."""
        return self.learn(batch.to(self.device), self.draw(batch))

    def learn(self, batch: Batch, draws: Draws) -> dict[str, Tensor]:
        """`update` with its random numbers given: augment and encode, critic, actor, target."""
        encoders = self.networks.encoders
        encoders.observe(batch.observation)
        with self._arithmetic():
            encoded = encoders(batch.observation, draws.shifts)
            with torch.no_grad():
                next_encoded = encoders(batch.next_observation, draws.next_shifts)
        metrics = self.update_critic(encoded, next_encoded, batch, draws.next_noise)
        # The encoders' features of o_t serve again, from before the critic's step and detached.
        encoded = {key: features.detach() for key, features in encoded.items()}
        metrics |= self.update_actor(encoded, draws.actor_noise)
        self.update_target()
        return metrics

    def update_critic(
        self,
        encoded: Mapping[str, Tensor],
        next_encoded: Mapping[str, Tensor],
        batch: Batch,
        next_noise: Tensor,
    ) -> dict[str, Tensor]:
        """Eq. 1: both Q-functions towards y; encoders and the critic's fusion learn with them."""
        networks = self.networks
        with self._arithmetic():
            with torch.no_grad():
                next_action = networks.actor(networks.actor_fusion(next_encoded)) + next_noise
                next_latent = self._target_part("critic_fusion")(next_encoded)
                q1, q2 = self._target_part("critic")(next_latent, next_action.clamp(-1.0, 1.0))
                y = batch.reward + batch.discount * torch.minimum(q1, q2)  # (B,)
            latent = networks.critic_fusion(encoded)  # (B, d)
            q1, q2 = networks.critic(latent, batch.action)
        loss = (q1 - y).square().mean() + (q2 - y).square().mean()
        _step(self.critic_optimizer, loss, self.critic_parameters)
        return {
            "critic_loss": loss.detach(),
            "q": q1.detach().mean(),
            "q_gap": (q1 - q2).detach().abs().mean(),
            "target_q": y.mean(),
            "reward": batch.reward.mean(),
        }

    def update_actor(self, encoded: Mapping[str, Tensor], noise: Tensor) -> dict[str, Tensor]:
        """Eq. 2: the actor and its fusion towards actions of higher value; nothing else moves."""
        networks = self.networks
        with self._arithmetic():
            with torch.no_grad():
                critic_latent = networks.critic_fusion(encoded)
            mean = networks.actor(networks.actor_fusion(encoded))  # (B, A)
            q1, q2 = networks.critic(critic_latent, _clamp_straight_through(mean + noise))
        loss = -torch.minimum(q1, q2).mean()
        _step(self.actor_optimizer, loss, self.actor_parameters)
        return {
            "actor_loss": loss.detach(),
            "action_saturation": (mean.detach().abs() > 0.95).float().mean(),
        }

    @torch.no_grad()
    def update_target(self) -> None:
        """phi_bar <- (1 - tau) phi_bar + tau phi."""
        average: list[Tensor] = list(self.critic_target.parameters())
        recent: list[Tensor] = [p for part in self._averaged().values() for p in part.parameters()]
        torch._foreach_lerp_(average, recent, self.config.tau)

    def draw(self, batch: Batch) -> Draws:
        """The random numbers of the next update."""
        generator = self.learning
        size, pad = len(batch.action), self.networks.encoders.pad
        keys = self.networks.encoders.image_keys if pad else ()
        shifts, next_shifts = (
            {key: draw_shifts(size, pad, generator) for key in keys} for _ in range(2)
        )
        clip = self.config.noise_clip
        noise, next_noise = (
            torch.randn(batch.action.shape, generator=generator, device=self.device)
            .mul_(self.config.noise_std)
            .clamp_(-clip, clip)
            for _ in range(2)
        )
        return Draws(shifts, next_shifts, next_noise, noise)

    # Saving ---------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update and the next action depend on."""
        return {
            "networks": self.networks.state_dict(),
            "critic_target": self.critic_target.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "acting": self.acting.get_state(),
            "learning": self.learning.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take back what `state_dict` gave."""
        self.networks.load_state_dict(state["networks"])
        self.critic_target.load_state_dict(state["critic_target"])
        _load(self.critic_optimizer, state["critic_optimizer"])
        _load(self.actor_optimizer, state["actor_optimizer"])
        for name in ("acting", "learning"):
            generator: torch.Generator = getattr(self, name)
            # A CPU's generator and CUDA's have states of other kinds: on another device than the
            # one that was saved on, the noise starts anew.
            if state[name].shape == generator.get_state().shape:
                generator.set_state(state[name].cpu())

    # ----------------------------------------------------------------------------------------

    def _target_part(self, name: str) -> nn.Module:
        """The averaged copy of a network, or the network itself where none is kept."""
        kept = name in self.critic_target
        part: nn.Module = self.critic_target[name] if kept else getattr(self.networks, name)
        return part

    def _averaged(self) -> dict[str, nn.Module]:
        """What the target network is an average of."""
        parts: dict[str, nn.Module] = {"critic": self.networks.critic}
        if self.config.target == "heads_and_fusion":
            parts["critic_fusion"] = self.networks.critic_fusion
        return parts

    def _arithmetic(self) -> AbstractContextManager[Any]:
        """Autocast to bf16 where that was chosen."""
        enabled = self.config.precision == "bf16"
        return torch.autocast(self.device.type, torch.bfloat16, enabled=enabled)

    def _adam(self, parameters: list[nn.Parameter]) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=self.config.learning_rate, fused=True)


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter]) -> None:
    """One step of gradient descent on these parameters; other gradients stay as they are."""
    optimizer.zero_grad()
    torch.autograd.backward(loss, inputs=parameters)
    optimizer.step()


def _load(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Take back Adam's moments, as copies in the memory order of the weights.

    The fused step walks raw memory: moments in another order would meet the wrong weights.
    """
    optimizer.load_state_dict(dict(saved))
    for parameter, moments in optimizer.state.items():
        for name in ("exp_avg", "exp_avg_sq"):
            moments[name] = torch.empty_like(parameter).copy_(moments[name])
        moments["step"] = moments["step"].clone()


def _clamp_straight_through(action: Tensor) -> Tensor:
    """The action in [-1, 1], with the gradient as if it had not been clamped."""
    return action + (action.clamp(-1.0, 1.0) - action).detach()
