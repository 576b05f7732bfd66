"""Updates recorded as CUDA graphs, one for each kind of update."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from merl.agents import make_agent
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.core import Batch
from merl.training.updating import Recorded

SPACE = spaces.Dict({"joints": spaces.Box(-1, 1, (5,), np.float32)})


def make(**values: Any) -> DDPG:
    config = MERLConfig(latent_dim=8, hidden_dim=8, precision="fp32", **values)
    actions = spaces.Box(-1, 1, (2,), np.float32)
    device = torch.device("cpu")
    return make_agent(config, SPACE, actions, frame_stack=1, seed=0, device=device, threads=1)


def random_batch() -> Batch:
    rng = torch.Generator().manual_seed(0)
    now, then = ({"joints": torch.rand((4, 5), generator=rng)} for _ in range(2))
    action = torch.rand((4, 2), generator=rng)
    return Batch(now, action, torch.rand(4, generator=rng), torch.full((4,), 0.9), then)


def test_each_kind_of_update_has_its_own_warm_up_and_recording(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fake graph replaces CUDA graphs; replaying it computes nothing."""
    agent, batch, events = make(actor_every=2), random_batch(), []
    recorded = Recorded(agent, lambda: batch)

    class FakeGraph:
        def __init__(self, kind: bool) -> None:
            self.kind = kind

        def replay(self) -> None:
            events.append(("replay", self.kind))

    def record() -> torch.cuda.CUDAGraph:
        kind = agent.actor_is_due
        events.append(("record", kind))
        recorded._values[kind] = recorded._learn()
        return cast(torch.cuda.CUDAGraph, FakeGraph(kind))

    def learn_on_stream() -> Tensor:
        events.append(("warm up", agent.actor_is_due))
        return recorded._learn()

    monkeypatch.setattr(recorded, "_on_gpu", True)
    monkeypatch.setattr(recorded, "_record", record)
    monkeypatch.setattr(recorded, "_learn_on_stream", learn_on_stream)
    metrics = [recorded() for _ in range(10)]
    assert agent.updates == 10
    kinds = [False, True] * 5
    assert [kind for event, kind in events if event != "record"] == kinds
    assert [event for event, _ in events] == ["warm up"] * 6 + ["record", "replay"] * 2 + [
        "replay"
    ] * 2
    assert ["actor_loss" in each for each in metrics] == kinds


def test_recorded_update_sets_the_step_size_before_it_learns() -> None:
    """A replayed graph does not run `learn`, so the step size is set outside of it."""
    agent = make(learning_rate=1e-3, learning_rate_end=1e-4, learning_rate_steps=10)
    batch = random_batch()
    recorded = Recorded(agent, lambda: batch)
    for step, rate in ((0, 1e-3), (5, 5.5e-4), (20, 1e-4)):
        agent.step = step
        recorded()
        for optimizer in (agent.critic_optimizer, agent.actor_optimizer):
            assert optimizer.param_groups[0]["lr"] == pytest.approx(rate)
