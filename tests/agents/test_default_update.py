"""Without optional components, weights equal bit for bit those of the update written out here.

Recorded runs are valid only as long as this holds. The update below uses only torch's operations
and layers, in the order of the first recorded runs. It is valid on every processor; a hash of the
weights would not be.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from bridge import Case, named_cases, weights_of
from torch import Tensor, nn
from torch.nn.functional import softplus

from merl.agents.ddpg import DDPG, DDPGConfig
from merl.agents.drqv2 import DrQV2Config
from merl.agents.merl import MERLConfig
from merl.agents.sac import SAC, SACConfig
from merl.core import Batch, UpdateNoise

SMALL = {"conv_channels": 8, "hidden_dim": 32}
CASES = [
    Case("merl", MERLConfig(latent_dim=48, **SMALL)),
    Case("drqv2", DrQV2Config(**SMALL), vectors={}),
    Case("ddpg", DDPGConfig(**SMALL), images={}, vectors={"state": 9}),
    Case("sac", SACConfig(hidden_dim=32), images={}, vectors={"state": 9}),
]


class WrittenOut:
    """Weights of an agent, and its update as a list of operations."""

    def __init__(self, agent: DDPG) -> None:
        self.config = agent.config
        self.networks, self.target = copy.deepcopy((agent.networks, agent.critic_target))
        n = self.networks
        assert n.actor_fusion is not None
        critics = [n.encoders, n.critic_fusion, n.critic]
        self.critic_weights = [p for module in critics for p in module.parameters()]
        self.actor_weights = [*n.actor_fusion.parameters(), *n.actor.parameters()]
        self.critic_adam, self.actor_adam = (
            torch.optim.Adam(weights, lr=self.config.learning_rate, fused=True)
            for weights in (self.critic_weights, self.actor_weights)
        )

    def learn(self, batch: Batch, draws: UpdateNoise) -> None:
        n, tau = self.networks, self.config.tau
        with self.arithmetic():
            encoded = n.encoders(batch.observation, draws.shifts)
            with torch.no_grad():
                next_encoded = n.encoders(batch.next_observation, draws.next_shifts)
        with self.arithmetic(), torch.no_grad():
            y = batch.reward + batch.discount * self.next_value(next_encoded, draws.next_noise)
        with self.arithmetic():
            q1, q2 = self.twins(n.critic, n.critic_fusion(encoded), batch.action)
        loss = (q1 - y).square().mean() + (q2 - y).square().mean()
        self.descend(self.critic_adam, loss, self.critic_weights)
        self.update_actor({k: value.detach() for k, value in encoded.items()}, draws.actor_noise)
        recent = dict(n.named_parameters())
        with torch.no_grad():
            for name, average in self.target.named_parameters():
                average.lerp_(recent[name], tau)

    def next_value(self, next_encoded: dict[str, Tensor], noise: Tensor) -> Tensor:
        return self.target_q(next_encoded, (self.policy(next_encoded) + noise).clamp(-1.0, 1.0))

    def target_q(self, next_encoded: dict[str, Tensor], action: Tensor) -> Tensor:
        averaged = "critic_fusion" in self.target
        fusion = (self.target if averaged else self.networks._modules)["critic_fusion"]
        return torch.minimum(*self.twins(self.target["critic"], fusion(next_encoded), action))

    def update_actor(self, encoded: dict[str, Tensor], noise: Tensor) -> None:
        with self.arithmetic():
            action = self.policy(encoded) + noise
            action = action + (action.clamp(-1.0, 1.0) - action).detach()
            loss = -self.q(encoded, action).mean()
        self.descend(self.actor_adam, loss, self.actor_weights)

    def q(self, encoded: dict[str, Tensor], action: Tensor) -> Tensor:
        with torch.no_grad():
            latent = self.networks.critic_fusion(encoded)
        return torch.minimum(*self.twins(self.networks.critic, latent, action))

    def arithmetic(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self.config.precision == "bf16")

    def policy(self, encoded: dict[str, Tensor]) -> Tensor:
        return torch.tanh(self.networks.actor.layers(self.networks.actor_fusion(encoded)))

    @staticmethod
    def twins(critic: nn.Module, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        x = torch.cat([latent, action], dim=-1)
        return critic.q1(x).squeeze(-1), critic.q2(x).squeeze(-1)

    @staticmethod
    def descend(adam: torch.optim.Adam, loss: Tensor, weights: list[Tensor]) -> None:
        adam.zero_grad()
        torch.autograd.backward(loss, inputs=weights)
        adam.step()

    def weights(self) -> dict[str, Tensor]:
        return self.networks.state_dict() | {
            f"target.{name}": value for name, value in self.target.state_dict().items()
        }


class WrittenOutSAC(WrittenOut):
    """The same with a Gaussian policy, and with the step of the temperature."""

    def __init__(self, agent: SAC) -> None:
        super().__init__(agent)
        self.log_alpha = agent.log_alpha.detach().clone().requires_grad_()
        rate = self.config.learning_rate
        self.alpha_adam = torch.optim.Adam([self.log_alpha], lr=rate, fused=True)

    def sample(self, encoded: dict[str, Tensor], noise: Tensor) -> tuple[Tensor, Tensor]:
        out = self.networks.actor.layers(self.networks.actor_fusion(encoded))
        mean, raw = out.chunk(2, dim=-1)
        log_std = -10.0 + (2.0 - -10.0) * (torch.tanh(raw) + 1) / 2
        u = mean + log_std.exp() * noise
        gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        squashed = 2 * (math.log(2) - u - softplus(-2 * u))
        return torch.tanh(u), (gaussian - squashed).sum(-1)

    def next_value(self, next_encoded: dict[str, Tensor], noise: Tensor) -> Tensor:
        action, log_prob = self.sample(next_encoded, noise)
        return self.target_q(next_encoded, action) - self.log_alpha.exp() * log_prob

    def update_actor(self, encoded: dict[str, Tensor], noise: Tensor) -> None:
        with self.arithmetic():
            action, log_prob = self.sample(encoded, noise)
            q = self.q(encoded, action)
        loss = (self.log_alpha.exp().detach() * log_prob - q).mean()
        self.descend(self.actor_adam, loss, self.actor_weights)
        entropy = -log_prob.detach().mean()
        loss = self.log_alpha.exp() * (entropy + action.shape[1])
        self.descend(self.alpha_adam, loss, [self.log_alpha])

    def weights(self) -> dict[str, Tensor]:
        return super().weights() | {"log_alpha": self.log_alpha.detach()}


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@named_cases(*CASES)
def test_five_updates_equal_bit_for_bit(case: Case, precision: str) -> None:
    case = replace(case, config=replace(case.config, precision=precision))
    agent = case.agent()
    sac = isinstance(agent, SAC)
    expected = WrittenOutSAC(agent) if sac else WrittenOut(agent)
    for seed in range(5):
        batch = case.batch_of(seed)
        plan = agent.plan(case.step)
        draws = agent.draw(case.batch, plan)
        agent.learn(batch, draws, plan)
        expected.learn(batch, draws)
    found = agent.networks.state_dict() | {
        f"target.{name}": value for name, value in agent.critic_target.state_dict().items()
    }
    if sac:
        found["log_alpha"] = agent.log_alpha.detach()
    truth = expected.weights()
    assert found.keys() == truth.keys()
    assert [name for name in found if not torch.equal(found[name], truth[name])] == []


def test_initial_weights_have_the_recorded_values() -> None:
    """Other random draws must not change the weights: one weight of each network, to 1e-4."""
    weights = weights_of(CASES[0].agent())
    first = {name: float(weights[name].flatten()[0]) for name in NUMBERS}
    assert first == pytest.approx(NUMBERS, abs=1e-4)


NUMBERS = {
    "xi.image.1.weight": -0.26812,
    "psi_critic.proprio.weight": -0.38656,
    "phi_1.1.weight": 0.17921,
    "phi_2.3.weight": -0.31719,
    "psi_actor.image.weight": 0.00554,
    "theta.1.weight": -0.01253,
    "theta.3.weight": 0.10392,
}
