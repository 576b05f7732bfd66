"""Histogram of a target against SciPy in float64; values and losses of histograms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
import torch

from merl.agents.config import AgentConfig
from merl.agents.sac import SACConfig
from merl.config import override
from merl.core import MerlError
from merl.experiments.presets import compose
from merl.networks.returns import HLGauss
from merl.training.setup import bounded

TARGETS = [-1e6, -5.0, -2.0, -1.999, 0.0, 0.01, 3.3, 7.0, 7.999, 8.0, 8.001, 50.0, 1e6]


def probabilities(y: float, low: float, high: float, bins: int) -> list[float]:
    """Compute each bin's probability of a Gaussian with mean y, one bin after the other."""
    width = (high - low) / (bins - 6)
    y = min(max(y, low), high)
    gaussian = scipy.stats.norm(y, 0.75 * width)
    first = low - 3 * width
    mass = [
        gaussian.cdf(first + (i + 1) * width) - gaussian.cdf(first + i * width) for i in range(bins)
    ]
    return [part / sum(mass) for part in mass]


@pytest.mark.parametrize("bins", [7, 20, 101])
def test_targets_become_gaussians_inside_at_and_beyond_the_bounds(bins: int) -> None:
    returns = HLGauss(-2.0, 8.0, bins)
    expected = np.array([probabilities(y, -2.0, 8.0, bins) for y in TARGETS])
    found = returns.double().histogram(torch.tensor(TARGETS, dtype=torch.float64))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    found = returns.float().histogram(torch.tensor(TARGETS))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.sum(-1), 1.0, rtol=1e-5)


def test_mean_of_a_histogram_is_its_target() -> None:
    returns = HLGauss(0.0, 100.0, 101)
    y = torch.tensor([0.0, 1e-3, 0.4, 12.3, 99.9, 100.0])
    logits = returns.histogram(y).clamp(min=1e-30).log()
    torch.testing.assert_close(returns.value(logits), y, rtol=1e-4, atol=2e-3)
    beyond = returns.histogram(torch.tensor([-7.0, 130.0])).clamp(min=1e-30).log()
    torch.testing.assert_close(returns.value(beyond), torch.tensor([0.0, 100.0]), rtol=0, atol=2e-3)


def test_minimising_the_loss_moves_the_value_to_the_target() -> None:
    returns = HLGauss(0.0, 10.0, 31)
    y = torch.tensor([2.0, 9.0])
    logits = torch.zeros(2, 31, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.1)
    first = returns.loss(logits, y).item()
    for _ in range(300):
        optimizer.zero_grad()
        loss = returns.loss(logits, y)
        loss.backward()
        optimizer.step()
    histogram = returns.histogram(y)
    entropy = -(histogram * histogram.clamp(min=1e-30).log()).sum(-1).mean()
    assert entropy - 1e-5 < loss.item() < entropy + 0.05 < first
    torch.testing.assert_close(returns.value(logits).detach(), y, rtol=0, atol=0.05)


def test_autocast_does_not_round_values() -> None:
    returns = HLGauss(0.0, 100.0, 101)
    logits = torch.randn(8, 101)
    with torch.autocast("cpu", torch.bfloat16):
        value = returns.value(logits)
    assert torch.equal(value, returns.value(logits))


@pytest.mark.parametrize("low", [-50.0, 0.0, 20.0])
def test_initial_values_are_near_zero_or_the_nearer_bound(low: float) -> None:
    returns = HLGauss(low, 100.0, 101)
    bias = torch.zeros(101)
    returns.start_at_zero(bias)
    assert returns.value(bias).item() == pytest.approx(max(low, 0.0), abs=0.1)


def test_discount_sets_the_highest_return() -> None:
    run = compose("smoke", "reach_duplo")
    other = override(run, {"replay.discount": 0.95})
    endless = override(run, {"replay.discount": 1.0})
    histogram = AgentConfig(critic_loss="hl_gauss")
    assert bounded(histogram, other).critic_high == 20.0
    # An action of two steps gets both rewards.
    assert bounded(histogram, override(other, {"action_repeat": 2})).critic_high == 40.0
    assert bounded(AgentConfig(), other).critic_high is None
    chosen = AgentConfig(critic_loss="hl_gauss", critic_high=7.0)
    assert bounded(chosen, endless).critic_high == 7.0
    with pytest.raises(MerlError, match=r"discount 1 returns have .* set --agent.critic-high"):
        bounded(histogram, endless)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"critic_loss": "huber"}, "agent.critic-loss .*huber"),
        ({"critic_bins": 6}, "agent.critic-bins must be at least 7"),
        ({"critic_low": float("nan")}, "agent.critic-low must be finite, not nan"),
        ({"critic_high": float("inf")}, "agent.critic-high must be finite, not inf"),
        ({"critic_low": 3.0, "critic_high": 3.0}, "critic-high must be above .* 3.0, not 3.0"),
        ({"critic_loss": "mse", "critic_bins": 51}, "critic-bins 51 is an option of the hist"),
    ],
)
def test_error_names_the_invalid_value(values: dict[str, object], message: str) -> None:
    with pytest.raises(MerlError, match=message):
        AgentConfig(**{"critic_loss": "hl_gauss", **values})  # type: ignore[arg-type]


def test_sac_rejects_a_histogram() -> None:
    with pytest.raises(MerlError, match="critic-loss hl_gauss needs bounded returns"):
        SACConfig(critic_loss="hl_gauss")
