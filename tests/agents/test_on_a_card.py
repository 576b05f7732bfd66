"""An update never makes the host wait for a GPU, and never uses a tensor on another device.

The device `meta` stands for the GPU: its tensors have no values. So reading a value on the host
raises an error, and so does a tensor on another device.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
import torch

from merl.agents import AGENTS, ddpg
from merl.agents.update_noise import UpdateNoise
from merl.bench.update import ACTIONS, learner_of, noise_batch
from merl.networks import critic, encoders

DEVICE = torch.device("meta")


@pytest.fixture(autouse=True)
def _device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace operations that torch does not support on `meta` by those of a CPU."""

    class OnHost(torch.Generator):
        def __new__(cls, device: object = None) -> torch.Generator:  # type: ignore[misc]
            return super().__new__(cls, "cpu")

    monkeypatch.setattr(torch, "Generator", OnHost)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    for module in (encoders, critic):
        monkeypatch.setattr(module, "compute_dtype", lambda weight: weight.dtype)
    monkeypatch.setattr(critic.TwinCritic, "at_once", True)
    monkeypatch.setattr(
        ddpg, "adam", lambda weights, *_, **__: torch.optim.Adam(weights, foreach=True)
    )


def draws(size: int) -> UpdateNoise:
    shifts = {"image": torch.zeros((size, 2), dtype=torch.int64, device=DEVICE)}
    noise = torch.zeros((size, ACTIONS), device=DEVICE)
    return UpdateNoise(shifts, shifts, noise, noise)


@pytest.mark.parametrize(
    ("agent", "values"),
    [
        ("merl", {}),
        ("drqv2", {}),
        ("merl", {"critic_loss": "hl_gauss"}),
        ("merl", {"actor_average": 0.1}),
    ],
)
def test_update_does_not_wait_for_the_device(
    agent: str, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(AGENTS, agent, replace(AGENTS[agent], **values))
    learner = learner_of(agent, "fp32", DEVICE)
    batch = noise_batch(4).to(DEVICE)
    for _ in range(2):
        metrics = learner.learn(batch, draws(4))
    assert {value.device for value in metrics.values()} == {DEVICE}


def test_reading_a_value_or_another_device_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = learner_of("merl", "fp32", DEVICE)
    batch = noise_batch(4).to(DEVICE)
    on_host = replace(batch, reward=torch.zeros(4))
    with pytest.raises(RuntimeError, match="meta"):
        learner.learn(on_host, draws(4))
    step = learner.update_critic
    monkeypatch.setattr(learner, "update_critic", lambda *a: {"q": float(step(*a)["q"])})
    with pytest.raises(RuntimeError, match="meta"):
        learner.learn(batch, draws(4))
