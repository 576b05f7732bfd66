"""Demonstrations come back from the formats of other projects as they were, or are refused."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from gymnasium import spaces
from pyarrow import parquet

from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.episode import Episode
from merl.demos.exporting import Format, export_demos
from merl.demos.importing import Rules, Target, import_demos, open_source
from merl.demos.recorder import Recorder
from merl.demos.source import at_each_step

OBSERVATION = spaces.Dict(
    {
        "depth": spaces.Box(0, 2, (6, 8, 1), np.float32),
        "force": spaces.Box(-9, 9, (4, 3), np.float32),
        "image": spaces.Box(0, 255, (16, 24, 3), np.uint8),
        "joint": spaces.Box(-np.inf, np.inf, (1,), np.float32),
    }
)
ACTION = spaces.Box(-1.0, 1.0, (3,), np.float32)
TARGET = Target("move_box", OBSERVATION, ACTION, None, 25.0)
LENGTHS = (7, 1, 5)
FORMATS: list[Format] = ["lerobot", "robomimic", "minari"]


def episode(steps: int, seed: int) -> Episode:
    """Return an episode with smooth images, which a video keeps almost as they are."""
    rng = np.random.default_rng(seed)
    solved = np.arange(steps) % 3 == 0  # also in the middle, and in the last of 7 steps
    if seed == 2:
        solved = np.arange(steps) == steps - 1
    ramp = np.linspace(0, 150, 24) + 3 * rng.integers(0, 10)
    image = np.broadcast_to(ramp[None, None, :, None], (steps + 1, 16, 24, 3)).astype(np.uint8)
    return Episode(
        {
            "depth": rng.uniform(0, 2, (steps + 1, 6, 8, 1)).astype(np.float32),
            "force": rng.uniform(-9, 9, (steps + 1, 4, 3)).astype(np.float32),
            "image": image + 8 * np.arange(steps + 1, dtype=np.uint8)[:, None, None, None],
            "joint": rng.normal(size=(steps + 1, 1)).astype(np.float32),
        },
        rng.uniform(-1, 1, (steps, 3)).astype(np.float32),
        rng.uniform(-1, 1, (steps, 3)).astype(np.float32),
        rng.uniform(size=steps).astype(np.float32),
        seed == 2,
        seed != 1,
        solved & (seed != 1),
    )


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    path = tmp_path_factory.mktemp("demos") / "demos"
    recorder = Recorder(path, "move_box", "expert", OBSERVATION, ACTION)
    for seed, steps in enumerate(LENGTHS):
        recorder.add(episode(steps, seed))
    return recorder.demonstrations


@pytest.fixture(scope="module")
def exported(demos: Demonstrations, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the demonstrations in each format; LeRobot's with images without loss."""
    folder = tmp_path_factory.mktemp("exported")
    for form in FORMATS:
        export_demos(demos, form, folder / form, 25.0, lossless=True)
    return {form: folder / form for form in FORMATS}


@pytest.fixture
def lerobot(exported: dict[str, Path], tmp_path: Path) -> Path:
    """Return a copy that a test may damage."""
    return Path(shutil.copytree(exported["lerobot"], tmp_path / "lerobot"))


def refused(source: Path, out: Path, target: Target = TARGET, rules: Rules | None = None) -> str:
    """Return the error of an import, which leaves nothing behind."""
    before = sorted(out.parent.iterdir())
    with pytest.raises(MerlError) as error:
        import_demos(open_source(source), out, target, rules or Rules())
    assert sorted(out.parent.iterdir()) == before
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("form", FORMATS)
def test_a_round_trip_changes_nothing(form: str, exported: dict[str, Path], tmp_path: Path) -> None:
    found = import_demos(open_source(exported[form]), tmp_path / "back", TARGET, Rules())
    assert [line.success for line in found.lines] == [True, False, True]
    for seed, (steps, back) in enumerate(zip(LENGTHS, found.episodes(), strict=True)):
        was = episode(steps, seed)
        for key, value in was.observations.items():
            given = value
            if form == "lerobot":  # which has no observation after the last action
                given = np.concatenate([value[:-1], value[-2:-1]])
            np.testing.assert_array_equal(back.observations[key], given)
        np.testing.assert_array_equal(back.actions, was.actions)
        np.testing.assert_array_equal(back.intended, was.intended)
        np.testing.assert_array_equal(back.rewards, was.rewards)
        np.testing.assert_array_equal(back.successes, was.successes)
        assert back.terminated == was.terminated


def test_a_flag_at_the_last_step_alone_tells_only_the_end() -> None:
    last = np.array([False, False, True])
    assert at_each_step(last, terminated=False) is None
    for known, terminated in ((last, True), (~last, False), (last[2:], False), (last[:2], False)):
        np.testing.assert_array_equal(at_each_step(known, terminated=terminated), known)


def test_videos_keep_every_frame_in_its_place(demos: Demonstrations, tmp_path: Path) -> None:
    export_demos(demos, "lerobot", tmp_path / "videos", 25.0)
    source = open_source(tmp_path / "videos")
    assert source.features["observation.images.image"].lossy
    found = import_demos(source, tmp_path / "back", TARGET, Rules())
    for seed, (steps, back) in enumerate(zip(LENGTHS, found.episodes(), strict=True)):
        was = episode(steps, seed).observations["image"][:steps].astype(float)
        now = back.observations["image"][:steps]
        # Consecutive frames differ by 8.
        assert abs((now - was).mean(axis=(1, 2, 3))).max() < 2


def test_a_cut_video_is_named(demos: Demonstrations, tmp_path: Path) -> None:
    export_demos(demos, "lerobot", tmp_path / "videos", 25.0)
    (video,) = tmp_path.rglob("*.mp4")
    whole = video.read_bytes()
    for size in (0, 40, len(whole) // 2):
        video.write_bytes(whole[:size])
        assert str(video) in refused(tmp_path / "videos", tmp_path / "back")


def test_keys_are_mapped_by_name_or_by_hand(exported: dict[str, Path], tmp_path: Path) -> None:
    target = replace(TARGET, observation_space=spaces.Dict({"arm": OBSERVATION["joint"]}))
    message = refused(exported["lerobot"], tmp_path / "a", target)
    assert "has no feature 'arm' for observation 'arm'" in message
    assert "--keys arm=FEATURE" in message
    rules = Rules(keys={"arm": "observation.joint"})
    found = import_demos(open_source(exported["lerobot"]), tmp_path / "b", target, rules)
    assert next(found.episodes()).observations["arm"].shape == (8, 1)
    message = refused(exported["lerobot"], tmp_path / "c", target, Rules(keys={"hand": "x"}))
    assert "--keys names 'hand'" in message


def test_actions_in_own_units_are_scaled(
    exported: dict[str, Path], demos: Demonstrations, tmp_path: Path
) -> None:
    own = replace(TARGET, bounds=([-2.0, -1.0, 0.0], [2.0, 1.0, 4.0]))
    source = exported["robomimic"]
    message = refused(source, tmp_path / "a", own, Rules(actions="env"))
    assert "not in the environment's own units: use --actions unit" in message
    rules = Rules(actions="env", clip=True)
    found = import_demos(open_source(source), tmp_path / "b", own, rules)
    was, now = (next(each.episodes()).actions for each in (demos, found))
    np.testing.assert_allclose(now[:, 0], was[:, 0] / 2, atol=1e-6)
    np.testing.assert_allclose(now[:, 1], was[:, 1], atol=1e-6)
    np.testing.assert_allclose(now[:, 2], np.clip(was[:, 2] / 2 - 1, -1, 1), atol=1e-6)


def test_images_are_resized_if_asked(exported: dict[str, Path], tmp_path: Path) -> None:
    small = spaces.Dict({"image": spaces.Box(0, 255, (8, 12, 3), np.uint8)})
    target = replace(TARGET, observation_space=small)
    assert "resize its images with --resize" in refused(exported["minari"], tmp_path / "a", target)
    source = open_source(exported["minari"])
    found = import_demos(source, tmp_path / "b", target, Rules(resize=True))
    image = episode(7, 0).observations["image"].astype(float)
    means = image.reshape(8, 8, 2, 12, 2, 3).mean(axis=(2, 4))
    assert abs(next(found.episodes()).observations["image"] - means).max() <= 0.5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: replace(t, rate=10.0), "25 steps per second, and move_box has 10"),
        (
            lambda t: replace(t, action_space=spaces.Box(-1, 1, (2,), np.float32)),
            "an action has 3 numbers, and move_box takes 2",
        ),
        (
            lambda t: replace(
                t, observation_space=spaces.Dict({"force": spaces.Box(-9, 9, (4, 2), np.float32)})
            ),
            "feature 'observation.force' is float32 (4, 3), and observation 'force' is float32",
        ),
        (
            lambda t: replace(
                t, observation_space=spaces.Dict({"force": spaces.Box(-1, 1, (4, 3), np.float32)})
            ),
            "outside of the observation's bounds, [-1, 1]: its unit differs",
        ),
    ],
)
def test_what_does_not_fit_is_refused(
    change: Callable[[Target], Target], words: str, exported: dict[str, Path], tmp_path: Path
) -> None:
    assert words in refused(exported["lerobot"], tmp_path / "out", change(TARGET))


def _info(path: Path, **changes: Any) -> None:
    file = path / "meta" / "info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _table(path: Path, change: Callable[[Any], Any]) -> None:
    (file,) = path.glob("data/*/*.parquet")
    table = parquet.read_table(file)
    parquet.write_table(change(table), file)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda p: _info(p, codebase_version="v2.1"), "has version 'v2.1', and merl reads v3.0"),
        (lambda p: _info(p, codebase_version=3), "has version 3"),
        (lambda p: _info(p, features={}), "is damaged: KeyError('action')"),
        (lambda p: _info(p, fps="fast"), "is damaged"),
        (lambda p: _info(p, data_path="../x.parquet"), "which is outside of the folder"),
        (lambda p: _info(p, data_path="{nothing}"), "the index of episode 0 is damaged"),
        (lambda p: (p / "meta/info.json").write_text("["), "cannot be read"),
        (lambda p: shutil.rmtree(p / "meta" / "episodes"), "holds no episode"),
        (lambda p: shutil.rmtree(p / "data"), "is missing: copy the dataset again"),
        (
            lambda p: next(p.glob("data/*/*")).write_bytes(b"PAR1 cut"),
            "file-000.parquet cannot be read",
        ),
        (lambda p: _pipe(next(p.glob("data/*/*"))), "it is a pipe, not a file"),
        (lambda p: _table(p, lambda t: t.slice(0, 9)), "and its index says 5"),
        (lambda p: _table(p, lambda t: t.drop(["action"])), "lacks column 'action'"),
    ],
)
def test_a_damaged_dataset_is_named(
    damage: Callable[[Path], Any], words: str, lerobot: Path, tmp_path: Path
) -> None:
    damage(lerobot)
    assert words in refused(lerobot, tmp_path / "out")


def test_nan_is_refused(exported: dict[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "nan.hdf5"
    shutil.copy(exported["robomimic"], file)
    with h5py.File(file, "r+") as opened:
        opened["data/demo_2/obs/joint"][0] = np.nan
    assert "demo_2 contains NaN or infinity" in refused(file, tmp_path / "out")


def test_other_files_are_refused(exported: dict[str, Path], tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "none", tmp_path / "out")
    (tmp_path / "folder").mkdir()
    assert "is neither a LeRobotDataset v3" in refused(tmp_path / "folder", tmp_path / "out")
    (tmp_path / "text").write_text("text")
    assert "cannot be read" in refused(tmp_path / "text", tmp_path / "out")
    with h5py.File(tmp_path / "empty.hdf5", "w") as opened:
        opened["x"] = 1
    assert "it has no /data" in refused(tmp_path / "empty.hdf5", tmp_path / "out")
    data = Path(shutil.copytree(exported["minari"], tmp_path / "minari")) / "data"
    (data / "metadata.json").write_text("{}")
    assert "cannot be read" in refused(tmp_path / "minari", tmp_path / "out")


def test_without_rewards_success_is_the_reward(exported: dict[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "bare.hdf5"
    shutil.copy(exported["robomimic"], file)
    with h5py.File(file, "r+") as opened:
        for demo in opened["data"].values():
            del demo["rewards"], demo.attrs["terminated"]
    found = import_demos(open_source(file), tmp_path / "out", TARGET, Rules())
    assert [line.returned for line in found.lines] == [1.0, 0.0, 1.0]
    # Else the value of the last state would be that of a reward at every step from then on.
    assert [each.terminated for each in found.episodes()] == [True, False, True]


def test_values_of_another_kind_are_named_in_one_line(
    exported: dict[str, Path], tmp_path: Path
) -> None:
    file = tmp_path / "odd.hdf5"
    for name, value in {"rewards": ["a"] * 5, "actions": np.zeros(5), "obs/joint": 1.0}.items():
        shutil.copy(exported["robomimic"], file)
        with h5py.File(file, "r+") as opened:
            del opened[f"data/demo_2/{name}"]
            opened[f"data/demo_2/{name}"] = value
        assert str(file) in refused(file, tmp_path / "out")


def test_an_export_never_replaces_a_file(demos: Demonstrations, tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    with pytest.raises(MerlError, match="exists: name another with --out"):
        export_demos(demos, "robomimic", tmp_path / "there", 25.0)
    assert (tmp_path / "there").read_text() == "mine"
    with pytest.raises(MerlError, match="needs a whole number of frames per second"):
        export_demos(demos, "lerobot", tmp_path / "half", 12.5)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
