"""The learner: DDPG with n-step returns and clipped double Q (MERL 4.2, Algorithm 1; DrQ-v2).

An update learns from a batch of (o_t, a_t, r_{t:t+n-1}, o_{t+n}); the agent's networks represent
the observations. The methods `update_critic`, `update_actor` and `update_target` follow
Algorithm 1.

Agent `ddpg` is this learner on the state, without changes (docs/explanation/agents/ddpg.md).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.agents.cloning import better_loss, cloning_loss
from merl.agents.config import AgentConfig
from merl.agents.gradients import clamp_straight_through, frozen
from merl.agents.networks import make_networks
from merl.agents.optimizers import adam, load_optimizer, set_step_size, step_optimizer
from merl.core import Batch, FrameTransforms, UpdateNoise, UpdatePlan
from merl.networks.augmentation import RandomShift, draw_shifts
from merl.networks.critic import Critic
from merl.networks.heads import Actor, GaussianActor
from merl.networks.settings import with_torch_settings


@dataclass(frozen=True)
class DDPGConfig(AgentConfig):
    """DDPG on the state, with clipped double Q (Fujimoto et al. 2018) and 3-step returns."""

    keys: tuple[str, ...] | None = ("state",)
    """Observation keys to use."""
    latent_dim: int = 0
    """d, the length of the fused representation; 0: no fusion, the heads receive the state."""
    head_norm: bool = False
    """LayerNorm in the hidden layers of actor and critic."""


class DDPG:
    """Off-policy actor-critic of the paper.

    The arguments are those of `merl.agents.make_agent`, which also seeds the initial weights. In
    the config, `precision` "auto" means fp32 here.
    """

    actor_class: ClassVar[type[Actor] | type[GaussianActor]] = Actor

    def __init__(
        self,
        config: AgentConfig,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        *,
        frame_stack: int,
        seed: int,
        device: torch.device,
        threads: int | None = None,
    ) -> None:
        self.acting_noise: Tensor | None = None
        self.config = config
        self.device, self.threads = device, threads
        self.networks = networks = make_networks(
            config, observation_space, action_space.shape[0], frame_stack, self.actor_class
        ).to(device)
        # The target uses the newest fusion, unless the config gives the fusion a target too.
        self.critic_target = nn.ModuleDict(copy.deepcopy(self._averaged())).requires_grad_(False)
        parts = networks.encoders, networks.critic_fusion, networks.critic
        self.critic_parameters = [p for part in parts for p in part.parameters() if p.requires_grad]
        self.actor_parameters = [*self._actors_fusion(), *networks.actor.parameters()]
        self.critic_optimizer = adam(self.critic_parameters, config.learning_rate)
        self.actor_optimizer = adam(self.actor_parameters, config.learning_rate)
        words = np.random.SeedSequence(seed).generate_state(2)
        self.acting, self.learning = (
            torch.Generator(device).manual_seed(int(word)) for word in words
        )

    @property
    def senses(self) -> tuple[str, ...]:
        """Observation keys that the actor uses."""
        return self.networks.senses

    # Acting ---------------------------------------------------------------------------------

    @with_torch_settings
    @torch.inference_mode()
    def act(self, observation: Mapping[str, Tensor], *, explore: bool, step: int) -> Tensor:
        """Compute a_t = pi(h_actor(f(o_image), g(o_prop))) + epsilon, epsilon ~ N(0, sigma^2).

        The noise is not clipped.

        Args:
            observation: as in `Batch`, on the device.
            explore: add the noise; if False, the averaged actor acts, if there is one.
            step: environment steps so far, on which sigma may depend.

        Returns:
            Actions (B, A), in [-1, 1].
        """
        if not explore:
            return self.networks.forward(observation)
        mean: Tensor = self.networks.policy(observation)
        noise = torch.randn(mean.shape, generator=self.acting, device=self.device)
        correlation = self.config.noise_correlation
        if correlation:
            if self.acting_noise is not None:
                noise = correlation * self.acting_noise + (1 - correlation**2) ** 0.5 * noise
            self.acting_noise = noise
        return (mean + self.config.noise(step) * noise).clamp(-1.0, 1.0)

    # Learning -------------------------------------------------------------------------------

    def update(
        self, batch: Batch, noise: UpdateNoise | None = None, *, step: int
    ) -> dict[str, Tensor]:
        """Make an update; the noise is drawn if it is not given. See `Agent.update`."""
        plan = self.plan(step)
        if noise is None:
            noise = self.draw(len(batch.action), plan)
        return self.learn(batch.to(self.device), noise, plan)

    def plan(self, step: int) -> UpdatePlan:
        """Return the values of an update that depend on the step."""
        config = self.config
        return UpdatePlan(config.noise(step), config.step_size(step), config.cloning(step))

    @with_torch_settings
    def learn(self, batch: Batch, noise: UpdateNoise, plan: UpdatePlan) -> dict[str, Tensor]:
        """Augment and encode the batch; update the critic, the actor and the target."""
        for optimizer in self.optimizers():
            set_step_size(optimizer, plan.step_size)
        encoders = self.networks.encoders
        encoders.observe(batch.observation)
        with self._arithmetic():
            encoded = encoders(batch.observation, noise.shifts)
            with torch.no_grad():
                next_encoded = encoders(batch.next_observation, noise.next_shifts)
        metrics = self.update_critic(encoded, next_encoded, batch, noise)
        # Reuse the features of o_t from before the critic's step, without gradient.
        encoded = {key: features.detach() for key, features in encoded.items()}
        metrics |= self.update_actor(encoded, batch, noise.actor_noise, plan)
        if self.config.actor_average is not None:
            self.networks.update_average(self.config.actor_average)
        self.update_target()
        return metrics

    def update_critic(
        self,
        encoded: Mapping[str, Tensor],
        next_encoded: Mapping[str, Tensor],
        batch: Batch,
        noise: UpdateNoise,
    ) -> dict[str, Tensor]:
        """Move the Q-functions, the critic's fusion and the encoders towards y (Eq. 1)."""
        networks = self.networks
        # Separate blocks: autocast would reuse weights that it cast without gradient.
        with self._arithmetic(), torch.no_grad():
            next_action, bonus = self.next_action(next_encoded, noise)
            next_q = self.target_q(next_encoded, next_action, noise.pair)
        with self._arithmetic():
            latent = networks.critic_fusion(encoded)  # (B, d)
            outputs = networks.critic(latent, batch.action)
        y = batch.reward + batch.discount * (next_q + bonus)  # (B,)
        loss = networks.critic.loss(outputs, y)
        step_optimizer(self.critic_optimizer, loss, self.critic_parameters)
        q = torch.stack([networks.critic.returns.value(output.detach()) for output in outputs])
        return {
            "critic_loss": loss.detach(),
            "q": q[0].mean(),
            "q_gap": (q.amax(dim=0) - q.amin(dim=0)).mean(),
            "target_q": y.mean(),
            "reward": batch.reward.mean(),
        }

    def next_action(
        self, next_encoded: Mapping[str, Tensor], noise: UpdateNoise
    ) -> tuple[Tensor, Tensor | float]:
        """Return pi(o_{t+n}) + epsilon, (B, A), and the bonus added to its value: 0."""
        action = self.networks.actor(self.networks.actor_latent(next_encoded)) + noise.next_noise
        return action.clamp(-1.0, 1.0), 0.0

    def target_q(
        self, encoded: Mapping[str, Tensor], action: Tensor, pair: Tensor | None
    ) -> Tensor:
        """Return the smaller of two values of the target critic, (B,); see `Critic.smaller`."""
        latent = self._target_part("critic_fusion")(encoded)
        critic = self._target_part("critic")
        assert isinstance(critic, Critic)
        return critic.smaller(latent, action, pair)

    def update_actor(
        self, encoded: Mapping[str, Tensor], batch: Batch, noise: Tensor, plan: UpdatePlan
    ) -> dict[str, Tensor]:
        """Move only the actor and its fusion towards actions of higher value (Eq. 2)."""
        with self._arithmetic():
            mean = self.networks.actor(self.networks.actor_latent(encoded))  # (B, A)
            q = self.q(encoded, clamp_straight_through(mean + noise))
            loss = -q.mean()
        if self.config.clone_weight:
            error = self.cloning_error(encoded, mean, batch)
            loss = loss + plan.clone_weight * q.detach().abs().mean() * error
        step_optimizer(self.actor_optimizer, loss, self.actor_parameters)
        return {
            "actor_loss": loss.detach(),
            "action_saturation": (mean.detach().abs() > 0.95).float().mean(),
        }

    def cloning_error(self, encoded: Mapping[str, Tensor], mean: Tensor, batch: Batch) -> Tensor:
        """Return the squared error of the actor's actions (B, A) that is to be cloned away."""
        if not self.config.clone_better:
            return cloning_loss(mean, batch)

        def value(action: Tensor) -> Tensor:
            with torch.no_grad(), self._arithmetic():
                return self.q(encoded, action)

        return better_loss(mean, batch, value)

    def q(self, encoded: Mapping[str, Tensor], action: Tensor) -> Tensor:
        """Return `Critic.rating`, min_k Q_phi_k(o_t, a), (B,), differentiable in a alone."""
        with torch.no_grad():
            latent = self.networks.critic_fusion(encoded)
        with frozen(self.networks.critic):
            return self.networks.critic.rating(latent, action)

    @torch.no_grad()
    def update_target(self) -> None:
        """Update the target: phi_bar <- (1 - tau) phi_bar + tau phi."""
        average: list[Tensor] = list(self.critic_target.parameters())
        recent: list[Tensor] = [p for part in self._averaged().values() for p in part.parameters()]
        torch._foreach_lerp_(average, recent, self.config.tau)

    @with_torch_settings
    def draw(self, size: int, plan: UpdatePlan) -> UpdateNoise:
        """Draw the random numbers of an update with a batch of `size` samples."""
        generator = self.learning
        pad, shape = self.networks.encoders.pad, (size, self.networks.actor.action_dim)
        keys = self.networks.encoders.shifted
        shifts, next_shifts = (
            {key: draw_shifts(size, pad, generator) for key in keys} for _ in range(2)
        )
        noise, next_noise = (
            self.epsilon(torch.randn(shape, generator=generator, device=self.device), plan)
            for _ in range(2)
        )
        pair = self.networks.critic.draw_pair(generator)
        return UpdateNoise(shifts, next_shifts, next_noise, noise, pair)

    def frame_transforms(self, noise: UpdateNoise) -> tuple[FrameTransforms, FrameTransforms]:
        """Return the shifts of o_t and o_{t+n} as frame transforms, which the replay applies."""
        pad = self.networks.encoders.pad
        now, then = (
            {key: RandomShift(shifts, pad) for key, shifts in each.items()}
            for each in (noise.shifts, noise.next_shifts)
        )
        return now, then

    def epsilon(self, noise: Tensor, plan: UpdatePlan) -> Tensor:
        """Scale standard normal numbers to the noise of an update: clip(N(0, sigma^2), -c, c)."""
        clip = self.config.noise_clip
        return noise.mul_(plan.noise_std).clamp_(-clip, clip)

    def optimizers(self) -> list[torch.optim.Adam]:
        """Return the optimizers, which all have the same step size."""
        return [self.critic_optimizer, self.actor_optimizer]

    # Saving ---------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update and the next action depend on."""
        return {
            "networks": self.networks.state_dict(),
            "critic_target": self.critic_target.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "acting": self.acting.get_state(),
            "learning": self.learning.get_state(),
            "acting_noise": self.acting_noise,
        }

    @with_torch_settings
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`."""
        self.networks.load_state_dict(state["networks"])
        self.critic_target.load_state_dict(state["critic_target"])
        noise = state["acting_noise"]
        self.acting_noise = None if noise is None else noise.to(self.device)
        load_optimizer(self.critic_optimizer, state["critic_optimizer"])
        load_optimizer(self.actor_optimizer, state["actor_optimizer"])
        for name in ("acting", "learning"):
            generator: torch.Generator = getattr(self, name)
            # The generators of CPU and CUDA have different states: on another kind of device than
            # the saved one, the noise restarts from the seed.
            if state[name].shape == generator.get_state().shape:
                generator.set_state(state[name].cpu())

    @with_torch_settings
    def load_policy(self, weights: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Restore the networks from `state_dict()`."""
        self.networks.load_state_dict(weights["networks"])

    def take_policy(self, other: DDPG) -> None:
        """Start with the policy of another agent; see `Networks.take_policy`."""
        self.networks.take_policy(other.networks)
        if "critic_fusion" in self.critic_target:  # which the actor may share
            fusion = self.networks.critic_fusion.state_dict()
            self.critic_target["critic_fusion"].load_state_dict(fusion)

    # ----------------------------------------------------------------------------------------

    def _actors_fusion(self) -> Iterator[nn.Parameter]:
        """Yield the fusion weights that the actor's loss trains: its own, or the shared ones."""
        if self.networks.actor_fusion is not None:
            yield from self.networks.actor_fusion.parameters()
        elif self.config.fusion == "shared_by_both":
            yield from self.networks.critic_fusion.parameters()

    def _target_part(self, name: str) -> nn.Module:
        """Return the target copy of a network, or the network itself if it has none."""
        kept = name in self.critic_target
        part: nn.Module = self.critic_target[name] if kept else getattr(self.networks, name)
        return part

    def _averaged(self) -> dict[str, nn.Module]:
        """Return the networks that have a target copy."""
        parts: dict[str, nn.Module] = {"critic": self.networks.critic}
        if self.config.target == "heads_and_fusion":
            parts["critic_fusion"] = self.networks.critic_fusion
        return parts

    def _arithmetic(self) -> AbstractContextManager[Any]:
        """Return a context with autocast to bf16, enabled if the config chooses bf16."""
        enabled = self.config.precision == "bf16"
        return torch.autocast(self.device.type, torch.bfloat16, enabled=enabled)
