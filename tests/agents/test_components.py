"""Optional components of the learner, each one value of its config."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from bridge import Case, weights_of
from test_determinism import same, through_a_file

from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.agents.sac import SACConfig

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
