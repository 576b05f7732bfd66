"""On a real GPU: recorded updates, whether they wait for the host, and whole runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

import merl
from merl.accelerate.cuda_graph import UpdateFromHost
from merl.agents import AGENTS, make_agent
from merl.agents.ddpg import DDPG
from merl.cli import main
from merl.core import Batch

pytestmark = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="this machine has no CUDA device"
)

CAMERA = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (32, 32, 3), np.uint8),
        "proprio": spaces.Box(-np.inf, np.inf, (5,), np.float32),
    }
)
STATE = spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (7,), np.float32)})
ACTIONS, SIZE, SHOWN = 3, 16, 8
CLONING: dict[str, Any] = {"clone_weight": 1.5, "clone_better": True}
TINY: dict[str, Any] = {"preset": "smoke", "device": "cuda", "random_steps": 100, "seed_steps": 100}
TINY |= {"eval.video": "none", "eval.every": 10_000, "eval.episodes": 1, "progress": False}


def make(agent: str, **values: Any) -> DDPG:
    """Make an agent on the GPU."""
    config = replace(AGENTS[agent].config, hidden_dim=32, precision="fp32", **values)
    space = STATE if agent in ("ddpg", "sac") else CAMERA
    actions = spaces.Box(-1, 1, (ACTIONS,), np.float32)
    device = torch.device("cuda")
    made = make_agent(
        agent, config, space, actions, frame_stack=2, seed=0, device=device, threads=1
    )
    assert isinstance(made, DDPG)
    return made


def drawing(agent: DDPG, *, shown: bool) -> Callable[[], Batch]:
    """Return a function that draws random batches on the host, in the same order each time."""
    rng = np.random.default_rng(0)

    def observation() -> dict[str, Tensor]:
        values: dict[str, Tensor] = {}
        for key in agent.senses:
            if key == "image":
                frames = rng.integers(0, 256, (SIZE, 2, 32, 32, 3), dtype=np.uint8)
                values[key] = torch.from_numpy(frames)
            else:
                length = {"proprio": 5, "state": 7}[key]
                values[key] = torch.from_numpy(rng.standard_normal((SIZE, length), np.float32))
        return values

    def actions(count: int) -> Tensor:
        return torch.from_numpy(rng.uniform(-1, 1, (count, ACTIONS)).astype(np.float32))

    def draw() -> Batch:
        reward, discount = torch.from_numpy(rng.random(SIZE, np.float32)), torch.full((SIZE,), 0.97)
        intended = actions(SHOWN) if shown else None
        return Batch(observation(), actions(SIZE), reward, discount, observation(), intended)

    return draw


@contextmanager
def no_waiting() -> Iterator[None]:
    """Raise an error where the host waits for the GPU."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize(
    ("agent", "values"),
    [
        ("merl", {}),
        ("merl", CLONING),
        ("merl", {"actor_average": 0.1, "critic_loss": "hl_gauss"}),
        ("drqv2", {}),
        ("ddpg", {}),
        ("sac", CLONING),
        ("bc", {}),
    ],
)
def test_a_recorded_update_equals_the_update_and_waits_for_nothing(
    agent: str, values: dict[str, Any]
) -> None:
    """The weight of the cloning term fades, so a graph must read it anew for each update."""
    fading = {"clone_steps": 10} if "clone_weight" in values else {}
    one, other = (make(agent, **values, **fading) for _ in range(2))
    shown = agent == "bc" or bool(fading)
    recorded, draw = UpdateFromHost(one, drawing(one, shown=shown)), drawing(other, shown=shown)
    for step in range(8):
        metrics = recorded(step)
        expected = other.update(draw(), step=step)
        for name, value in expected.items():
            torch.testing.assert_close(metrics[name], value.float(), rtol=1e-3, atol=1e-4)
    for mine, theirs in zip(one.networks.parameters(), other.networks.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)
    with no_waiting():
        for step in range(8, 12):
            recorded(step)


def test_a_run_saves_resumes_and_is_evaluated(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert merl.train("reach_duplo", steps=600, run_dir=str(run), **TINY).progress.step == 600
    assert merl.resume(run, steps=900, progress=False).progress.step == 900
    on_cpu = merl.resume(run, steps=1000, device="cpu", progress=False)
    assert on_cpu.progress.step == 1000
    assert len(merl.evaluate(run, episodes=1).episodes) == 1


def test_a_run_learns_from_demonstrations(tmp_path: Path) -> None:
    demos, run = str(tmp_path / "demos"), tmp_path / "run"
    record = ["demos", "record", "reach_duplo", "--preset", "smoke", "--episodes", "2"]
    assert main([*record, "--out", demos]) == 0
    cloning: dict[str, Any] = {
        "demos": demos,
        "agent.clone_weight": 0.5,
        "agent.clone_steps": 400,
    }
    begun = merl.train("reach_duplo", steps=600, run_dir=str(run), **TINY, **cloning)
    assert begun.progress.step == 600
    assert merl.resume(run, steps=800, progress=False).progress.step == 800
