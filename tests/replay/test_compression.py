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
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec
from merl.replay.backgrounds import STAGES, Backgrounds
from merl.replay.compression import ByteRing, CompressedFrames
from merl.replay.spec import Field

SIDE = 16
NOISE = spaces.Dict({"image": spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)})
ACTIONS = spaces.Box(-1.0, 1.0, (1,), np.float32)


def config(**values: object) -> ReplayConfig:
    return ReplayConfig(**({"capacity": 60, "batch_size": 4, "compress": True} | values))  # type: ignore[arg-type]


def make(directory: Path | None = None, **values: object) -> ReplayBuffer:
    return ReplayBuffer(ReplaySpec.of(config(**values), NOISE, ACTIONS), directory)


def noise(number: int) -> dict[str, np.ndarray]:
    """Return an incompressible image."""
    rng = np.random.default_rng(number)
    return {"image": rng.integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)}


Observe = Callable[[int], dict[str, np.ndarray]]


def play(
    replay: ReplayBuffer, begin: int, steps: int, length: int = 7, observe: Observe = noise
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


def everything(replay: ReplayBuffer) -> Batch:
    return replay.sample(len(replay), Every())  # type: ignore[arg-type]


def assert_right(batch: Batch, newest: int) -> None:
    """Check that the batch has all steps up to the newest, with the correct images."""
    timesteps = (batch.action[:, 0] * 1000).round().int().tolist()
    assert timesteps[-1] == newest
    assert timesteps == [m for m in range(timesteps[0], newest + 1) if m % 7]
    for row, timestep in enumerate(timesteps):
        start = timestep - timestep % 7
        stack = [max(start, timestep - 1 - back) for back in (2, 1, 0)]
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
    specs = [
        ReplaySpec.of(config(capacity=200, compress=c), space, actions)  # type: ignore[arg-type]
        for c in (False, True)
    ]
    raw, packed = (ReplayBuffer(spec, tmp_path / str(spec.config.compress)) for spec in specs)
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
    packed = ReplayBuffer(specs[1], tmp_path / "True")
    assert_same(everything(raw), everything(packed))
    spans = np.fromfile(tmp_path / "True/204/observation.image.span.bin", "<i8").reshape(-1, 2)
    kept = spans[spans[:, 1] > 0, 1]
    assert len(kept) == 126
    assert kept.mean() < 84 * 84 * 3 / 4


def test_million_steps_take_at_most_six_gigabytes() -> None:
    env = merl.make_env("reach_duplo", renderer="raster")
    spaces_ = env.observation_space, env.action_space
    env.close()
    assert ReplaySpec.of(ReplayConfig(compress=True), *spaces_).bytes <= 6e9  # type: ignore[arg-type]
    assert ReplaySpec.of(ReplayConfig(), *spaces_).bytes <= 22e9  # type: ignore[arg-type]


def test_images_above_the_reserved_bytes_cost_steps_and_warn(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    replay = make(tmp_path)
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
    replay = make(capacity=capacity, batch_size=1, frame_stack=frame_stack)
    for timestep in range(200):
        play(replay, timestep, 1)
        if timestep:
            assert 1 <= len(replay) <= capacity
            batch = everything(replay)
            newest = timestep if timestep % 7 else timestep - 1
            assert round(float(batch.action[-1, 0]) * 1000) == newest
            image = noise(newest - 1)["image"]
            np.testing.assert_array_equal(batch.observation["image"][-1, -1], image)


def test_reopened_replay_is_unchanged(tmp_path: Path) -> None:
    replay = make(tmp_path)
    for begin in range(0, 140, 10):
        play(replay, begin, 10)
        before = everything(replay)
        again = make(tmp_path)
        assert_same(everything(again), before)


def test_restoring_the_last_checkpoint_is_exact(tmp_path: Path) -> None:
    replay = make(tmp_path)
    play(replay, 0, 140)
    for begin in range(140, 280, 35):
        replay.flush()
        state, before = replay.state_dict(), everything(replay)
        replay.confirm_checkpoint()
        play(replay, begin, 40)  # overwrites most timesteps; then the process dies
        replay = make(tmp_path)
        replay.load_state_dict(state)
        assert_same(everything(replay), before)
        play(replay, begin, 35)
        assert_right(everything(replay), begin + 34)


def test_half_written_image_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replay = make(tmp_path)
    play(replay, 0, 144)
    write = CompressedFrames.write

    def dies(frames: CompressedFrames, slot: int, begin: int, encoded: bytes) -> None:
        write(frames, slot, begin, encoded[: len(encoded) // 2] + bytes(len(encoded) // 2))
        raise KeyboardInterrupt

    monkeypatch.setattr(CompressedFrames, "write", dies)
    with pytest.raises(KeyboardInterrupt):
        play(replay, 144, 1)
    monkeypatch.undo()
    replay = make(tmp_path)
    assert_right(everything(replay), 143)


@pytest.mark.parametrize("capacity", [62, 90, 300])
@pytest.mark.parametrize("played", [35, 49, 63, 77, 140])
def test_ring_whose_bytes_have_wrapped_grows(tmp_path: Path, capacity: int, played: int) -> None:
    replay = make(tmp_path)
    play(replay, 0, played)
    before, state = everything(replay), replay.state_dict()
    again = make(tmp_path, capacity=capacity)
    again.load_state_dict(state)
    assert_same(everything(again), before)
    for begin in range(played, played + 280, 35):
        play(again, begin, 35)
        assert_right(everything(again), begin + 34)
        again = make(tmp_path, capacity=capacity)
        assert_right(everything(again), begin + 34)
    assert len(again) > len(before.action) * min(capacity / 70, 1.2)


def test_background_is_the_common_part_of_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    still = rng.integers(0, 256, (8, 8, 3)).astype(np.uint8)
    file = tmp_path / "starts"
    frames = CompressedFrames(
        Field(np.dtype("u1"), (8, 8, 3)),
        np.zeros(100_000, np.uint8),
        np.zeros((100, 2), np.int64),
        file,
    )
    ring = ByteRing(frames, 0, 100_000)
    sizes = []
    for number in range(STAGES[-1] + 1):
        image = still.copy()
        row, column = rng.integers(0, 6, 2)
        image[row : row + 2, column : column + 2] = 255
        encoded = frames.encode(image)
        ring.write(number, encoded)
        sizes.append(len(encoded))
        frames.backgrounds.add(image)
        ((decoded,),) = frames.stacks(np.array([[number]]))
        np.testing.assert_array_equal(decoded, image)
    assert sizes[-1] < sizes[0] / 3
    assert file.stat().st_size == STAGES[-1] * still.nbytes


def still_life(timestep: int) -> dict[str, np.ndarray]:
    """Return the image of a noisy wall with a small object at a random position."""
    image = noise(0)["image"]
    row, column = np.random.default_rng(timestep).integers(0, SIDE - 3, 2)
    image[row : row + 3, column : column + 3] = timestep % 256
    return {"image": image}


@pytest.mark.parametrize("killed", [0, 2, 4, 15, 24, 30])
def test_restored_replay_holds_the_same_steps_as_an_uninterrupted_one(
    tmp_path: Path, killed: int
) -> None:
    whole = make(tmp_path / "whole", capacity=40)
    replay = make(tmp_path / "killed", capacity=40)
    play(whole, 0, 7 * killed, observe=still_life)
    play(replay, 0, 7 * killed, observe=still_life)
    replay.flush()
    state = replay.state_dict()
    replay.confirm_checkpoint()
    play(replay, 7 * killed, 7 * 9, observe=still_life)
    replay = make(tmp_path / "killed", capacity=40)
    replay.load_state_dict(state)
    for episode in range(killed, 40):
        play(whole, 7 * episode, 7, observe=still_life)
        play(replay, 7 * episode, 7, observe=still_life)
        assert_same(everything(whole), everything(replay))
    compared = list((tmp_path / "whole").rglob("*.image*"))
    assert len(compared) == 3
    for file in compared:
        other = tmp_path / "killed" / file.relative_to(tmp_path / "whole")
        assert file.read_bytes() == other.read_bytes()


def test_backgrounds_use_only_images_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    field = Field(np.dtype("u1"), (4,))
    backgrounds = Backgrounds(field, tmp_path / "starts")
    images = np.arange(24, dtype=np.uint8).reshape(6, 4)
    backgrounds.add(images[0])
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "full")))
        backgrounds.add(images[1])
    for image in images[2:]:
        backgrounds.add(image)
    again = Backgrounds(field, tmp_path / "starts")
    assert len(again) == len(backgrounds) == 3
    for number in range(3):
        np.testing.assert_array_equal(again[number], backgrounds[number])
    np.testing.assert_array_equal(again[2], np.median(images[[0, 2, 3, 4, 5]], axis=0))


def test_missing_background_is_rejected(tmp_path: Path) -> None:
    replay = make(tmp_path)
    play(replay, 0, 49)
    state = replay.state_dict()
    starts = tmp_path / "observation.image.starts"
    whole = starts.read_bytes()
    starts.write_bytes(whole[:-1])
    again = make(tmp_path)
    with pytest.raises(MerlError, match=r"image\.starts holds 6 of the 7 images"):
        again.load_state_dict(state)
    starts.write_bytes(whole)
    again = make(tmp_path)
    again.load_state_dict(state)
    assert_same(everything(again), everything(replay))
