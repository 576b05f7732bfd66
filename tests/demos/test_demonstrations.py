"""Demonstrations are stored without loss, checked when they are read, and fill a replay."""

from __future__ import annotations

import dataclasses
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from merl.acting.rollout import FrameStack
from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.episode import Episode, EpisodeRecording
from merl.demos.recorder import Recorder
from merl.modalities import modalities_of
from merl.replay import ReplayConfig
from merl.replay.mixing import INTENDED

OBSERVATION = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (8, 8, 3), np.uint8),
        "joint": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    }
)
ACTION = spaces.Box(-1.0, 1.0, (3,), np.float32)
CONFIG = ReplayConfig(batch_size=4, n_step=3, frame_stack=2, discount=0.9)


def episode(steps: int, seed: int = 0, terminated: bool = False) -> Episode:
    rng = np.random.default_rng(seed)
    return Episode(
        {
            "image": rng.integers(0, 256, (steps + 1, 8, 8, 3), dtype=np.uint8),
            "joint": rng.normal(size=(steps + 1, 2)).astype(np.float32),
        },
        rng.uniform(-1, 1, (steps, 3)).astype(np.float32),
        rng.uniform(-1, 1, (steps, 3)).astype(np.float32),
        rng.uniform(size=steps).astype(np.float32),
        terminated,
        True,
    )


@pytest.fixture
def demos(tmp_path: Path) -> Demonstrations:
    recorder = Recorder(tmp_path / "demos", "move_box", "expert", OBSERVATION, ACTION)
    for seed, steps in enumerate((7, 1, 5)):
        recorder.add(episode(steps, seed, terminated=seed == 2))
    return recorder.demonstrations


def test_an_episode_that_was_not_entered_in_the_index_is_written_again(tmp_path: Path) -> None:
    """A kill between the two files, at the first correction of a run."""
    (tmp_path / "00000.npz").write_bytes(b"cut")
    spaces_of = (tmp_path, "move_box", "corrections", OBSERVATION, ACTION)
    with pytest.raises(MerlError, match="is not empty"):
        Recorder(*spaces_of)
    for steps in (3, 4):
        Recorder(*spaces_of, append=True).add(episode(steps))
    assert [len(each) for each in Demonstrations.open(tmp_path).episodes()] == [3, 4]


def test_success_is_that_of_the_last_step() -> None:
    """An environment may report its successes alone."""
    step = np.zeros(1, np.float32)
    for infos, success, known in (
        ([{}, {"success": True}], True, False),
        ([{"success": True}, {}], False, False),
        ([{}, {}], None, False),
        ([{"success": True}, {"success": False}], False, True),
    ):
        recording = EpisodeRecording({"joint": step})
        for info in infos:
            recording.add(step, step, {"joint": step}, 0.0, info)
        found = recording.finish(terminated=False)
        assert (found.success, found.successes is not None) == (success, known)


def test_episodes_are_read_as_they_were_written(demos: Demonstrations) -> None:
    opened = Demonstrations.open(demos.path)
    assert opened == demos
    assert opened.steps == 13
    for seed, found in enumerate(opened.episodes()):
        written = episode(len(found), seed)
        np.testing.assert_equal(found.observations, written.observations)
        np.testing.assert_array_equal(found.actions, written.actions)
        np.testing.assert_array_equal(found.intended, written.intended)
        np.testing.assert_array_equal(found.rewards, written.rewards)
    assert [line.returned for line in opened.lines] == pytest.approx(
        [float(one.rewards.sum()) for one in opened.episodes()]
    )


def test_a_replay_holds_every_step(demos: Demonstrations) -> None:
    replay = demos.load(CONFIG, OBSERVATION, ACTION)
    assert len(replay) == demos.steps
    batch = replay.sample(400, np.random.default_rng(0))
    both = torch.cat([batch.action, batch.observation[INTENDED]], dim=1)
    expected = [np.hstack([one.actions, one.intended]) for one in demos.episodes()]
    pairs = {tuple(row) for each in expected for row in each.tolist()}
    assert {tuple(row) for row in both.tolist()} == pairs
    discounts = {round(float(d), 4) for d in batch.discount}
    # 0.9^3, shorter before a time limit, and 0 where the last episode terminated
    assert discounts == {0.729, 0.81, 0.9, 0.0}


def test_values_are_stored_in_the_type_of_their_space(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "demos", "a", "b", OBSERVATION, ACTION)
    one = episode(3)
    wide = {key: value.astype(np.float64) for key, value in one.observations.items()}
    recorder.add(dataclasses.replace(one, observations=wide))
    (found,) = Demonstrations.open(tmp_path / "demos").episodes()
    np.testing.assert_equal(found.observations, one.observations)


def test_keys_that_the_agent_does_not_use_are_left_out(demos: Demonstrations) -> None:
    joint = spaces.Dict({"joint": OBSERVATION["joint"]})
    batch = demos.load(CONFIG, joint, ACTION).sample(2, np.random.default_rng(0))
    assert sorted(batch.observation) == ["intended action", "joint"]


def test_depth_is_stored_as_a_run_stores_its_own(tmp_path: Path) -> None:
    """Both types; the bounds of the run, which may be others, scale it."""
    recorded = {
        "metres": spaces.Box(0.0, 3.0, (8, 8, 1), np.float32),
        "millimetres": spaces.Box(0, 5000, (8, 8, 1), np.uint16),
    }
    rng, one = np.random.default_rng(0), episode(4)
    seen: dict[str, NDArray[Any]] = {
        "metres": rng.uniform(0, 3, (5, 8, 8, 1)).astype(np.float32),
        "millimetres": rng.integers(0, 5001, (5, 8, 8, 1), np.uint16),
    }
    recorder = Recorder(tmp_path / "demos", "a", "b", spaces.Dict(recorded), ACTION)
    recorder.add(dataclasses.replace(one, observations=seen))
    space = spaces.Dict(recorded | {"metres": spaces.Box(0.5, 2.0, (8, 8, 1), np.float32)})
    replay = recorder.demonstrations.load(CONFIG, space, ACTION)
    stack = FrameStack(modalities_of(space), 2, torch.device("cpu"))
    for step in range(5):
        own = stack.push({key: values[step] for key, values in seen.items()})
        at = np.flatnonzero(replay.arrays["timestep"])[step]
        for key, frame in own.items():
            assert frame.dtype == np.int16
            np.testing.assert_array_equal(replay.arrays[f"observation.{key}"][at], frame)


def test_the_digest_changes_with_any_byte(demos: Demonstrations) -> None:
    before = demos.digest()
    assert Demonstrations.open(demos.path).digest() == before
    file = demos.path / "00001.npz"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    assert demos.digest() != before


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"force": spaces.Box(-1, 1, (6,), np.float32)}, "lack observation 'force'"),
        ({"image": spaces.Box(0, 255, (9, 9, 3), np.uint8)}, r"is uint8 \(8, 8, 3\) from 0 to 255"),
        ({"joint": spaces.Box(-1, 1, (3,), np.float32)}, r"float32 \(3,\) in the environment"),
    ],
)
def test_demonstrations_that_do_not_fit_are_refused(
    demos: Demonstrations, space: dict[str, spaces.Box], message: str
) -> None:
    with pytest.raises(MerlError, match=message):
        demos.load(CONFIG, spaces.Dict(space), ACTION)
    with pytest.raises(MerlError, match="3 numbers in the demonstrations and 2 in the"):
        demos.load(CONFIG, OBSERVATION, spaces.Box(-1, 1, (2,), np.float32))


def damage(folder: Path, how: str) -> None:
    file, index = folder / "00001.npz", folder / "demos.json"
    content = json.loads(index.read_text())
    match how:
        case "truncated":
            file.write_bytes(file.read_bytes()[:-200])
        case "missing":
            file.unlink()
        case "not an archive":
            file.write_bytes(b"text")
        case "NaN":
            arrays = dict(np.load(file))
            arrays["reward"][0] = np.nan
            np.savez_compressed(file, **arrays)
        case "length":
            content["episodes"][1]["steps"] = 4
        case "key":
            del content["episodes"][1]["file"]
        case "format":
            content["format"] = 9
        case "return":
            content["episodes"][1]["returned"] = np.inf
        case "size":
            content["observation_space"]["image"]["shape"] = [10**12]
        case "folder outside":
            content["episodes"][1]["file"] = "../../secret.npz"
        case "empty":
            content["episodes"] = []
    index.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("truncated", "00001.npz cannot be read"),
        ("missing", "00001.npz cannot be read"),
        ("not an archive", "00001.npz cannot be read"),
        ("NaN", "00001.npz contains NaN or infinity"),
        ("length", "has . steps, and demos.json says"),
        ("key", "demos.json is damaged"),
        ("return", "demos.json is damaged"),
        ("size", "demos.json is damaged"),
        ("format", "has format 9, and this version reads format 1"),
        ("folder outside", "demos/secret.npz cannot be read"),
        ("empty", "holds no episode"),
    ],
)
def test_damage_is_named_in_one_line(demos: Demonstrations, how: str, message: str) -> None:
    damage(demos.path, how)
    with pytest.raises(MerlError, match=message) as caught:
        Demonstrations.open(demos.path).load(CONFIG, OBSERVATION, ACTION)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["00001.npz", "demos.json"])
def test_any_damaged_byte_is_harmless_or_named_in_one_line(
    demos: Demonstrations, name: str
) -> None:
    file, dice, told = demos.path / name, random.Random(name), list[str]()
    right = file.read_bytes()
    for _ in range(100):
        data = bytearray(right)
        for _ in range(dice.choice([1, 8])):
            data[dice.randrange(len(data))] = dice.choice([0, 255, dice.randrange(256)])
        file.write_bytes(data)
        try:
            list(Demonstrations.open(demos.path).episodes())
        except MerlError as error:
            told.append(str(error))
    assert len(told) > 50
    assert not any("\n" in each for each in told)


def test_folders_that_are_not_demonstrations(tmp_path: Path, demos: Demonstrations) -> None:
    with pytest.raises(MerlError, match="holds no demonstrations"):
        Demonstrations.open(tmp_path)
    with pytest.raises(MerlError, match="is not empty: name another folder"):
        Recorder(demos.path, "a", "b", OBSERVATION, ACTION)
    (tmp_path / "file").touch()
    with pytest.raises(MerlError, match="cannot be created"):
        Recorder(tmp_path / "file", "a", "b", OBSERVATION, ACTION)
