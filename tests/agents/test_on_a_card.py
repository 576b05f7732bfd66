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

from merl.accelerate import joint_heads
from merl.agents import AGENTS, ddpg
from merl.bench.update import ACTIONS, learner_of, noise_batch
from merl.core import UpdateNoise
from merl.networks.encoders import frames

DEVICE = torch.device("meta")


@pytest.fixture(autouse=True)
def _device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace operations that torch does not support on `meta` by those of a CPU."""

    class OnHost(torch.Generator):
        def __new__(cls, device: object = None) -> torch.Generator:  # type: ignore[misc]
            return super().__new__(cls, "cpu")

    monkeypatch.setattr(torch, "Generator", OnHost)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    for module in (frames, joint_heads):
        monkeypatch.setattr(module, "compute_dtype", lambda weight: weight.dtype)
    monkeypatch.setattr(
        ddpg, "adam", lambda weights, *_, **__: torch.optim.Adam(weights, foreach=True)
    )


def draws(size: int) -> UpdateNoise:
    shifts = {"image": torch.zeros((size, 2), dtype=torch.int64, device=DEVICE)}
    noise = torch.zeros((size, ACTIONS), device=DEVICE)
    return UpdateNoise(shifts, shifts, noise, noise)


def on_a_card(agent: str) -> ddpg.DDPG:
    """Make an agent with both heads of the critic at once, as on a GPU."""
    learner = learner_of(agent, "fp32", DEVICE)
    for critic in (learner.networks.critic, learner.critic_target["critic"]):
        joint_heads.join_heads(critic)
    return learner


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
    kind = AGENTS[agent]
    monkeypatch.setitem(AGENTS, agent, replace(kind, config=replace(kind.config, **values)))
    learner = on_a_card(agent)
    batch = noise_batch(4).to(DEVICE)
    for _ in range(2):
        metrics = learner.update(batch, draws(4), step=0)
    assert {value.device for value in metrics.values()} == {DEVICE}


def test_reading_a_value_or_another_device_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = on_a_card("merl")
    batch = noise_batch(4).to(DEVICE)
    on_host = replace(batch, reward=torch.zeros(4))
    with pytest.raises(RuntimeError, match="meta"):
        learner.learn(on_host, draws(4), learner.plan(0))
    step = learner.update_critic
    monkeypatch.setattr(learner, "update_critic", lambda *a: {"q": float(step(*a)["q"])})
    with pytest.raises(RuntimeError, match="meta"):
        learner.update(batch, draws(4), step=0)
