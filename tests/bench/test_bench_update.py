"""The reference of the bench equals merl's update; the speeds are not tested."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from gymnasium import spaces
from rich.console import Console
from torch import Tensor, nn

import merl
from helpers import flat
from merl.agents import AGENTS, make_agent
from merl.agents.ddpg import DDPG, UpdateNoise
from merl.bench import update as bench
from merl.core import Batch, MerlError
from merl.runs.provenance import commit

if TYPE_CHECKING:
    from merl_minimal import MERL

SIDE, PROPRIO, ACTIONS, BATCH, LAYERS, WIDTH = 24, 7, 4, 6, 6, 16
FEATURES = 32 * 5 * 5


def ours() -> DDPG:
    config = dataclasses.replace(
        AGENTS["merl"].config, hidden_dim=WIDTH, head_layers=LAYERS, precision="fp32"
    )
    space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8),
            "proprio": spaces.Box(-np.inf, np.inf, (PROPRIO,), np.float32),
        }
    )
    box = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
    cpu = torch.device("cpu")
    made = make_agent("merl", config, space, box, frame_stack=3, seed=0, device=cpu)
    made.networks.double()
    made.critic_target.double()
    return made


def reference() -> MERL:
    """Return the agent of examples/merl_minimal.py with the paper's step size and shift."""
    example = bench.load_example(PAD=4, ALPHA=1e-4)
    size = (WIDTH,) * (LAYERS - 1)
    return example.MERL((9, SIDE, SIDE), PROPRIO, ACTIONS, bench.STRIDES, size).double()


def pairs(mine: DDPG, other: MERL) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield the name of each part of the reference, a weight of merl's, and the reference's."""
    networks = mine.networks

    def weights(fusion: nn.Module) -> Iterator[Tensor]:
        for layers in zip(fusion.projections.values(), fusion.norms.values(), strict=True):
            for layer in layers:
                yield from layer.parameters()

    for part, theirs in (
        ("f", networks.encoders.parameters()),
        ("h_critic", weights(networks.critic_fusion)),
        ("h_actor", weights(networks.actor_fusion)),
        ("pi", networks.actor.parameters()),
        ("q", networks.critic.parameters()),
        ("q_bar", mine.critic_target.parameters()),
    ):
        for one, two in zip(theirs, getattr(other, part).parameters(), strict=True):
            yield part, one, two


def channels_first(value: Tensor) -> Tensor:
    """Reorder a projection of image features: the reference has channels first, merl last."""
    if value.ndim == 2 and value.shape[1] == FEATURES:
        side = int((FEATURES // 32) ** 0.5)
        value = value.reshape(-1, side, side, 32).permute(0, 3, 1, 2).flatten(1)
    return value


def test_reference_and_agent_make_the_same_update() -> None:
    mine, other = ours(), reference()
    with torch.no_grad():
        for _, one, two in pairs(mine, other):
            two.copy_(channels_first(one))
    generator = torch.Generator().manual_seed(3)

    def seen() -> dict[str, Tensor]:
        shape = (BATCH, 3, SIDE, SIDE, 3)
        image = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
        proprio = torch.randn((BATCH, PROPRIO), generator=generator, dtype=torch.float64)
        return {"image": image, "proprio": proprio}

    def numbers(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    batch = Batch(seen(), numbers(BATCH, ACTIONS), numbers(BATCH), numbers(BATCH), seen())
    shifts = [torch.randint(0, 9, (BATCH, 2), generator=generator) for _ in range(2)]
    noises = [0.6 * (numbers(BATCH, ACTIONS) - 0.5) for _ in range(2)]
    draws = UpdateNoise({"image": shifts[0]}, {"image": shifts[1]}, noises[1], noises[0])
    # grid_sample counts columns first
    given = [(s.flip(1).double(), noise) for s, noise in zip(shifts, noises, strict=True)]
    draws_left = iter(3 * given)
    other.draw = lambda _: next(draws_left)
    for _ in range(3):
        losses = mine.update(batch, draws, step=0)
        critic_loss, actor_loss = other.update(bench.as_sample(batch))
        torch.testing.assert_close(losses["critic_loss"], critic_loss, rtol=1e-8, atol=0)
        torch.testing.assert_close(losses["actor_loss"], actor_loss, rtol=1e-8, atol=0)
        for part, one, two in pairs(mine, other):
            # In the reference the actor's loss adds to the gradients of q, so only its weights are
            # compared; q_bar has no gradients.
            if part not in ("q", "q_bar"):
                assert one.grad is not None
                assert two.grad is not None
                apart = (channels_first(one.grad) - two.grad).norm()
                assert apart <= 1e-8 * two.grad.norm()
            assert (channels_first(one) - two).norm() <= 1e-8 * two.norm()


def test_every_variant_is_timed_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise MerlError('not installed: pip install "merl-rl[bench]"')

    monkeypatch.setattr(bench, "_stable_baselines", missing)
    result = bench.run(repeats=1, batch_size=2)
    assert json.loads(json.dumps(result)) == result
    assert result["merl"] == merl.__version__
    assert result["commit"] == commit()
    assert {"torch", "lz4", "stable-baselines3"} <= result["versions"].keys()
    console = Console(width=200, markup=False)
    with console.capture() as capture:
        console.print(bench.table(result))
    shown = flat(capture.get())
    assert 'not installed: pip install "merl-rl[bench]"' in shown
    for side in (bench.REFERENCE, f"{bench.OURS}, fp32", f"{bench.OURS}, bf16"):
        assert result["updates_per_s"][side]["median"] > 0
        assert side in shown
    assert "two cores" in shown
    result["machine"]["gpu"] = "a GPU"  # it has other targets
    with console.capture() as capture:
        console.print(bench.table(result))
    assert "two cores" not in flat(capture.get())
    assert set(result["ratio"]) == {f"{bench.OURS}, fp32", f"{bench.OURS}, bf16"}
