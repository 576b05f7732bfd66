"""Without optional components, weights are bit for bit those of the update written out here.

Recorded runs stay valid only as long as this holds. The update below is built from torch's
operations and from layers alone, in the order that the first recorded runs had. It is the same on
every processor, which a hash of the weights would not be.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from bridge import Case, named_cases, weights_of
from torch import Tensor, nn

from merl.agents.ddpg import DDPG, DDPGConfig
from merl.agents.draws import Draws
from merl.agents.drqv2 import DrQV2Config
from merl.agents.merl import MERLConfig
from merl.core import Batch
from merl.networks.heads import Actor

SMALL = {"conv_channels": 8, "hidden_dim": 32}
CASES = [
    Case("merl", MERLConfig(latent_dim=48, **SMALL)),
    Case("drqv2", DrQV2Config(**SMALL), vectors={}),
    Case("ddpg", DDPGConfig(**SMALL), images={}, vectors={"state": 9}),
]


class WrittenOut:
    """An agent's weights, and the update as a list of operations."""

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

    def learn(self, batch: Batch, draws: Draws) -> None:
        n = self.networks
        bf16 = self.config.precision == "bf16"
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            encoded = n.encoders(batch.observation, draws.shifts)
            with torch.no_grad():
                next_encoded = n.encoders(batch.next_observation, draws.next_shifts)
                next_action = (self.policy(next_encoded) + draws.next_noise).clamp(-1.0, 1.0)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16), torch.no_grad():
            averaged = "critic_fusion" in self.target
            latent = (self.target if averaged else n._modules)["critic_fusion"](next_encoded)
            next_q = torch.minimum(*self.twins(self.target["critic"], latent, next_action))
            y = batch.reward + batch.discount * next_q
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            q1, q2 = self.twins(n.critic, n.critic_fusion(encoded), batch.action)
        loss = (q1 - y).square().mean() + (q2 - y).square().mean()
        self.descend(self.critic_adam, loss, self.critic_weights)

        encoded = {key: value.detach() for key, value in encoded.items()}
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            action = self.policy(encoded) + draws.actor_noise
            action = action + (action.clamp(-1.0, 1.0) - action).detach()
            with torch.no_grad():
                latent = n.critic_fusion(encoded)
            q1, q2 = self.twins(n.critic, latent, action)
            loss = -torch.minimum(q1, q2).mean()
        self.descend(self.actor_adam, loss, self.actor_weights)

        recent = dict(n.named_parameters())
        with torch.no_grad():
            for name, average in self.target.named_parameters():
                average.lerp_(recent[name], self.config.tau)

    def policy(self, encoded: dict[str, Tensor]) -> Tensor:
        assert isinstance(self.networks.actor, Actor)
        assert self.networks.actor_fusion is not None
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


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@named_cases(*CASES)
def test_five_updates_bit_for_bit(case: Case, precision: str) -> None:
    case = replace(case, config=replace(case.config, precision=precision))
    agent = case.agent()
    expected = WrittenOut(agent)
    for seed in range(5):
        batch = case.batch_of(seed)
        draws = agent.draw(case.batch)
        agent.learn(batch, draws)
        expected.learn(batch, draws)
    found = agent.networks.state_dict() | {
        f"target.{name}": value for name, value in agent.critic_target.state_dict().items()
    }
    truth = expected.weights()
    assert found.keys() == truth.keys()
    assert [name for name in found if not torch.equal(found[name], truth[name])] == []


def test_the_random_stream_of_the_first_weights() -> None:
    """Whatever is drawn beside the weights must not move them: one of each network, to 1e-4."""
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
