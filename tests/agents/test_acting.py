"""a_t = pi(o_t) + epsilon: the noise of exploration, its bounds and its seed."""

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
SEES = Case("sees", CONFIG)
FEELS = Case("feels", CONFIG, images={}, batch=20_000)  # no image: many samples cost little


def acts(agent: DDPG, case: Case, *, explore: bool, seed: int = 0) -> torch.Tensor:
    return agent.act(case.batch_of(seed).observation, explore=explore)


def with_mean(mean: float, **config: float) -> DDPG:
    """An agent whose actor gives one action, whatever it feels."""
    agent = replace(FEELS, config=replace(CONFIG, **config)).agent()
    with torch.no_grad():
        agent.networks.actor.layers[-1].weight.zero_()
        agent.networks.actor.layers[-1].bias.fill_(torch.atanh(torch.tensor(mean)))
    return agent


@pytest.mark.parametrize("squash", ["tanh", "simnorm"])
def test_the_mean_is_the_papers(squash: str) -> None:
    """Whole pictures, no noise: what the reference's pi gives at the crop in the middle."""
    case = replace(SEES, config=replace(CONFIG, squash=squash))
    agent = double(case.agent())
    weather(agent)
    w, spec = state_of(agent).weights, case.spec
    o = case.batch_of(0, torch.float64).observation
    middle = {key: torch.full((case.batch, 2), spec.pad) for key in case.images}
    r_mm = reference.h(w, "psi_actor", reference.encode(w, o, middle, spec), spec)
    expected = reference.pi(w, r_mm, torch.zeros(case.batch, 6), spec)
    torch.testing.assert_close(
        agent.act(o, explore=False).clone(), expected, rtol=1e-10, atol=1e-12
    )


def test_the_noise_is_normal_and_not_clipped() -> None:
    noise = acts(with_mean(0.0), FEELS, explore=True)
    assert noise.shape == (FEELS.batch, 6)
    assert noise.mean().abs() < 0.003
    assert noise.std() == pytest.approx(0.2, rel=0.01)
    assert (noise.abs() > 0.3).float().mean() == pytest.approx(0.1336, abs=0.005)
    assert (noise.abs() > 0.6).float().mean() == pytest.approx(0.0027, abs=0.0008)
    assert torch.corrcoef(noise.T).fill_diagonal_(0).abs().max() < 0.04


def test_the_noise_has_the_std_of_the_config() -> None:
    assert acts(with_mean(0.0, noise_std=0.1), FEELS, explore=True).std() == pytest.approx(
        0.1, rel=0.02
    )
    assert torch.equal(
        acts(with_mean(0.25, noise_std=0.0), FEELS, explore=True),
        acts(with_mean(0.25, noise_std=0.0), FEELS, explore=False),
    )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_actions_are_clamped(side: float) -> None:
    actions = side * acts(with_mean(0.95 * side), FEELS, explore=True)
    assert actions.max() == 1.0
    assert (actions == 1.0).float().mean() == pytest.approx(0.4013, abs=0.01)  # P(N > 0.05 / 0.2)
    assert actions.min() > 0.0


def test_without_exploring_there_is_no_noise() -> None:
    agent = SEES.agent()
    first = acts(agent, SEES, explore=False)
    assert torch.equal(first, acts(agent, SEES, explore=False))
    assert first.abs().max() < 1.0
    assert not torch.equal(first, acts(agent, SEES, explore=True))


def test_the_seed_fixes_the_noise() -> None:
    def walk(seed: int) -> list[torch.Tensor]:
        agent = SEES.agent(seed)
        return [acts(agent, SEES, explore=True, seed=t) for t in range(3)]

    assert all(map(torch.equal, walk(3), walk(3)))
    assert not any(map(torch.equal, walk(3), walk(4)))


def test_evaluating_does_not_disturb_exploring() -> None:
    agent, twin = SEES.agent(), SEES.agent()
    acts(agent, SEES, explore=False)
    assert torch.equal(acts(agent, SEES, explore=True), acts(twin, SEES, explore=True))


def test_acting_does_not_disturb_learning() -> None:
    agent, twin = SEES.agent(), SEES.agent()
    acts(agent, SEES, explore=True)
    for each in (agent, twin):
        each.update(SEES.batch_of(0))
    assert all(map(torch.equal, weights_of(agent).values(), weights_of(twin).values()))


def test_acting_leaves_no_graph_and_no_gradient() -> None:
    agent = SEES.agent()
    assert not acts(agent, SEES, explore=True).requires_grad
    assert all(p.grad is None for p in agent.networks.parameters())


def test_correlated_noise_has_its_std_and_correlation_and_goes_on_after_a_save() -> None:
    agent = with_mean(0.0, noise_correlation=0.8)
    first, second = (acts(agent, FEELS, explore=True) for _ in range(2))
    for noise in (first, second):
        assert noise.std() == pytest.approx(0.2, rel=0.01)
    together = torch.stack([first.flatten(), second.flatten()])
    assert torch.corrcoef(together)[0, 1] == pytest.approx(0.8, abs=0.02)
    resumed = with_mean(0.0, noise_correlation=0.8)
    resumed.load_state_dict(agent.state_dict())
    expected, found = (acts(each, FEELS, explore=True) for each in (agent, resumed))
    assert torch.equal(expected, found)


def test_a_correlation_of_one_is_refused() -> None:
    with pytest.raises(MerlError, match=r"agent.noise-correlation must lie in \[0, 1\), not 1"):
        replace(CONFIG, noise_correlation=1.0)
