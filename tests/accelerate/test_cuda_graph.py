"""Updates recorded as a CUDA graph."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from merl.accelerate.cuda_graph import Recorded
from merl.agents import make_agent
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.core import Batch, UpdatePlan

SPACE = spaces.Dict({"joints": spaces.Box(-1, 1, (5,), np.float32)})


def make(**values: Any) -> DDPG:
    config = MERLConfig(latent_dim=8, hidden_dim=8, precision="fp32", **values)
    actions = spaces.Box(-1, 1, (2,), np.float32)
    device = torch.device("cpu")
    return make_agent(
        "merl", config, SPACE, actions, frame_stack=1, seed=0, device=device, threads=1
    )


def random_batch() -> Batch:
    rng = torch.Generator().manual_seed(0)
    now, then = ({"joints": torch.rand((4, 5), generator=rng)} for _ in range(2))
    action = torch.rand((4, 2), generator=rng)
    return Batch(now, action, torch.rand(4, generator=rng), torch.full((4,), 0.9), then)


def test_an_update_is_recorded_after_a_warm_up_and_then_replayed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fake graph replaces the CUDA graph; replaying it computes nothing."""
    agent, batch, events = make(), random_batch(), []
    recorded = Recorded(agent, lambda: batch)

    class FakeGraph:
        def replay(self) -> None:
            events.append("replay")

    def record(plan: UpdatePlan) -> torch.cuda.CUDAGraph:
        events.append("record")
        recorded._values = recorded._learn_on_device(plan)
        return cast(torch.cuda.CUDAGraph, FakeGraph())

    def learn_on_stream(plan: UpdatePlan) -> Tensor:
        events.append("warm up")
        return recorded._learn_on_device(plan)

    monkeypatch.setattr(recorded, "_on_gpu", True)
    monkeypatch.setattr(recorded, "_record", record)
    monkeypatch.setattr(recorded, "_learn_on_stream", learn_on_stream)
    metrics = [recorded(0) for _ in range(6)]
    assert events == ["warm up"] * 3 + ["record"] + ["replay"] * 3
    assert all({"critic_loss", "actor_loss"} <= each.keys() for each in metrics)


def test_a_graph_reads_noise_and_step_size_from_tensors_that_follow_the_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A replayed graph runs no Python code, so both are set before it is launched."""
    schedule = {"learning_rate": 1e-3, "learning_rate_end": 1e-4, "learning_rate_steps": 10}
    noise = {"noise_std": 1.0, "noise_std_end": 0.5, "noise_steps": 10}
    agent, twin, batch = make(**schedule, **noise), make(**schedule, **noise), random_batch()
    recorded = Recorded(agent, lambda: batch)
    monkeypatch.setattr(recorded, "_on_gpu", True)
    monkeypatch.setattr(recorded, "_learn_on_stream", recorded._learn_on_device)
    for step, rate, deviation in ((0, 1e-3, 1.0), (5, 5.5e-4, 0.75), (20, 1e-4, 0.5)):
        recorded(step)
        twin.update(batch, step=step)
        for optimizer in (agent.critic_optimizer, agent.actor_optimizer):
            assert optimizer.param_groups[0]["lr"] is recorded._plan.step_size
        assert float(recorded._plan.step_size) == pytest.approx(rate)
        assert float(recorded._plan.noise_std) == pytest.approx(deviation)
    for one, other in zip(agent.networks.parameters(), twin.networks.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)
