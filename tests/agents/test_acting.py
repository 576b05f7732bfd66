"""Acting, a_t = pi(o_t) + epsilon: the exploration noise, its bounds and its seed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import reference
import torch
from bridge import Case, double, state_of, weather, weights_of

from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.core import MerlError

CONFIG = MERLConfig(latent_dim=32, conv_channels=8, hidden_dim=32, precision="fp32")
WITH_IMAGE = Case("with-image", CONFIG)
VECTOR_ONLY = Case("vector-only", CONFIG, images={}, batch=20_000)  # no image: samples are cheap


def acts(agent: DDPG, case: Case, *, explore: bool, seed: int = 0) -> torch.Tensor:
    return agent.act(case.batch_of(seed).observation, explore=explore, step=0)


def with_mean(mean: float, **config: float) -> DDPG:
    """Make an agent whose actor returns the same action for every observation."""
    agent = replace(VECTOR_ONLY, config=replace(CONFIG, **config)).agent()
    with torch.no_grad():
        agent.networks.actor.layers[-1].weight.zero_()
        agent.networks.actor.layers[-1].bias.fill_(torch.atanh(torch.tensor(mean)))
    return agent


@pytest.mark.parametrize("layer", ["tanh", "simnorm", "attention"])
def test_action_without_noise_equals_the_reference(layer: str) -> None:
    """Acting does not shift images, so the reference uses the crop in the middle."""
    case = replace(WITH_IMAGE, config=replace(CONFIG, fusion_layer=layer))
    agent = double(case.agent())
    weather(agent)
    w, spec = state_of(agent).weights, case.spec
    o = case.batch_of(0, torch.float64).observation
    middle = {key: torch.full((case.batch, 2), spec.pad) for key in case.images}
    r_mm = reference.h(w, "psi_actor", reference.encode(w, o, middle, spec), spec)
    expected = reference.pi(w, r_mm, torch.zeros(case.batch, 6), spec)
    torch.testing.assert_close(
        agent.act(o, explore=False, step=0).clone(), expected, rtol=1e-10, atol=1e-12
    )


def test_noise_is_normal_and_not_clipped() -> None:
    noise = acts(with_mean(0.0), VECTOR_ONLY, explore=True)
    assert noise.shape == (VECTOR_ONLY.batch, 6)
    assert noise.mean().abs() < 0.003
    assert noise.std() == pytest.approx(0.2, rel=0.01)
    assert (noise.abs() > 0.3).float().mean() == pytest.approx(0.1336, abs=0.005)
    assert (noise.abs() > 0.6).float().mean() == pytest.approx(0.0027, abs=0.0008)
    assert torch.corrcoef(noise.T).fill_diagonal_(0).abs().max() < 0.04


def test_noise_has_the_std_of_the_config() -> None:
    assert acts(with_mean(0.0, noise_std=0.1), VECTOR_ONLY, explore=True).std() == pytest.approx(
        0.1, rel=0.02
    )
    assert torch.equal(
        acts(with_mean(0.25, noise_std=0.0), VECTOR_ONLY, explore=True),
        acts(with_mean(0.25, noise_std=0.0), VECTOR_ONLY, explore=False),
    )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_actions_are_clamped(side: float) -> None:
    actions = side * acts(with_mean(0.95 * side), VECTOR_ONLY, explore=True)
    assert actions.max() == 1.0
    assert (actions == 1.0).float().mean() == pytest.approx(0.4013, abs=0.01)  # P(N > 0.05 / 0.2)
    assert actions.min() > 0.0


def test_no_noise_without_exploration() -> None:
    agent = WITH_IMAGE.agent()
    first = acts(agent, WITH_IMAGE, explore=False)
    assert torch.equal(first, acts(agent, WITH_IMAGE, explore=False))
    assert first.abs().max() < 1.0
    assert not torch.equal(first, acts(agent, WITH_IMAGE, explore=True))


def test_seed_determines_the_noise() -> None:
    def actions(seed: int) -> list[torch.Tensor]:
        agent = WITH_IMAGE.agent(seed)
        return [acts(agent, WITH_IMAGE, explore=True, seed=t) for t in range(3)]

    assert all(map(torch.equal, actions(3), actions(3)))
    assert not any(map(torch.equal, actions(3), actions(4)))


def test_evaluation_does_not_change_exploration() -> None:
    agent, twin = WITH_IMAGE.agent(), WITH_IMAGE.agent()
    acts(agent, WITH_IMAGE, explore=False)
    assert torch.equal(acts(agent, WITH_IMAGE, explore=True), acts(twin, WITH_IMAGE, explore=True))


def test_acting_does_not_change_learning() -> None:
    agent, twin = WITH_IMAGE.agent(), WITH_IMAGE.agent()
    acts(agent, WITH_IMAGE, explore=True)
    for each in (agent, twin):
        each.update(WITH_IMAGE.batch_of(0), step=0)
    assert all(map(torch.equal, weights_of(agent).values(), weights_of(twin).values()))


def test_acting_leaves_no_graph_and_no_gradient() -> None:
    agent = WITH_IMAGE.agent()
    assert not acts(agent, WITH_IMAGE, explore=True).requires_grad
    assert all(p.grad is None for p in agent.networks.parameters())


def test_correlated_noise_has_its_std_and_correlation_and_resumes() -> None:
    agent = with_mean(0.0, noise_correlation=0.8)
    first, second = (acts(agent, VECTOR_ONLY, explore=True) for _ in range(2))
    for noise in (first, second):
        assert noise.std() == pytest.approx(0.2, rel=0.01)
    together = torch.stack([first.flatten(), second.flatten()])
    assert torch.corrcoef(together)[0, 1] == pytest.approx(0.8, abs=0.02)
    resumed = with_mean(0.0, noise_correlation=0.8)
    resumed.load_state_dict(agent.state_dict())
    expected, found = (acts(each, VECTOR_ONLY, explore=True) for each in (agent, resumed))
    assert torch.equal(expected, found)


def test_correlation_of_one_is_rejected() -> None:
    with pytest.raises(MerlError, match="noise-correlation must be at least 0 and below 1, not 1"):
        replace(CONFIG, noise_correlation=1.0)
