"""A damaged replay: the damage is found by its block, and only its episodes are left out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_compression import everything, make, noise, play

from merl.core import MerlError
from merl.replay import ReplayBuffer
from merl.replay.damage import find_damage

STEPS = 7
"""Steps of an episode."""


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("merl.replay.checksums.BLOCK", 10)
    monkeypatch.setattr("merl.replay.damage.BLOCK", 10)


def saved(replay: ReplayBuffer) -> dict[str, Any]:
    """Return the state as a checkpoint of it has it."""
    replay.flush()
    state = replay.state_dict() | replay.checksums()
    replay.confirm_checkpoint()
    return json.loads(json.dumps(state))


def flip(file: Path, at: int) -> None:
    data = bytearray(file.read_bytes())
    data[at] ^= 64
    file.write_bytes(data)


def timesteps_of(replay: ReplayBuffer, newest: int) -> list[int]:
    """Return the timesteps (from 0) at which the steps end; check all steps up to `newest`."""
    batch = everything(replay)
    timesteps = (batch.action[:, 0] * 1000).round().int().tolist()
    for row, timestep in enumerate(timesteps):
        start = timestep - timestep % STEPS
        end = min(start + STEPS - 1, newest)
        for observation, last in (
            (batch.observation, timestep - 1),
            (batch.next_observation, min(timestep + 2, end)),
        ):
            stack = [max(start, last - back) for back in (2, 1, 0)]
            expected = np.stack([noise(m)["image"] for m in stack])
            np.testing.assert_array_equal(observation["image"][row], expected)
    return timesteps


@pytest.mark.parametrize("length", [40, 130], ids=["filling", "wrapped"])
@pytest.mark.parametrize(
    ("name", "compress"),
    [(name, False) for name in ("observation.image", "action", "reward", "position", "timestep")]
    + [(name, True) for name in ("observation.image", "observation.image.span", "position")],
)
def test_only_episodes_with_damage_are_left_out(
    tmp_path: Path, name: str, compress: bool, length: int, caplog: pytest.LogCaptureFixture
) -> None:
    replay = make(tmp_path, compress=compress)
    play(replay, 0, length)
    state, whole = saved(replay), timesteps_of(replay, length - 1)
    play(replay, length, 9)  # overwrites timesteps, which the journal restores
    arrays = replay.arrays
    damaged = whole[len(whole) // 2]  # in the middle of what is held
    row = damaged % replay.slots
    at = row * arrays[name][0].nbytes
    if compress and name == "observation.image":
        at = int(arrays["observation.image.span"][row, 0]) + 5
    del replay, arrays
    flip(tmp_path / str(make(tmp_path, compress=compress).slots) / f"{name}.bin", at)

    found = find_damage(tmp_path, make(tmp_path, compress=compress).spec, state)
    assert [(each.field, each.first <= damaged + 1 <= each.last) for each in found] == [
        (name, True)
    ]
    replay = make(tmp_path, compress=compress)
    with pytest.raises(MerlError, match=rf"{name}\.bin is damaged in block {damaged // 10} "):
        replay.load_state_dict(state)
    replay.load_state_dict(state, skip_damaged=True)
    assert "left out of the replay" in caplog.text
    kept = timesteps_of(replay, length - 1)
    bad = {t // STEPS for t in range(found[0].first - 1, found[0].last)}
    allowed = {min(bad) - 1, max(bad) + 1} if name == "position" else set()
    lost = {t // STEPS for t in set(whole) - set(kept)}
    assert set(kept) <= set(whole)
    assert bad & {t // STEPS for t in whole} <= lost <= bad | allowed

    again = saved(replay)
    assert find_damage(tmp_path, replay.spec, again) == []
    begin = length + -length % STEPS
    play(replay, begin, 203)
    del replay
    replay = make(tmp_path, compress=compress)
    assert len(timesteps_of(replay, begin + 202)) > 10


@pytest.mark.parametrize("compress", [False, True])
def test_the_checkpoint_before_the_last_is_restored_exactly(tmp_path: Path, compress: bool) -> None:
    replay = make(tmp_path, compress=compress)
    play(replay, 0, 140)
    former, expected = saved(replay), timesteps_of(replay, 139)
    play(replay, 140, 28)
    last = saved(replay)
    play(replay, 168, 21)
    del replay
    for state, right in ((last, None), (former, expected)):
        replay = make(tmp_path, compress=compress)
        assert find_damage(tmp_path, replay.spec, state) == []
        replay.load_state_dict(state)
        assert right is None or timesteps_of(replay, 139) == right
        play(replay, replay.rings[0].timesteps, 7)
        del replay


@pytest.mark.parametrize("compress", [False, True])
def test_a_replay_that_grew_is_not_damaged(tmp_path: Path, compress: bool) -> None:
    """The run dies after the growth, which lays compressed frames out anew, before it saves."""
    replay = make(tmp_path, compress=compress)
    play(replay, 0, 140)
    state, expected = saved(replay), timesteps_of(replay, 139)
    for capacity in (100, 200):
        replay = make(tmp_path, compress=compress, capacity=capacity)
        assert find_damage(tmp_path, replay.spec, state) == []
        replay.load_state_dict(state)
        assert timesteps_of(replay, 139) == expected
    play(replay, 140, 28)
    assert find_damage(tmp_path, replay.spec, saved(replay)) == []


def test_an_episode_in_progress_that_is_left_out_does_not_go_on(tmp_path: Path) -> None:
    """Its next step would begin with a damaged observation."""
    replay = make(tmp_path, compress=False)
    play(replay, 0, 40)
    state, slots = saved(replay), replay.slots
    assert state["open"]
    at = 39 * replay.arrays["reward"][0].nbytes
    del replay
    flip(tmp_path / str(slots) / "reward.bin", at)
    replay = make(tmp_path, compress=False)
    replay.load_state_dict(state, skip_damaged=True)
    assert not replay.state_dict()["open"]


def test_spans_that_do_not_fit_their_file_are_damage(tmp_path: Path) -> None:
    replay = make(tmp_path)
    play(replay, 0, 40)
    state = saved(replay)
    for value in (-1, 2**40, 2**62):
        replay.arrays["observation.image.span"][38, 1] = value
        found = find_damage(tmp_path, replay.spec, state)
        assert [each.field for each in found] == ["observation.image.span"]


def test_a_replay_without_checksums_loads_as_before(tmp_path: Path) -> None:
    replay = make(tmp_path)
    play(replay, 0, 40)
    state = replay.state_dict()
    replay.confirm_checkpoint()
    file = tmp_path / str(replay.slots) / "reward.bin"
    del replay
    flip(file, 30)
    replay = make(tmp_path)
    replay.load_state_dict(state)
    assert len(replay)
