"""Optional components of the learner, each one value of its config."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from bridge import Case, double, weights_of
from test_determinism import same, through_a_file
from torch import Tensor

from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.agents.sac import SAC, SACConfig
from merl.core import MerlError
from merl.networks.heads import MLP
from merl.training.checkpoint import load_agent, load_networks, save

SMALL = {"hidden_dim": 16, "precision": "fp32"}
VECTORS = {"images": {}, "vectors": {"state": 9}}
AGENTS = pytest.mark.parametrize(
    "config", [MERLConfig(latent_dim=16, **SMALL), SACConfig(**SMALL)], ids=["merl", "sac"]
)


def case_of(config: AgentConfig, **values: object) -> Case:
    return Case("vectors", replace(config, **values), **VECTORS)


def train(agent: DDPG, case: Case, updates: range) -> None:
    for seed in updates:
        agent.update(case.batch_of(seed))


# -- the actor learns in every n-th update ---------------------------------------------------------


@AGENTS
def test_the_actor_learns_in_every_third_update(config: AgentConfig) -> None:
    case = case_of(config, actor_every=3)
    agent = case.agent()
    moved: list[tuple[bool, bool]] = []
    for seed in range(7):
        before = weights_of(agent)
        metrics = agent.update(case.batch_of(seed))
        after = weights_of(agent)
        actor, critic = (
            not torch.equal(before[name], after[name])
            for name in ("theta.1.weight", "phi_1.1.weight")
        )
        assert ("actor_loss" in metrics) == actor
        moved.append((actor, critic))
    assert [critic for _, critic in moved] == [True] * 7
    assert [actor for actor, _ in moved] == [False, False, True, False, False, True, False]


def test_a_saved_agent_keeps_its_place_between_two_updates_of_the_actor() -> None:
    case = case_of(MERLConfig(latent_dim=16, **SMALL), actor_every=3)
    agent, resumed = case.agent(), case.agent(seed=9)
    train(agent, case, range(4))
    resumed.load_state_dict(through_a_file(agent.state_dict()))
    for each in (agent, resumed):
        train(each, case, range(4, 6))  # the second of these moves the actor
    assert same(agent, resumed)


def test_a_checkpoint_without_a_count_of_updates_can_be_loaded() -> None:
    case = case_of(MERLConfig(latent_dim=16, **SMALL))
    state = case.agent().state_dict()
    del state["updates"]
    agent = case.agent(seed=9)
    agent.load_state_dict(state)
    assert agent.updates == 0


# -- step sizes ----------------------------------------------------------------------------------


def test_groups_of_step_sizes_are_restored() -> None:
    case = Case(
        "camera",
        MERLConfig(latent_dim=16, conv_channels=4, encoder_learning_rate=1e-3, **SMALL),
        images={"image": (16, 16, 1)},
    )
    agent, resumed = case.agent(), case.agent(seed=9)
    train(agent, case, range(2))
    resumed.load_state_dict(through_a_file(agent.state_dict()))
    for each in (agent, resumed):
        train(each, case, range(2, 4))
    assert same(agent, resumed)
    rates = [group["lr"] for group in resumed.critic_optimizer.param_groups]
    assert sorted(rates) == [1e-4, 1e-3]


def test_an_encoders_rate_needs_no_encoder_that_learns() -> None:
    case = case_of(MERLConfig(latent_dim=16, **SMALL), encoder_learning_rate=1e-3)
    train(case.agent(), case, range(1))


# -- saturated outputs ---------------------------------------------------------------------------


def test_a_penalty_keeps_outputs_from_the_ends_of_the_tanh() -> None:
    """From outputs that are all far beyond 1; without it they stay there."""
    config = MERLConfig(latent_dim=16, **SMALL)
    largest = []
    for penalty in (0.0, 10.0):
        case = case_of(config, saturation_penalty=penalty, learning_rate=1e-2)
        agent = case.agent()
        actor = agent.networks.actor
        with torch.no_grad():
            actor.layers.output.bias[: actor.action_dim] = 4.0
        train(agent, case, range(60))
        observation = case.batch_of(0).observation
        action = agent.act(observation, explore=False)
        largest.append(float(torch.atanh(action.double()).abs().mean()))
    assert largest[0] > 3.0
    assert largest[1] < 1.6


# -- an average of the actor ---------------------------------------------------------------------

AVERAGED = pytest.mark.parametrize(
    "config",
    [
        MERLConfig(latent_dim=16, **SMALL),
        MERLConfig(latent_dim=16, fusion="shared_by_both", **SMALL),
        SACConfig(**SMALL),
    ],
    ids=["merl", "shared fusion", "sac"],
)


def as_it_acts(agent: DDPG, weights: Mapping[str, Tensor], case: Case) -> Tensor:
    """The action that these weights of its networks give."""
    twin = replace(case, config=replace(case.config, actor_average=None)).agent()
    twin.networks.load_state_dict(weights)
    return twin.act(case.batch_of(99).observation, explore=False)


@AVERAGED
def test_evaluation_acts_by_the_average_and_exploration_by_the_newest(config: AgentConfig) -> None:
    case = case_of(config, actor_average=0.25, learning_rate=1e-2, noise_std=0.0)
    agent = case.agent()

    def newest() -> dict[str, Tensor]:
        state = agent.networks.state_dict()
        return {k: v.clone() for k, v in state.items() if not k.startswith("policy_average")}

    fusion = "critic_fusion." if config.fusion == "shared_by_both" else "actor_fusion."
    averaged = newest()
    for seed in range(4):
        agent.update(case.batch_of(seed))
        recent = newest()
        averaged |= {
            name: torch.lerp(averaged[name], recent[name], 0.25)
            for name in recent
            if name.startswith((fusion, "actor."))
        }
    observation = case.batch_of(99).observation
    calm = agent.act(observation, explore=False)
    torch.testing.assert_close(calm, as_it_acts(agent, recent | averaged, case))
    assert not torch.allclose(calm, as_it_acts(agent, recent, case), atol=1e-3)
    if not isinstance(config, SACConfig):  # whose noise is the policy's own
        exploring = agent.act(observation, explore=True)
        torch.testing.assert_close(exploring, as_it_acts(agent, recent, case))


@AVERAGED
def test_an_average_changes_nothing_of_what_is_learnt(config: AgentConfig) -> None:
    plain, kept = (case_of(config, actor_average=share).agent() for share in (None, 0.1))
    case = case_of(config)
    for agent in (plain, kept):
        train(agent, case, range(3))
    expected, found = plain.networks.state_dict(), kept.networks.state_dict()
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_an_average_is_in_the_weights_that_a_checkpoint_holds(tmp_path: Path) -> None:
    case = case_of(MERLConfig(latent_dim=16, **SMALL), actor_average=0.1, learning_rate=1e-2)
    agent, resumed, deployed = case.agent(), case.agent(seed=8), case.agent(seed=9)
    train(agent, case, range(3))
    saved = save(tmp_path, 3, agent, {}, score=None, keep=1)
    load_networks(deployed.networks, saved)
    load_agent(resumed, saved)
    observation = case.batch_of(99).observation
    expected = agent.act(observation, explore=False)
    for each in (resumed, deployed):
        assert torch.equal(each.act(observation, explore=False), expected)
    for each in (agent, resumed):
        train(each, case, range(3, 5))
    assert same(agent, resumed)


# -- BatchNorm in the critic (CrossQ) ------------------------------------------------------------

CROSSQ = MERLConfig(latent_dim=16, critic_batch_norm=True, **SMALL)


def batch_normed(head: MLP, x: Tensor) -> Tensor:
    """A head in training: each hidden layer's numbers by mean and deviation over the batch."""
    for layer in head.hidden:
        x = x @ layer.linear.weight.T + layer.linear.bias
        x = (x - x.mean(0)) / (x.var(0, correction=0) + 1e-5).sqrt()
        x = (x * layer.norm.weight + layer.norm.bias).clamp(min=0)
    return x @ head.output.weight.T + head.output.bias


@AGENTS
def test_batch_norm_takes_both_halves_of_a_joint_pass_together(config: AgentConfig) -> None:
    """Target, loss and gradients of one update, written out.

    The target and what fusion and encoders make of o' are constants to the gradient.
    """
    case = case_of(config, critic_batch_norm=True, reward_scale=2.0)
    agent, batch = double(case.agent()), case.batch_of(0, torch.float64)
    if isinstance(agent, SAC):
        agent.log_alpha.data = agent.log_alpha.data.double()
    n, draws = agent.networks, agent.draw(case.batch)
    draws = replace(draws, next_noise=draws.next_noise.double())
    then, now = n.encoders(batch.next_observation), n.encoders(batch.observation)
    with torch.no_grad():
        action, bonus = agent.next_action(then, draws.next_noise)
        next_latent = n.critic_fusion(then)
    latents, actions = [n.critic_fusion(now), next_latent], [batch.action, action]
    x = torch.cat([torch.cat(latents), torch.cat(actions)], dim=-1)
    q1, q2 = (batch_normed(head, x).squeeze(-1) for head in (n.critic.q1, n.critic.q2))
    least = torch.minimum(q1[case.batch :], q2[case.batch :]).detach()
    y = 2.0 * batch.reward + batch.discount * (least + bonus)
    loss = sum((q[: case.batch] - y).square().mean() for q in (q1, q2))
    gradients = torch.autograd.grad(loss, agent.critic_parameters)
    metrics = agent.update_critic(now, then, batch, draws.next_noise)
    torch.testing.assert_close(metrics["critic_loss"], loss.detach(), rtol=1e-9, atol=0)
    torch.testing.assert_close(metrics["target_q"], y.mean() / 2.0, rtol=1e-9, atol=0)
    for parameter, gradient in zip(agent.critic_parameters, gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-6, atol=1e-12)


def test_the_actor_is_judged_by_running_statistics() -> None:
    """Which it leaves alone: its values do not depend on the batch that they are in."""
    case = case_of(CROSSQ)
    agent = case.agent()
    train(agent, case, range(3))
    before = {name: value.clone() for name, value in agent.networks.critic.named_buffers()}
    assert any(value.any() for value in before.values())
    encoded = agent.networks.encoders(case.batch_of(3).observation)
    action = case.batch_of(3).action
    whole = agent.q(encoded, action)
    part = agent.q({key: value[:2] for key, value in encoded.items()}, action[:2])
    torch.testing.assert_close(part, whole[:2])
    after = dict(agent.networks.critic.named_buffers())
    assert all(torch.equal(after[name], value) for name, value in before.items())
    train(agent, case, range(3, 4))
    assert not any(torch.equal(after[name], before[name]) for name in before if "mean" in name)


def test_a_critic_with_batch_norm_has_no_target_and_goes_on_where_it_was_saved(
    tmp_path: Path,
) -> None:
    case = case_of(CROSSQ)
    agent, resumed = case.agent(), case.agent(seed=9)
    train(agent, case, range(3))
    assert not list(agent.critic_target.parameters())
    load_agent(resumed, save(tmp_path, 3, agent, {}, score=None, keep=1))
    for each in (agent, resumed):
        train(each, case, range(3, 6))
    assert same(agent, resumed)


def test_batch_norm_needs_a_hidden_layer() -> None:
    with pytest.raises(MerlError, match=r"critic-batch-norm .* at least 2 agent.head-layers"):
        MERLConfig(critic_batch_norm=True, head_layers=1)


# -- all together --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"critic_loss": "hl_gauss"},
        {"critic_batch_norm": True},
        {
            "critic_loss": "hl_gauss",
            "critic_batch_norm": True,
            "reward_scale": 2.0,
            "actor_average": 0.1,
            "saturation_penalty": 0.1,
            "encoder_learning_rate": 1e-3,
        },
    ],
    ids=["none", "hl_gauss", "batch norm", "all"],
)
@AGENTS
def test_metrics_are_plain_numbers(config: AgentConfig, values: dict[str, object]) -> None:
    """A metric with a gradient would keep the graphs of all updates in memory."""
    if isinstance(config, SACConfig):
        values = {name: value for name, value in values.items() if name != "critic_loss"}
    case = case_of(config, **values)
    metrics = case.agent().update(case.batch_of(0))
    assert not [name for name, value in metrics.items() if value.requires_grad or value.ndim]
    assert all(value.isfinite() for value in metrics.values())
