"""Optional components of the learner, each one value of its config."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from bridge import Case
from test_determinism import same, through_a_file
from torch import Tensor

from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.agents.sac import SAC, SACConfig
from merl.runs.checkpoint import load_agent, load_policy_of, save

SMALL = {"hidden_dim": 16, "precision": "fp32"}
VECTORS = {"images": {}, "vectors": {"state": 9}}
AGENTS = pytest.mark.parametrize(
    "config", [MERLConfig(latent_dim=16, **SMALL), SACConfig(**SMALL)], ids=["merl", "sac"]
)


def case_of(config: AgentConfig, **values: object) -> Case:
    return Case("vectors", replace(config, **values), **VECTORS)


def train(agent: DDPG, case: Case, updates: range, step: int = 0) -> None:
    for seed in updates:
        agent.update(case.batch_of(seed), step=step)


# -- a step size that decays ---------------------------------------------------------------------


@AGENTS
def test_the_step_size_of_every_optimizer_decays_with_the_steps(config: AgentConfig) -> None:
    values = {"learning_rate": 1e-3, "learning_rate_end": 1e-4, "learning_rate_steps": 100}
    case = case_of(config, **values)
    agent, resumed = case.agent(), case.agent()
    for step, rate in ((0, 1e-3), (50, 5.5e-4), (100, 1e-4), (1000, 1e-4)):
        train(agent, case, range(1), step)
        resumed.load_state_dict(through_a_file(agent.state_dict()))
        train(resumed, case, range(1), step)
        for each in (agent, resumed):
            optimizers = [each.critic_optimizer, each.actor_optimizer]
            if isinstance(each, SAC):
                optimizers.append(each.alpha_optimizer)
            for optimizer in optimizers:
                assert [group["lr"] for group in optimizer.param_groups] == [pytest.approx(rate)]


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


def action_of(agent: DDPG, weights: Mapping[str, Tensor], case: Case) -> Tensor:
    """Return the action of an agent with these weights."""
    twin = replace(case, config=replace(case.config, actor_average=None)).agent()
    twin.networks.load_state_dict(weights)
    return twin.act(case.batch_of(99).observation, explore=False, step=0)


@AVERAGED
def test_evaluation_uses_the_average_and_exploration_the_newest_weights(
    config: AgentConfig,
) -> None:
    case = case_of(config, actor_average=0.25, learning_rate=1e-2, noise_std=0.0)
    agent = case.agent()

    def newest() -> dict[str, Tensor]:
        state = agent.networks.state_dict()
        return {k: v.clone() for k, v in state.items() if not k.startswith("policy_average")}

    fusion = "critic_fusion." if config.fusion == "shared_by_both" else "actor_fusion."
    averaged = newest()
    for seed in range(4):
        agent.update(case.batch_of(seed), step=0)
        recent = newest()
        averaged |= {
            name: torch.lerp(averaged[name], recent[name], 0.25)
            for name in recent
            if name.startswith((fusion, "actor."))
        }
    observation = case.batch_of(99).observation
    deterministic = agent.act(observation, explore=False, step=0)
    torch.testing.assert_close(deterministic, action_of(agent, recent | averaged, case))
    assert not torch.allclose(deterministic, action_of(agent, recent, case), atol=1e-3)
    if not isinstance(config, SACConfig):  # SAC's policy itself is random
        exploring = agent.act(observation, explore=True, step=0)
        torch.testing.assert_close(exploring, action_of(agent, recent, case))


@AVERAGED
def test_average_does_not_change_learning(config: AgentConfig) -> None:
    plain, kept = (case_of(config, actor_average=share).agent() for share in (None, 0.1))
    case = case_of(config)
    for agent in (plain, kept):
        train(agent, case, range(3))
    expected, found = plain.networks.state_dict(), kept.networks.state_dict()
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_checkpoint_includes_the_average(tmp_path: Path) -> None:
    case = case_of(MERLConfig(latent_dim=16, **SMALL), actor_average=0.1, learning_rate=1e-2)
    agent, resumed, deployed = case.agent(), case.agent(seed=8), case.agent(seed=9)
    train(agent, case, range(3))
    saved = save(tmp_path, 3, agent, {}, score=None, keep=1)
    load_policy_of(deployed, saved)
    load_agent(resumed, saved)
    observation = case.batch_of(99).observation
    expected = agent.act(observation, explore=False, step=0)
    for each in (resumed, deployed):
        assert torch.equal(each.act(observation, explore=False, step=0), expected)
    for each in (agent, resumed):
        train(each, case, range(3, 5))
    assert same(agent, resumed)


# -- all together --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"critic_loss": "hl_gauss"},
        {"critic_loss": "hl_gauss", "actor_average": 0.1},
    ],
    ids=["none", "hl_gauss", "all"],
)
@AGENTS
def test_metrics_are_scalars_without_gradient(
    config: AgentConfig, values: dict[str, object]
) -> None:
    """A metric with a gradient would keep the graph of every update in memory."""
    if isinstance(config, SACConfig):
        values = {name: value for name, value in values.items() if name != "critic_loss"}
    case = case_of(config, **values)
    metrics = case.agent().update(case.batch_of(0), step=0)
    assert not [name for name, value in metrics.items() if value.requires_grad or value.ndim]
    assert all(value.isfinite() for value in metrics.values())
