"""SAC's update against the reference, its policy against SciPy, its entropy at the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference_sac
import scipy.stats
import torch
from bridge import (
    Case,
    beyond,
    double,
    error,
    errors,
    fill_adam_state,
    gradients_of,
    moments_of,
    named_cases,
    pair_of,
    sample_of,
    state_of,
    weather,
    weights_of,
)

from merl.agents.config import AgentConfig
from merl.agents.sac import SAC, SACConfig
from merl.core import Batch, MerlError, UpdateNoise

SMALL = SACConfig(hidden_dim=32, precision="fp32")
STATE = {"state": 9}
CASES = [
    Case("state", SMALL, images={}, vectors=STATE),
    Case("ensemble", replace(SMALL, critics=4), images={}, vectors=STATE),
    Case(
        "other-numbers",
        replace(SMALL, temperature=0.1, target_entropy=-2.5, tau=0.3, learning_rate=3e-3),
        images={},
        vectors=STATE,
    ),
    Case(
        "camera-and-joints",
        replace(SMALL, keys=None, latent_dim=48, head_norm=True, conv_channels=8),
    ),
    Case("both-vectors", replace(SMALL, keys=("state", "touch")), {}, {**STATE, "touch": 2}),
]


def prepared(case: Case) -> SAC:
    agent = case.agent()
    assert isinstance(agent, SAC)
    double(agent)
    agent.log_alpha.data = agent.log_alpha.data.double()
    weather(agent)
    fill_adam_state(agent)
    return agent


def draws_of(chance: reference_sac.Chance, config: AgentConfig) -> UpdateNoise:
    pair = pair_of(chance, config)
    return UpdateNoise(chance.shift, chance.shift_next, chance.noise_next, chance.noise, pair)


@named_cases(*CASES)
def test_five_updates_equal_the_reference(case: Case) -> None:
    agent = prepared(case)
    zero = torch.zeros((), dtype=torch.float64)
    moments = reference_sac.Moments(0, {"log_alpha": zero}, {"log_alpha": zero})
    truth = reference_sac.SoftState(state_of(agent), agent.log_alpha.detach().clone(), moments)
    target_entropy = case.config.target_entropy or -agent.networks.actor.layers[-1].out_features / 2
    for seed in range(5):
        chance, batch = case.chance_of(seed), case.batch_of(seed, torch.float64)
        metrics = case.learn(agent, batch, draws_of(chance, case.config))
        sample = sample_of(case.batch_of(seed))
        truth, report = reference_sac.update(truth, sample, chance, case.spec, target_entropy)
        for name in ("critic_loss", "actor_loss", "alpha_loss", "entropy"):
            assert error(metrics[name], getattr(report, name)) < 1e-8, name
        assert error(metrics["target_q"], report.y.mean()) < 1e-8
        expected = dict(report.gradients)
        assert agent.log_alpha.grad is not None
        assert error(agent.log_alpha.grad, expected.pop("log_alpha")) < 1e-8
        assert not beyond(errors(gradients_of(agent), expected), 1e-8)
    assert not beyond(errors(weights_of(agent), truth.agent.weights), 1e-9)
    assert error(agent.log_alpha.detach(), truth.log_alpha) < 1e-9
    for optimizer, state in (
        (agent.critic_optimizer, truth.agent.critic_adam),
        (agent.actor_optimizer, truth.agent.actor_adam),
    ):
        assert not beyond(errors(moments_of(optimizer, agent).v, state.v), 1e-8)


def test_log_prob_is_that_of_a_squashed_gaussian() -> None:
    """Compare with the change of variables, on a grid of one action."""
    case = replace(CASES[0], batch=1)
    agent = prepared(case)
    encoded = agent.networks.encoders(case.batch_of(0, torch.float64).observation)
    grid = np.linspace(-12, 12, 4001)
    first, log_probs = [], []
    for noise in grid:
        draw = torch.zeros(1, 6, dtype=torch.float64)
        draw[0, 0] = noise
        action, log_prob, _ = agent._sample(encoded, draw)
        first.append(action[0, 0].item())
        log_probs.append(float(log_prob))
    rest = agent._sample(encoded, torch.zeros(1, 6, dtype=torch.float64))[1]
    # density of the first action, up to the constant factor of the five fixed ones
    density = np.exp(np.array(log_probs) - float(rest))
    mean, log_std = agent.networks.actor(agent.networks.actor_latent(encoded))
    mu, sigma = float(mean[0, 0]), float(log_std.exp()[0, 0])
    u = np.arctanh(np.clip(first, -1 + 1e-15, 1 - 1e-15))
    inside = np.abs(first) < 0.999999
    squash = 1 - np.square(first)
    expected = scipy.stats.norm.pdf(u, mu, sigma) / squash
    center = scipy.stats.norm.pdf(mu, mu, sigma) / (1 - np.tanh(mu) ** 2)
    np.testing.assert_allclose(density[inside], (expected / center)[inside], rtol=1e-6)


def test_exploration_samples_and_evaluation_uses_the_mean() -> None:
    case = CASES[0]
    agent = case.agent()
    observation = case.batch_of(0).observation
    deterministic = agent.act(observation, explore=False, step=0)
    assert torch.equal(deterministic, agent.act(observation, explore=False, step=0))
    sampled = torch.stack([agent.act(observation, explore=True, step=0) for _ in range(2000)])
    assert sampled.abs().max() <= 1
    mean, log_std = agent.networks.actor(
        agent.networks.actor_latent(agent.networks.encoders(observation))
    )
    assert torch.equal(deterministic, torch.tanh(mean))
    u = torch.atanh(sampled.double().clamp(-1 + 1e-12, 1 - 1e-12))
    assert u.mean(0) == pytest.approx(mean.double().detach(), abs=0.15)
    assert u.std(0) == pytest.approx(log_std.exp().double().detach(), rel=0.15)


def one_step_batch(generator: torch.Generator, size: int = 64) -> Batch:
    """Return a batch of a task with one step, in which action a has the reward -|a|^2."""
    state = {"state": torch.zeros(size, 1)}
    action = torch.rand(size, 2, generator=generator) * 2 - 1
    reward = -action.square().sum(-1)
    return Batch(state, action, reward, torch.zeros(size), state)


@pytest.mark.parametrize("target", [0.5, pytest.param(-2.0, marks=pytest.mark.long)])
def test_temperature_brings_the_entropy_to_its_target(target: float) -> None:
    numbers = {"hidden_dim": 32, "learning_rate": 3e-3, "temperature": 0.05}
    config = SACConfig(**numbers, target_entropy=target, precision="fp32")
    agent = Case("one", config, images={}, vectors={"state": 1}).agent(actions=2)
    generator = torch.Generator().manual_seed(0)
    seen = []
    for _ in range(2000):
        metrics = agent.update(one_step_batch(generator), step=0)
        seen.append([float(metrics[name]) for name in ("entropy", "alpha", "q")])
    entropy, alpha, _ = np.mean(seen[-300:], axis=0)
    assert entropy == pytest.approx(target, abs=0.15)
    assert 1e-4 < alpha < 10
    spread = np.std([row[1] for row in seen[-300:]]) / alpha
    assert spread < 0.5  # it has converged


def test_saved_agent_resumes_bit_for_bit() -> None:
    case = CASES[0]
    one, other = case.agent(), case.agent(seed=1)
    one.update(case.batch_of(0), step=0)
    other.load_state_dict(one.state_dict())
    for agent in (one, other):
        agent.update(case.batch_of(1), step=0)
    assert isinstance(one, SAC)
    assert isinstance(other, SAC)
    assert torch.equal(one.log_alpha, other.log_alpha)
    pairs = zip(one.networks.parameters(), other.networks.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("field", "value"), [("temperature", 0.0), ("target_entropy", float("nan"))]
)
def test_error_names_the_invalid_number(field: str, value: float) -> None:
    with pytest.raises(MerlError, match=f"agent.{field.replace('_', '-')} must"):
        SACConfig(**{field: value})
