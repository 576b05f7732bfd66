"""The reference of the bench equals merl's update; the speeds are not tested."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator

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
from merl.bench.plain import Plain
from merl.core import Batch, MerlError
from merl.runs.provenance import commit

SIDE, PROPRIO, ACTIONS, BATCH, WIDTH = 24, 7, 4, 6, 16
FEATURES = 32 * 5 * 5


def ours(agent: str, layers: int) -> DDPG:
    config = dataclasses.replace(
        AGENTS[agent].config,
        hidden_dim=WIDTH,
        head_layers=layers,
        precision="fp32",
        noise_std_end=None,
    )
    config = dataclasses.replace(config, noise_std=0.2)
    space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8),
            "proprio": spaces.Box(-np.inf, np.inf, (PROPRIO,), np.float32),
        }
    )
    box = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
    cpu = torch.device("cpu")
    made = make_agent(agent, config, space, box, frame_stack=3, seed=0, device=cpu)
    made.networks.double()
    made.critic_target.double()
    return made


def reference(agent: str, layers: int) -> Plain:
    size = {"layers": layers, "width": WIDTH}
    if agent == "merl":
        plain = Plain(9, SIDE, PROPRIO, ACTIONS, **size)
    else:
        other = {"latent": 50, "head_norm": False, "average_fusion": True}
        plain = Plain(9, SIDE, 0, ACTIONS, **size, **other)
    for part in (plain.encoder, plain.critic, plain.critic_target, plain.actor_fuse, plain.actor):
        part.double()
    return plain


def pairs(mine: DDPG, plain: Plain) -> Iterator[tuple[nn.Parameter, nn.Parameter]]:
    """Yield each parameter of merl's agent with the reference's."""
    networks = mine.networks

    def zipped(one: nn.Module | None, other: nn.Module) -> Iterator[tuple[Tensor, Tensor]]:
        assert one is not None
        yield from zip(one.parameters(), other.parameters(), strict=True)

    def fusions(one: nn.Module | None, other: nn.Module) -> Iterator[tuple[Tensor, Tensor]]:
        assert one is not None
        for index, (linear, norm) in enumerate(
            zip(one.projections.values(), one.norms.values(), strict=True)
        ):
            yield from zipped(linear, other.parts[index][0])
            yield from zipped(norm, other.parts[index][1])

    yield from zipped(networks.encoders.by_key, plain.encoder)
    yield from fusions(networks.critic_fusion, plain.critic.fuse)
    yield from zipped(networks.critic.q1, plain.critic.first)
    yield from zipped(networks.critic.q2, plain.critic.second)
    yield from fusions(networks.actor_fusion, plain.actor_fuse)
    yield from zipped(networks.actor, plain.actor)


def as_plain(value: Tensor, other: Tensor) -> Tensor:
    """Reorder a projection of image features: the reference has channels first, merl last."""
    if value.ndim == 2 and value.shape[1] == FEATURES:
        side = int((FEATURES // 32) ** 0.5)
        value = value.reshape(-1, side, side, 32).permute(0, 3, 1, 2).flatten(1)
    assert value.shape == other.shape
    return value


@pytest.mark.parametrize(("agent", "layers"), [("merl", 6), ("drqv2", 3)])
def test_reference_and_agent_make_the_same_update(agent: str, layers: int) -> None:
    mine, plain = ours(agent, layers), reference(agent, layers)
    with torch.no_grad():
        for one, other in pairs(mine, plain):
            other.copy_(as_plain(one, other))
        plain.critic_target.load_state_dict(plain.critic.state_dict())
    generator = torch.Generator().manual_seed(3)

    def seen() -> dict[str, Tensor]:
        shape = (BATCH, 3, SIDE, SIDE, 3)
        image = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
        proprio = torch.randn((BATCH, PROPRIO), generator=generator, dtype=torch.float64)
        return {"image": image, "proprio": proprio} if agent == "merl" else {"image": image}

    def numbers(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    batch = Batch(seen(), numbers(BATCH, ACTIONS), numbers(BATCH), numbers(BATCH), seen())
    offsets = [torch.randint(0, 9, (BATCH, 2), generator=generator) for _ in range(2)]
    noises = [0.6 * (numbers(BATCH, ACTIONS) - 0.5) for _ in range(2)]
    draws = UpdateNoise({"image": offsets[0]}, {"image": offsets[1]}, noises[1], noises[0])
    joints = agent == "merl"
    if not joints:
        for observation in (batch.observation, batch.next_observation):
            observation["proprio"] = torch.zeros(BATCH, 1, dtype=torch.float64)
    sample = bench.as_sample(batch, vector=joints)
    swapped = [offset.flip(1) for offset in offsets]  # grid_sample counts columns first
    for _ in range(2):
        losses = mine.update(batch, draws, step=0)
        critic_loss, actor_loss = plain.learn(sample, *noises, *swapped)
        torch.testing.assert_close(losses["critic_loss"], critic_loss, rtol=1e-8, atol=0)
        torch.testing.assert_close(losses["actor_loss"], actor_loss, rtol=1e-8, atol=0)
        # In the reference the actor's loss adds to the gradients of the critic's heads, so only
        # their weights are compared.
        heads = {id(p) for q in (plain.critic.first, plain.critic.second) for p in q.parameters()}
        for one, other in pairs(mine, plain):
            if id(other) not in heads:
                assert one.grad is not None
                assert other.grad is not None
                apart = (as_plain(one.grad, other) - other.grad).norm()
                assert apart <= 1e-8 * other.grad.norm()
            assert (as_plain(one, other) - other).norm() <= 1e-8 * other.norm()


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
    for side in (bench.REFERENCE, f"{bench.OURS}, bf16", bench.DRQV2, f"{bench.OUR_DRQV2}, fp32"):
        assert result["updates_per_s"][side]["median"] > 0
        assert side in shown
    assert "two cores" in shown
    result["machine"]["gpu"] = "a GPU"  # it has other targets
    with console.capture() as capture:
        console.print(bench.table(result))
    assert "two cores" not in flat(capture.get())
    assert set(result["ratio"]) == {
        f"{side}, {precision}"
        for side in (bench.OURS, bench.OUR_DRQV2)
        for precision in ("fp32", "bf16")
    }
