"""The copy on the device gives the same samples as the replay; here the device is the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_replay import Account, Episode, Every, make, write

from merl.accelerate.device_replay import CHUNK, DeviceReplay, bytes_on_device
from merl.core import Batch
from merl.replay import EpisodeRing

EPISODES = st.builds(Episode, st.integers(1, 9), st.sampled_from(["end", "limit", "cut"]))


def writing(replay: EpisodeRing, number: int, episodes: list[Episode]) -> Iterator[None]:
    """Write the episodes, one timestep per iteration."""
    account = Account(replay.config)
    for index, plan in enumerate(episodes):
        for t in range(plan.length + 1):
            write(replay, account, 100 * number + index, t, plan)
            yield


def tensors(batch: Batch) -> dict[str, torch.Tensor]:
    observations = {f"o {key}": value for key, value in batch.observation.items()}
    observations |= {f"o' {key}": value for key, value in batch.next_observation.items()}
    rest = {"action": batch.action, "reward": batch.reward, "discount": batch.discount}
    return observations | rest


def check(copy: DeviceReplay, rings: list[EpisodeRing]) -> None:
    """Compare every step of every ring in the copy with the ring itself."""
    for number, ring in enumerate(rings):
        if not len(ring):
            continue
        first, steps, _ = ring.counts()
        found = copy.at(torch.full((steps - first,), number), torch.arange(first, steps))
        expected = tensors(ring.sample(1, Every()))  # type: ignore[arg-type]
        for name, value in tensors(found).items():
            assert torch.equal(value, expected[name]), name


@settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))
@given(st.lists(st.lists(EPISODES, min_size=1, max_size=9), min_size=1, max_size=3), st.data())
def test_copy_gives_the_same_samples_as_the_rings(
    plans: list[list[Episode]], data: st.DataObject
) -> None:
    stack, n_step = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 4))
    rings = [make(frame_stack=stack, n_step=n_step) for _ in plans]
    copy = DeviceReplay(rings, torch.device("cpu"))
    writers = [
        writing(ring, number, plan)
        for number, (ring, plan) in enumerate(zip(rings, plans, strict=True))
    ]
    every = data.draw(st.integers(1, 40))
    timestep = 0
    while writers:
        for writer in list(writers):
            if next(writer, "done") == "done":
                writers.remove(writer)
        timestep += 1
        if timestep % every == 0:
            copy.follow()
            check(copy, rings)
    copy.follow()
    check(copy, rings)


def test_many_new_slots_are_copied_in_chunks() -> None:
    rings = [make(capacity=3 * CHUNK)]
    for _ in writing(rings[0], 0, [Episode(50, "limit")] * 300):
        pass
    copy = DeviceReplay(rings, torch.device("cpu"))
    copy.follow()
    check(copy, rings)
    assert bytes_on_device(rings) > 3 * CHUNK * 36


def test_every_step_of_every_ring_is_drawn_equally_often() -> None:
    rings = [make(capacity=20) for _ in range(2)]
    for number, (ring, lengths) in enumerate(zip(rings, ([7, 40], [5]), strict=True)):
        for _ in writing(ring, number, [Episode(length, "limit") for length in lengths]):
            pass
    copy = DeviceReplay(rings, torch.device("cpu"))
    copy.follow()
    count = 25 * 2000
    batch = copy.sample(count, torch.Generator().manual_seed(0))
    drawn, often = batch.action.unique(dim=0, return_counts=True)
    held = [tuple(row) for ring in rings for row in ring.sample(1, Every()).action.tolist()]  # type: ignore[arg-type]
    assert sorted(map(tuple, drawn.tolist())) == sorted(held)
    assert len(held) == 25
    # A chi-squared with 24 degrees of freedom exceeds 52 with probability 0.001.
    assert ((often - 2000.0) ** 2 / 2000.0).sum() < 52


def test_uninitialised_memory_does_not_reach_a_batch() -> None:
    """The copy's memory on a GPU is not initialised, and may hold NaN."""
    ring = make(capacity=50)
    copy = DeviceReplay([ring], torch.device("cpu"))
    for field in copy._fields.values():
        if field.is_floating_point():
            field.fill_(torch.nan)
    for _ in writing(ring, 0, [Episode(20, "limit"), Episode(9, "cut")]):
        copy.follow()
        check(copy, [ring])


def test_sampling_does_not_wait_for_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """On device `meta`, reading a value or using a tensor on another device raises an error."""
    ring, device, rand = make(capacity=20), torch.device("meta"), torch.rand
    for _ in writing(ring, 0, [Episode(30, "limit")]):
        pass
    copy = DeviceReplay([ring], device)
    copy.follow()
    monkeypatch.setattr(torch, "rand", lambda *a, generator, **k: rand(*a, **k))
    drawn = tensors(copy.sample(5, torch.Generator()))
    expected = tensors(ring.sample(5, np.random.default_rng(0)))
    for name, value in drawn.items():
        assert (value.device, value.dtype) == (device, expected[name].dtype)
        assert value.shape == expected[name].shape


def test_rings_of_different_lengths_after_growth(tmp_path: Path) -> None:
    """One ring has wrapped, the other has not; both are opened with a larger capacity."""
    rings, plans = [], [[Episode(6, "end")] * 5, [Episode(8, "limit")]]
    for number, plan in enumerate(plans):
        ring = make(tmp_path / str(number))
        for _ in writing(ring, number, plan):
            pass
        rings.append(make(tmp_path / str(number), capacity=30))
    lengths = [ring.ring_index.length for ring in rings]
    assert len(set(lengths)) == 2
    copy = DeviceReplay(rings, torch.device("cpu"))
    for episode in range(6):
        copy.follow()
        check(copy, rings)
        for number, ring in enumerate(rings):
            for _ in writing(ring, 10 + 2 * episode + number, [Episode(7, "limit")]):
                pass
