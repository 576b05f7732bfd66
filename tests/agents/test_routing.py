"""Weights that each loss trains: C.1's last sentences on each network, and Algorithm 1."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from bridge import Case, double, draws_of, named, snapshot, weather, weights_of

from merl.agents.bc import BCConfig
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig

CONFIG = MERLConfig(
    latent_dim=32,
    conv_channels=8,
    hidden_dim=32,
    encoders={"proprio": "mlp"},
    mlp_dim=16,
    precision="fp32",
)
CASE = Case("mlp", CONFIG)
BOTH_TARGETS = pytest.mark.parametrize("target", ["heads", "heads_and_fusion"])
CRITICS = ("encoders", "critic_fusion", "critic")
ACTORS = ("actor_fusion", "actor")


def agent_in_training(target: str = "heads") -> DDPG:
    """Make an agent and update it once, so that every network has a gradient."""
    agent = replace(CASE, config=replace(CONFIG, target=target)).agent()
    weather(agent)
    agent.update(CASE.batch_of(0), step=0)
    return agent


def update_critic(agent: DDPG) -> None:
    batch, draws = CASE.batch_of(1), draws_of(CASE.chance_of(1), CONFIG, torch.float32)
    encoders = agent.networks.encoders
    encoded = encoders(batch.observation, draws.shifts)
    with torch.no_grad():
        next_encoded = encoders(batch.next_observation, draws.next_shifts)
    agent.update_critic(encoded, next_encoded, batch, draws)


def update_actor(agent: DDPG, *, detached: bool = True) -> None:
    batch, draws = CASE.batch_of(1), draws_of(CASE.chance_of(1), CONFIG, torch.float32)
    encoded = agent.networks.encoders(batch.observation, draws.shifts)
    if detached:
        encoded = {key: features.detach() for key, features in encoded.items()}
    agent.update_actor(encoded, batch, draws.actor_noise, agent.plan(0))


def same(before: list, after: list) -> bool:
    """Return whether values and gradients are equal bit for bit."""
    return all(
        torch.equal(p, q) and ((g is None and h is None) or torch.equal(g, h))
        for (p, g), (q, h) in zip(before, after, strict=True)
    )


@pytest.mark.parametrize("fusion", ["decoupled", "shared", "shared_by_both"])
def test_cloning_trains_the_fusion_that_the_actor_uses(fusion: str) -> None:
    agent = replace(CASE, config=BCConfig(**{**vars(CONFIG), "fusion": fusion})).agent()
    trained = [id(p) for p in agent.actor_parameters]
    used = [*agent.networks.fusion_of_actor().parameters(), *agent.networks.actor.parameters()]
    assert {id(p) for p in used} <= {*trained}
    assert len(trained) == len({*trained})


@BOTH_TARGETS
@pytest.mark.parametrize("fusion", ["decoupled", "shared"])
def test_a_cloned_policy_is_that_of_the_targets_too(fusion: str, target: str) -> None:
    config = replace(CONFIG, fusion=fusion, target=target)
    first, second = (replace(CASE, config=config).agent() for _ in range(2))
    weather(second)
    first.take_policy(second)
    if target == "heads_and_fusion":
        kept = first.critic_target["critic_fusion"].state_dict()
        for name, value in first.networks.critic_fusion.state_dict().items():
            assert torch.equal(kept[name], value)
    assert torch.equal(
        first.networks.actor.state_dict()["layers.0.linear.weight"],
        second.networks.actor.state_dict()["layers.0.linear.weight"],
    )


@pytest.mark.parametrize("detached", [True, False])
def test_actor_loss_trains_only_actor_and_its_fusion(detached: bool) -> None:
    agent = agent_in_training()
    fixed = [getattr(agent.networks, name) for name in CRITICS] + [agent.critic_target]
    before = [snapshot(module.parameters()) for module in fixed]
    trained = {
        n: p.detach().clone() for n, p in named(agent).items() if n.startswith(("psi_a", "the"))
    }
    update_actor(agent, detached=detached)
    assert all(map(same, before, [snapshot(module.parameters()) for module in fixed]))
    assert trained
    assert not any(torch.equal(p, named(agent)[name]) for name, p in trained.items())


def test_critic_loss_trains_critic_its_fusion_and_encoders() -> None:
    agent = agent_in_training()
    fixed = [getattr(agent.networks, name) for name in ACTORS] + [agent.critic_target]
    before = [snapshot(module.parameters()) for module in fixed]
    symbols = ("xi", "zeta", "psi_c", "phi")
    trained = {n: p.detach().clone() for n, p in named(agent).items() if n.startswith(symbols)}
    update_critic(agent)
    assert all(map(same, before, [snapshot(module.parameters()) for module in fixed]))
    assert {name.split(".")[0] for name in trained} == {
        "xi",
        "zeta",
        "psi_critic",
        "phi_1",
        "phi_2",
    }
    assert not any(torch.equal(p, named(agent)[name]) for name, p in trained.items())


@BOTH_TARGETS
def test_target_moves_by_tau(target: str) -> None:
    agent = double(agent_in_training(target))
    tau, before = agent.config.tau, weights_of(agent)
    agent.update_target()
    after = weights_of(agent)
    for name in before:
        if name.startswith("bar_"):
            recent = before[name.removeprefix("bar_")]
            expected = (1 - tau) * before[name] + tau * recent
            torch.testing.assert_close(after[name], expected, rtol=1e-13, atol=1e-15)
            assert not torch.equal(before[name], after[name])
        else:
            assert torch.equal(before[name], after[name])


@BOTH_TARGETS
def test_update_moves_the_target_once(target: str) -> None:
    agent = double(agent_in_training(target))
    before = weights_of(agent)
    CASE.learn(
        agent,
        CASE.batch_of(2, torch.float64),
        draws_of(CASE.chance_of(2), CONFIG, torch.float64),
    )
    after = weights_of(agent)
    for name in [name for name in before if name.startswith("bar_")]:
        recent = after[name.removeprefix("bar_")]  # the critic's step came first
        expected = 0.99 * before[name] + 0.01 * recent
        torch.testing.assert_close(after[name], expected, rtol=1e-13, atol=1e-15)


def test_tau_of_one_copies_the_critic() -> None:
    case = replace(CASE, config=replace(CONFIG, tau=1.0))
    agent = case.agent()
    weather(agent)
    agent.update(case.batch_of(0), step=0)
    weights = weights_of(agent)
    for name in weights:
        if name.startswith("bar_"):
            torch.testing.assert_close(weights[name], weights[name.removeprefix("bar_")])


def test_networks_that_have_a_target() -> None:
    def averaged(target: str) -> set[str]:
        names = weights_of(agent_in_training(target))
        return {name.split(".")[0] for name in names if name.startswith("bar_")}

    assert averaged("heads") == {"bar_phi_1", "bar_phi_2"}
    assert averaged("heads_and_fusion") == {"bar_psi_critic", "bar_phi_1", "bar_phi_2"}


@BOTH_TARGETS
def test_target_starts_as_a_copy_and_has_no_gradient(target: str) -> None:
    agent = replace(CASE, config=replace(CONFIG, target=target)).agent()
    weights = weights_of(agent)
    for name in weights:
        if name.startswith("bar_"):
            assert torch.equal(weights[name], weights[name.removeprefix("bar_")])
    agent.update(CASE.batch_of(0), step=0)
    assert not any(p.requires_grad for p in agent.critic_target.parameters())
    assert all(p.grad is None for p in agent.critic_target.parameters())


def test_each_weight_is_in_exactly_one_optimizer() -> None:
    agent = CASE.agent()
    groups = [
        [p for group in optimizer.param_groups for p in group["params"]]
        for optimizer in (agent.critic_optimizer, agent.actor_optimizer)
    ]
    trained = [id(p) for group in groups for p in group]
    assert sorted(trained) == sorted(id(p) for p in agent.networks.parameters())
    assert len(set(trained)) == len(trained)


@pytest.mark.parametrize("frozen", ["image", "proprio"])
def test_frozen_encoders_are_not_trained(frozen: str) -> None:
    agent = replace(CASE, config=replace(CONFIG, frozen_encoders=(frozen,))).agent()
    before = {name: p.detach().clone() for name, p in agent.networks.named_parameters()}
    for seed in range(2):
        agent.update(CASE.batch_of(seed), step=0)
    for name, parameter in agent.networks.named_parameters():
        is_frozen = name.startswith(f"encoders.by_key.{frozen}.")
        assert torch.equal(parameter, before[name]) == is_frozen, name
