"""An update where tensors have no values: what asked for one would hold up a GPU, and raises here.

`meta` stands for the card: a tensor on another device raises, too, and so does a number that the
host wants to see.
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

CARD = torch.device("meta")


@pytest.fixture(autouse=True)
def _card(monkeypatch: pytest.MonkeyPatch) -> None:
    """What torch refuses to do on `meta` at all is done as on a CPU."""

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
    shifts = {"image": torch.zeros((size, 2), dtype=torch.int64, device=CARD)}
    noise = torch.zeros((size, ACTIONS), device=CARD)
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
def test_an_update_asks_the_host_nothing(
    agent: str, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(AGENTS, agent, replace(AGENTS[agent], **values))
    learner = learner_of(agent, "fp32", CARD)
    batch = noise_batch(4).to(CARD)
    for _ in range(2):
        told = learner.learn(batch, draws(4))
    assert {value.device for value in told.values()} == {CARD}


def test_this_would_see_a_question(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = learner_of("merl", "fp32", CARD)
    batch = noise_batch(4).to(CARD)
    on_host = replace(batch, reward=torch.zeros(4))
    with pytest.raises(RuntimeError, match="meta"):
        learner.learn(on_host, draws(4))
    step = learner.update_critic
    monkeypatch.setattr(learner, "update_critic", lambda *a: {"q": float(step(*a)["q"])})
    with pytest.raises(RuntimeError, match="meta"):
        learner.learn(batch, draws(4))
