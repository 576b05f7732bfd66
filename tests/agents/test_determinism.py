"""The same seed gives the same weights, and a saved agent resumes bit for bit."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch
from bridge import Case, named, weights_of
from torch import Tensor

from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.core import UpdateNoise

CASE = Case(
    "small",
    MERLConfig(
        latent_dim=32,
        conv_channels=8,
        hidden_dim=32,
        encoders={"proprio": "mlp"},
        mlp_dim=8,
        precision="fp32",
    ),
)


def trained(agent: DDPG, updates: range) -> DDPG:
    for seed in updates:
        agent.update(CASE.batch_of(seed), step=0)
        agent.act(CASE.batch_of(seed).observation, explore=True, step=0)
    return agent


def same(a: DDPG, b: DDPG) -> bool:
    x, y = weights_of(a), weights_of(b)
    return x.keys() == y.keys() and all(torch.equal(x[name], y[name]) for name in x)


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    """Save and load as a checkpoint does, with plain types only."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    loaded: dict[str, Any] = torch.load(file, weights_only=True)
    return loaded


def contiguous(state: Any) -> Any:
    """Make every tensor contiguous, as file formats without strides do."""
    if isinstance(state, Tensor):
        return state.clone(memory_format=torch.contiguous_format)
    if isinstance(state, dict):
        return {key: contiguous(value) for key, value in state.items()}
    return [contiguous(value) for value in state] if isinstance(state, list) else state


def drawn(agent: DDPG) -> UpdateNoise:
    return agent.draw(CASE.batch, agent.plan(0))


def test_same_seed_gives_the_same_weights() -> None:
    first, again, other = (trained(CASE.agent(seed), range(20)) for seed in (1, 1, 2))
    assert same(first, again)
    assert not same(first, other)


def test_seed_determines_initial_weights() -> None:
    assert same(CASE.agent(1), CASE.agent(1))
    assert not same(CASE.agent(1), CASE.agent(2))


def test_seed_determines_update_noise() -> None:
    first, again, other = (drawn(CASE.agent(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.next_noise, again.next_noise)
    assert torch.equal(first.shifts["image"], again.shifts["image"])
    assert not torch.equal(first.next_noise, other.next_noise)
    assert not torch.equal(first.shifts["image"], other.shifts["image"])


def check_resumes_bit_for_bit(state: dict[str, Any], agent: DDPG) -> None:
    resumed = CASE.agent(seed=99)
    resumed.load_state_dict(state)
    assert same(resumed, agent)
    for each in (agent, resumed):
        trained(each, range(5, 10))
    assert same(resumed, agent)
    observation = CASE.batch_of(50).observation
    for explore in (False, True):
        assert torch.equal(
            resumed.act(observation, explore=explore, step=0),
            agent.act(observation, explore=explore, step=0),
        )


def test_saved_agent_resumes_bit_for_bit() -> None:
    agent = trained(CASE.agent(), range(5))
    check_resumes_bit_for_bit(through_a_file(agent.state_dict()), agent)


def test_untrained_agent_can_be_saved() -> None:
    agent = CASE.agent()
    check_resumes_bit_for_bit(through_a_file(agent.state_dict()), agent)


def test_memory_order_of_a_saved_tensor_does_not_matter() -> None:
    """A fused Adam reads weights and moments as raw memory and ignores their strides."""
    agent = trained(CASE.agent(), range(5))
    check_resumes_bit_for_bit(contiguous(through_a_file(agent.state_dict())), agent)


def test_loaded_agent_shares_no_memory_with_the_other() -> None:
    agent = trained(CASE.agent(), range(2))
    twin = CASE.agent(seed=99)
    twin.load_state_dict(agent.state_dict())
    trained(twin, range(2, 4))
    expected = trained(CASE.agent(), range(2))
    for each in (agent, expected):
        trained(each, range(4, 6))
    assert same(agent, expected)


@pytest.mark.parametrize("name", ["critic_optimizer", "actor_optimizer"])
def test_moments_have_the_memory_order_of_the_weights(name: str) -> None:
    agent = trained(CASE.agent(), range(1))
    state = getattr(agent, name).state
    for p in [p for p in named(agent).values() if p in state]:
        assert state[p]["exp_avg"].stride() == state[p]["exp_avg_sq"].stride() == p.stride()
        assert p.grad is not None
        assert p.grad.stride() == p.stride()
