"""The compressed replay equals the raw one byte for byte, in a quarter of the space."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces

import merl
from merl.core import Batch, MerlError, Transition
from merl.replay import EpisodeRing, ReplayConfig, replay_bytes
from merl.replay.backgrounds import STAGES, Backgrounds
from merl.replay.compression import CompressedPictures
from merl.replay.ring_index import RingIndex

SIDE = 16
NOISE = spaces.Dict({"image": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)})
ACTIONS = spaces.Box(-1.0, 1.0, (1,), np.float32)


def config(**values: object) -> ReplayConfig:
    return ReplayConfig(**({"capacity": 60, "batch_size": 4, "compress": True} | values))  # type: ignore[arg-type]


def noise(number: int) -> dict[str, np.ndarray]:
    """Return an incompressible image."""
    rng = np.random.default_rng(number)
    return {"image": rng.integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)}


Observe = Callable[[int], dict[str, np.ndarray]]


def play(
    replay: EpisodeRing, begin: int, steps: int, length: int = 7, observe: Observe = noise
) -> None:
    """Write timesteps `begin`, ...; image and action encode the number of the timestep."""
    for timestep in range(begin, begin + steps):
        if timestep % length == 0:
            replay.begin(observe(timestep))
        else:
            action = np.array([timestep / 1000], np.float32)
            last = timestep % length == length - 1
            replay.add(Transition(action, float(timestep), 1.0, observe(timestep), last))


class Every:
    def integers(self, low: int, high: int, size: int) -> np.ndarray:
        return np.arange(low, high)


def everything(replay: EpisodeRing) -> Batch:
    return replay.sample(len(replay), Every())  # type: ignore[arg-type]


def assert_right(batch: Batch, newest: int) -> None:
    """Check that the batch has all steps up to the newest, with the correct images."""
    timesteps = (batch.action[:, 0] * 1000).round().int().tolist()
    assert timesteps[-1] == newest
    assert timesteps == [m for m in range(timesteps[0], newest + 1) if m % 7]
    for row, timestep in enumerate(timesteps):
        begun = timestep - timestep % 7
        stack = [max(begun, timestep - 1 - back) for back in (2, 1, 0)]
        expected = np.stack([noise(m)["image"] for m in stack])
        np.testing.assert_array_equal(batch.observation["image"][row], expected)


def assert_same(one: Batch, other: Batch) -> None:
    assert torch.equal(one.action, other.action)
    assert torch.equal(one.reward, other.reward)
    for a, b in (
        (one.observation, other.observation),
        (one.next_observation, other.next_observation),
    ):
        assert all(torch.equal(a[key], b[key]) for key in a)


@pytest.mark.parametrize("renderer", ["raster"])
def test_compressed_replay_equals_the_raw_one(tmp_path: Path, renderer: str) -> None:
    env = merl.make_env("move_box", renderer=renderer)
    space, actions = env.observation_space, env.action_space
    raw, packed = (
        EpisodeRing(config(capacity=200, compress=c), space, actions, directory=tmp_path / str(c))
        for c in (False, True)
    )
    for episode in range(6):  # so that the background changes twice
        observation, _ = env.reset(seed=episode)
        for replay in (raw, packed):
            replay.begin(observation)
        for step in range(20):
            action = env.action_space.sample()
            observation, reward, *_ = env.step(action)
            for replay in (raw, packed):
                replay.add(Transition(action, float(reward), 1.0, observation, step == 19))
    env.close()
    assert_same(everything(raw), everything(packed))
    packed = EpisodeRing(config(capacity=200), space, actions, directory=tmp_path / "True")
    assert_same(everything(raw), everything(packed))
    spans = np.fromfile(tmp_path / "True" / "observation.image.span.bin", "<i8").reshape(-1, 2)
    kept = spans[spans[:, 1] > 0, 1]
    assert len(kept) == 126
    assert kept.mean() < 84 * 84 * 3 / 4


def test_million_steps_take_at_most_six_gigabytes() -> None:
    env = merl.make_env("reach_duplo", renderer="raster")
    spaces_ = env.observation_space, env.action_space
    env.close()
    assert replay_bytes(ReplayConfig(compress=True), *spaces_) <= 6e9  # type: ignore[arg-type]
    assert replay_bytes(ReplayConfig(), *spaces_) <= 22e9  # type: ignore[arg-type]


def test_images_above_the_reserved_bytes_cost_steps_and_warn(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    for timestep in range(0, 245, 7):
        play(replay, timestep, 7)
        assert_right(everything(replay), timestep + 6)
    assert 10 < len(replay) < 30
    warning = "images take more bytes than --replay.compress reserves"
    assert caplog.text.count(warning) == 1
    assert "to keep all, start a run with --replay.no-compress" in caplog.text


@pytest.mark.parametrize("capacity", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("frame_stack", [1, 3, 6])
def test_smallest_replay_always_holds_a_step(capacity: int, frame_stack: int) -> None:
    settings = config(capacity=capacity, batch_size=1, frame_stack=frame_stack)
    replay = EpisodeRing(settings, NOISE, ACTIONS)
    for timestep in range(200):
        play(replay, timestep, 1)
        if timestep:
            assert 1 <= len(replay) <= capacity
            batch = everything(replay)
            newest = timestep if timestep % 7 else timestep - 1
            assert round(float(batch.action[-1, 0]) * 1000) == newest
            picture = noise(newest - 1)["image"]
            np.testing.assert_array_equal(batch.observation["image"][-1, -1], picture)


def test_reopened_replay_is_unchanged(tmp_path: Path) -> None:
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    for begin in range(0, 140, 10):
        play(replay, begin, 10)
        before = everything(replay)
        again = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
        assert_same(everything(again), before)


def test_restoring_the_last_checkpoint_is_exact(tmp_path: Path) -> None:
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    play(replay, 0, 140)
    for begin in range(140, 280, 35):
        replay.flush()
        state, before = replay.state_dict(), everything(replay)
        replay.settle()
        play(replay, begin, 40)  # overwrites most timesteps; then the process dies
        replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
        replay.load_state_dict(state)
        assert_same(everything(replay), before)
        play(replay, begin, 35)
        assert_right(everything(replay), begin + 34)


def test_half_written_image_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    play(replay, 0, 144)
    write = CompressedPictures.write

    def dies(pictures: CompressedPictures, slot: int, encoded: bytes) -> None:
        write(pictures, slot, encoded)
        pictures._bytes(slot)[len(encoded) // 2 :] = 0
        raise KeyboardInterrupt

    monkeypatch.setattr(CompressedPictures, "write", dies)
    with pytest.raises(KeyboardInterrupt):
        play(replay, 144, 1)
    monkeypatch.undo()
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    assert_right(everything(replay), 143)


@pytest.mark.parametrize("capacity", [62, 90, 300])
@pytest.mark.parametrize("played", [35, 49, 63, 77, 140])
def test_ring_whose_bytes_have_wrapped_grows(tmp_path: Path, capacity: int, played: int) -> None:
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    play(replay, 0, played)
    before = everything(replay)
    again = EpisodeRing(config(capacity=capacity), NOISE, ACTIONS, directory=tmp_path)
    assert_same(everything(again), before)
    for begin in range(played, played + 280, 35):
        play(again, begin, 35)
        assert_right(everything(again), begin + 34)
        again = EpisodeRing(config(capacity=capacity), NOISE, ACTIONS, directory=tmp_path)
        assert_right(everything(again), begin + 34)
    assert len(again) > len(before.action) * min(capacity / 70, 1.2)


def test_background_is_the_common_part_of_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    still = rng.integers(0, 256, (8, 8, 3)).astype(np.uint8)
    file = tmp_path / "starts"
    pictures = CompressedPictures(
        np.zeros(100_000, np.uint8),
        RingIndex(100_000),
        np.zeros((100, 2), np.int64),
        (8, 8, 3),
        file,
    )
    sizes = []
    for number in range(STAGES[-1] + 1):
        picture = still.copy()
        row, column = rng.integers(0, 6, 2)
        picture[row : row + 2, column : column + 2] = 255
        encoded = pictures.encode(picture)
        pictures.write(number, encoded)
        sizes.append(len(encoded))
        pictures.backgrounds.begun(picture)
        ((decoded,),) = pictures.stacks(np.array([[number]]))
        np.testing.assert_array_equal(decoded, picture)
    assert sizes[-1] < sizes[0] / 3
    assert file.stat().st_size == STAGES[-1] * still.nbytes


def still_life(timestep: int) -> dict[str, np.ndarray]:
    """Return the image of a noisy wall with a small object at a random position."""
    picture = noise(0)["image"]
    row, column = np.random.default_rng(timestep).integers(0, SIDE - 3, 2)
    picture[row : row + 3, column : column + 3] = timestep % 256
    return {"image": picture}


@pytest.mark.parametrize("killed", [0, 2, 4, 15, 24, 30])
def test_restored_replay_holds_the_same_steps_as_an_uninterrupted_one(
    tmp_path: Path, killed: int
) -> None:
    small = config(capacity=40)
    whole = EpisodeRing(small, NOISE, ACTIONS, directory=tmp_path / "whole")
    replay = EpisodeRing(small, NOISE, ACTIONS, directory=tmp_path / "killed")
    play(whole, 0, 7 * killed, observe=still_life)
    play(replay, 0, 7 * killed, observe=still_life)
    replay.flush()
    state = replay.state_dict()
    replay.settle()
    play(replay, 7 * killed, 7 * 9, observe=still_life)
    replay = EpisodeRing(small, NOISE, ACTIONS, directory=tmp_path / "killed")
    replay.load_state_dict(state)
    for episode in range(killed, 40):
        play(whole, 7 * episode, 7, observe=still_life)
        play(replay, 7 * episode, 7, observe=still_life)
        assert_same(everything(whole), everything(replay))
    for file in (tmp_path / "whole").glob("*.image*"):
        assert file.read_bytes() == (tmp_path / "killed" / file.name).read_bytes()


def test_backgrounds_use_only_images_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backgrounds = Backgrounds(4, tmp_path / "starts")
    pictures = np.arange(24, dtype=np.uint8).reshape(6, 4)
    backgrounds.begun(pictures[0])
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "full")))
        backgrounds.begun(pictures[1])
    for picture in pictures[2:]:
        backgrounds.begun(picture)
    again = Backgrounds(4, tmp_path / "starts")
    assert len(again) == len(backgrounds) == 3
    for number in range(3):
        np.testing.assert_array_equal(again[number], backgrounds[number])
    np.testing.assert_array_equal(again[2], np.median(pictures[[0, 2, 3, 4, 5]], axis=0))


def test_missing_background_is_rejected(tmp_path: Path) -> None:
    replay = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    play(replay, 0, 49)
    state = replay.state_dict()
    starts = tmp_path / "observation.image.starts"
    whole = starts.read_bytes()
    starts.write_bytes(whole[:-1])
    again = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    with pytest.raises(MerlError, match=r"image\.starts holds 6 of the 7 images"):
        again.load_state_dict(state)
    starts.write_bytes(whole)
    again = EpisodeRing(config(), NOISE, ACTIONS, directory=tmp_path)
    again.load_state_dict(state)
    assert_same(everything(again), everything(replay))


def test_old_run_keeps_its_stored_backgrounds(tmp_path: Path) -> None:
    former = np.arange(8, dtype=np.uint8)
    former.tofile(tmp_path / "image.background")
    backgrounds = Backgrounds(4, tmp_path / "image.starts")
    backgrounds.begun(np.zeros(4, np.uint8))
    backgrounds.go_back(0)
    assert len(backgrounds) == 3
    np.testing.assert_array_equal(backgrounds[2], former[4:])
