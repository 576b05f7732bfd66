"""The copy on the device gives the same samples as the replay; without a GPU it is on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_replay import Account, Episode, Every, config, make, spec_of, write

from merl.accelerate.device_replay import CHUNK, DeviceReplay, bytes_on_device
from merl.core import Batch
from merl.replay import ReplayBuffer

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
EPISODES = st.builds(Episode, st.integers(1, 9), st.sampled_from(["end", "limit", "cut"]))


def writing(replay: ReplayBuffer, number: int, episodes: list[Episode]) -> Iterator[None]:
    """Write the episodes into ring `number`, one timestep per iteration."""
    account = Account(replay.spec.config)
    for index, plan in enumerate(episodes):
        for t in range(plan.length + 1):
            write(replay.rings[number], account, 100 * number + index, t, plan)
            yield


def tensors(batch: Batch) -> dict[str, torch.Tensor]:
    observations = {f"o {key}": value for key, value in batch.observation.items()}
    observations |= {f"o' {key}": value for key, value in batch.next_observation.items()}
    rest = {"action": batch.action, "reward": batch.reward, "discount": batch.discount}
    return observations | rest


class EveryOfOne(Every):
    """Draw each step of one ring once, in order."""

    def __init__(self, ring: int) -> None:
        self.ring = ring

    def multinomial(self, count: int, shares: np.ndarray) -> np.ndarray:
        return count * np.eye(len(shares), dtype=int)[self.ring]


def check(copy: DeviceReplay, replay: ReplayBuffer) -> None:
    """Compare every step of every ring in the copy with the ring itself."""
    for number, ring in enumerate(replay.rings):
        if not len(ring):
            continue
        steps = torch.arange(ring.first, ring.steps, device=DEVICE)
        found = copy.at(torch.full_like(steps, number), steps)
        expected = tensors(replay.sample(1, EveryOfOne(number)))  # type: ignore[arg-type]
        for name, value in tensors(found).items():
            rtol = 1e-6 if name == "reward" else 0  # a GPU may add in another order
            torch.testing.assert_close(value.cpu(), expected[name], rtol=rtol, atol=0, msg=name)


@settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))
@given(st.lists(st.lists(EPISODES, min_size=1, max_size=9), min_size=1, max_size=3), st.data())
def test_copy_gives_the_same_samples_as_the_rings(
    plans: list[list[Episode]], data: st.DataObject
) -> None:
    stack, n_step = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 4))
    small = config(capacity=20 * len(plans), frame_stack=stack, n_step=n_step)
    replay = ReplayBuffer(spec_of(small, rings=len(plans)))
    copy = DeviceReplay(replay, DEVICE)
    writers = [writing(replay, number, plan) for number, plan in enumerate(plans)]
    every = data.draw(st.integers(1, 40))
    timestep = 0
    while writers:
        for writer in list(writers):
            if next(writer, "done") == "done":
                writers.remove(writer)
        timestep += 1
        if timestep % every == 0:
            copy.follow()
            check(copy, replay)
    copy.follow()
    check(copy, replay)


def test_many_new_slots_are_copied_in_chunks() -> None:
    replay = make(capacity=3 * CHUNK)
    for _ in writing(replay, 0, [Episode(50, "limit")] * 300):
        pass
    copy = DeviceReplay(replay, DEVICE)
    copy.follow()
    check(copy, replay)
    assert bytes_on_device(replay) > 3 * CHUNK * 36


def test_every_step_of_every_ring_is_drawn_equally_often() -> None:
    replay = ReplayBuffer(spec_of(config(capacity=40), rings=2))
    for number, lengths in enumerate(([7, 40], [5])):
        for _ in writing(replay, number, [Episode(length, "limit") for length in lengths]):
            pass
    copy = DeviceReplay(replay, DEVICE)
    copy.follow()
    count = 25 * 2000
    batch = copy.sample(count, torch.Generator(DEVICE).manual_seed(0))
    drawn, often = batch.action.unique(dim=0, return_counts=True)
    held = [
        tuple(row)
        for number in range(2)
        for row in replay.sample(1, EveryOfOne(number)).action.tolist()  # type: ignore[arg-type]
    ]
    assert sorted(map(tuple, drawn.tolist())) == sorted(held)
    assert len(held) == 25
    # A chi-squared with 24 degrees of freedom exceeds 52 with probability 0.001.
    assert ((often - 2000.0) ** 2 / 2000.0).sum() < 52


def test_uninitialised_memory_does_not_reach_a_batch() -> None:
    """The copy's memory on a GPU is not initialised, and may hold NaN."""
    replay = make(capacity=50)
    copy = DeviceReplay(replay, DEVICE)
    for field in copy._fields.values():
        if field.is_floating_point():
            field.fill_(torch.nan)
    for _ in writing(replay, 0, [Episode(20, "limit"), Episode(9, "cut")]):
        copy.follow()
        check(copy, replay)


def test_sampling_does_not_wait_for_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """On device `meta`, reading a value or using a tensor on another device raises an error."""
    replay, device, rand = make(capacity=20), torch.device("meta"), torch.rand
    for _ in writing(replay, 0, [Episode(30, "limit")]):
        pass
    copy = DeviceReplay(replay, device)
    copy.follow()
    monkeypatch.setattr(torch, "rand", lambda *a, generator, **k: rand(*a, **k))
    drawn = tensors(copy.sample(5, torch.Generator()))
    expected = tensors(replay.sample(5, np.random.default_rng(0)))
    for name, value in drawn.items():
        assert (value.device, value.dtype) == (device, expected[name].dtype)
        assert value.shape == expected[name].shape


def test_rings_after_growth(tmp_path: Path) -> None:
    """One ring has wrapped, the other has not; then their capacity is larger."""
    spec = spec_of(config(capacity=40), rings=2)
    shorter = ReplayBuffer(spec, tmp_path)
    for number, plan in enumerate([[Episode(6, "end")] * 5, [Episode(8, "limit")]]):
        for _ in writing(shorter, number, plan):
            pass
    replay = ReplayBuffer(replace(spec, capacity=60), tmp_path)
    replay.load_state_dict(shorter.state_dict())
    copy = DeviceReplay(replay, DEVICE)
    for episode in range(6):
        copy.follow()
        check(copy, replay)
        for number in range(2):
            account = Account(spec.config)
            for t in range(8):
                index = 100 * number + 10 + episode
                write(replay.rings[number], account, index, t, Episode(7, "limit"))
