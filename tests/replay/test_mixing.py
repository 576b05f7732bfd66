"""Batches of which a part comes from demonstrations."""

from __future__ import annotations

import dataclasses
from typing import cast

import numpy as np
import pytest
import torch
from gymnasium import spaces

from merl.core import Agent, Batch, Transition
from merl.experiments.presets import compose
from merl.networks.augmentation import RandomShift, shift
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec
from merl.replay.mixing import INTENDED, MixedReplay
from merl.training.loop import Randomness
from merl.training.updating import make_update

OBSERVATION = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (8, 8, 3), np.uint8),
        "joint": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    }
)
ACTION = spaces.Box(-1.0, 1.0, (1,), np.float32)


def replay_of(value: float, steps: int = 30, intended: float | None = None) -> ReplayBuffer:
    """Return a replay whose actions are all `value`, with random images."""
    space = dict(OBSERVATION.spaces)
    if intended is not None:
        space[INTENDED] = ACTION
    spec = ReplaySpec.of(
        ReplayConfig(batch_size=4, frame_stack=2), spaces.Dict(space), ACTION, capacity=99
    )
    replay, rng = ReplayBuffer(spec), np.random.default_rng(int(100 * value))

    def observe() -> dict[str, np.ndarray]:
        image = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
        found = {"image": image, "joint": np.full(2, value, np.float32)}
        return found if intended is None else found | {INTENDED: np.full(1, intended, np.float32)}

    replay.begin(observe())
    for step in range(steps):
        action = np.full(1, value, np.float32)
        replay.add(Transition(action, value, 1.0, observe(), step == steps - 1))
    return replay


@pytest.mark.parametrize(("ratio", "count"), [(0.5, 8), (0.25, 4), (1.0, 16), (0.001, 1)])
def test_the_first_samples_are_demonstrations(ratio: float, count: int) -> None:
    mixed = MixedReplay(replay_of(0.1), [replay_of(0.7, intended=0.6)], ratio)
    batch = mixed.sample(16, np.random.default_rng(0))
    assert list(batch.observation) == list(batch.next_observation) == ["image", "joint"]
    assert batch.shown is not None
    torch.testing.assert_close(batch.shown, torch.full((count, 1), 0.6))
    expected = torch.full((16, 1), 0.1)
    expected[:count] = 0.7
    torch.testing.assert_close(batch.action, expected)
    torch.testing.assert_close(batch.observation["joint"], expected.expand(16, 2))
    moved = batch.to(torch.device("meta")).shown
    assert moved is not None
    assert moved.is_meta


def test_the_share_of_demonstrations_changes_during_a_run() -> None:
    config = dataclasses.replace(
        compose("smoke", "reach_duplo"),
        demos_ratio=0.75,
        demos_ratio_end=0.25,
        demos_ratio_steps=1000,
    )
    config = dataclasses.replace(config, replay=dataclasses.replace(config.replay, batch_size=16))
    mixed = MixedReplay(replay_of(0.1), [replay_of(0.7, intended=0.7)], config.demos_ratio)
    shown: list[int] = []

    class Counting:
        def update(self, batch: Batch, *, step: int) -> dict[str, torch.Tensor]:
            assert batch.shown is not None
            shown.append(len(batch.shown))
            return {}

    agent, cpu = cast(Agent, Counting()), torch.device("cpu")
    update = make_update(agent, mixed, Randomness(0), config, cpu, print)
    for step in (0, 500, 1000, 5000):
        update(step)
    assert shown == [12, 8, 4, 4]


def test_random_shifts_belong_to_their_samples() -> None:
    own, demos = replay_of(0.1), replay_of(0.7, intended=0.7)
    shifts = torch.randint(0, 5, (10, 2), generator=torch.Generator().manual_seed(0))
    plain = MixedReplay(own, [demos], 0.3).sample(10, np.random.default_rng(3))
    transform = {"image": RandomShift(shifts, 2)}
    shifted = MixedReplay(own, [demos], 0.3).sample(
        10, np.random.default_rng(3), transform, transform
    )
    for before, after in (
        (plain.observation, shifted.observation),
        (plain.next_observation, shifted.next_observation),
    ):
        torch.testing.assert_close(after["image"], shift(before["image"], shifts, 2))


def test_equal_generators_give_equal_batches() -> None:
    mixed = MixedReplay(replay_of(0.1), [replay_of(0.7, intended=0.7)], 0.5)
    first, second = (mixed.sample(8, np.random.default_rng(5)) for _ in range(2))
    torch.testing.assert_close(first.observation, second.observation)
