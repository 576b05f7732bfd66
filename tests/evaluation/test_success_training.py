"""A classifier of success: labels, training, and an environment that uses it."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import flat
from merl.cli import main
from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.episode import Episode
from merl.demos.recorder import Recorder
from merl.envs.learnt_success import LearntSuccess
from merl.evaluation.demonstrating import record_episodes
from merl.evaluation.success_training import label, save_classifier, train_classifier
from toy import DotEnv


def write(folder: Path, episodes: list[Episode]) -> Path:
    env = DotEnv()
    recorder = Recorder(folder, "toy:DotEnv", "a test", env.observation_space, env.action_space)
    for episode in episodes:
        recorder.add(episode)
    return folder


def wandering(episodes: int) -> list[Episode]:
    """Record episodes with random actions: the dot is in the middle in some of their steps."""
    rng = np.random.default_rng(0)
    act = lambda _: rng.uniform(-1, 1, 1)  # noqa: E731
    return list(record_episodes(act, DotEnv(), episodes, failures=True))


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("demos") / "dot", wandering(60))


@pytest.fixture(scope="module")
def classifier(demos: Path) -> Path:
    file = demos.parent / "success.safetensors"
    assert main(["classifier", str(demos), "--updates", "400", "--out", str(file)]) == 0
    return file


def test_every_step_is_labelled_as_the_environment_reported_it(demos: Path) -> None:
    found = Demonstrations.open(demos)
    data = label([found])
    places = [episode.observations["joint"][1:, 0] for episode in found.episodes()]
    np.testing.assert_array_equal(data.solved, np.abs(np.concatenate(places)) < 0.2)
    assert data.episode.max() == 59


def test_without_reports_of_every_step_only_what_is_known_is_labelled(tmp_path: Path) -> None:
    good, bad = (
        replace(episode, success=success, successes=None)
        for episode, success in zip(wandering(2), (True, False), strict=True)
    )
    data = label([Demonstrations.open(write(tmp_path / "old", [good, bad]))])
    assert data.solved.tolist() == [True, *[False] * 11]
    np.testing.assert_array_equal(data.images["image"][0], good.observations["image"][-1])


def test_it_is_tested_on_episodes_that_it_was_not_trained_on(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "success.safetensors"
    command = ["classifier", str(demos), "--updates", "400", "--threshold", "0.5"]
    assert main([*command, "--out", str(out)]) == 0
    words = flat(capsys.readouterr().out).replace(f"{out}: sees success in ", "").split()
    found, solved, alarms, others = (int(words[at]) for at in (0, 2, 8, 10))
    assert solved + others == 12 * 10  # a fifth of the episodes
    assert found >= 0.9 * solved
    assert alarms <= 0.15 * others  # at the edge, the image shows whole pixels alone


def test_the_environment_ends_with_the_success_that_it_sees(classifier: Path) -> None:
    """The dot is moved to the middle, leaves it after two steps, and comes back."""
    env = LearntSuccess(DotEnv(), classifier, threshold=0.5, steps=3)
    env.reset(seed=0)
    results = []
    for goal in (0.9, 0.0, 0.0, 0.9, 0.0, 0.0, 0.0):
        env.unwrapped.x = goal  # type: ignore[attr-defined]
        _, reward, terminated, truncated, info = env.step(np.zeros(1))
        assert not truncated
        assert info["success"] == reward == float(terminated)
        assert (info["success_probability"] >= 0.5) == (goal == 0.0)
        results.append(terminated)
    assert results == [False] * 6 + [True]
    env.reset()
    assert not env.step(np.zeros(1))[2]


def test_a_full_disk_is_one_line_and_keeps_the_former_file(demos: Path, tmp_path: Path) -> None:
    data, file = label([Demonstrations.open(demos)]), tmp_path / "success.safetensors"
    network, _ = train_classifier(data, updates=1, threshold=0.5)
    file.write_bytes(b"former")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(MerlError, match=r"success\.safetensors cannot be written: File too"):
            save_classifier(network, data, file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"former"]


def test_another_environment_or_file_is_refused(classifier: Path, tmp_path: Path) -> None:
    class Wide(DotEnv):
        def __init__(self) -> None:
            super().__init__()
            space: Any = self.observation_space
            space.spaces.pop("image")

    with pytest.raises(MerlError, match=r"needs image 'image' of uint8 \(16, 16, 3\): .* none"):
        LearntSuccess(Wide(), classifier)
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(classifier.read_bytes()[:-9])
    for file in (broken, tmp_path / "missing", tmp_path):
        with pytest.raises(MerlError, match="is not a classifier that can be read"):
            LearntSuccess(DotEnv(), file)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--keys", "nose"], "has no image 'nose': choose from ['image']"),
        (["--threshold", "2"], "threshold must be at least 0 and at most 1"),
        (["nowhere"], "nowhere holds no demonstrations"),
    ],
)
def test_bad_options_are_one_line(
    options: list[str], line: str, demos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["classifier", str(demos), *options]) == 2
    assert line in flat(capsys.readouterr().err)


def test_too_few_or_one_sided_episodes_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = [replace(each, success=False, successes=None) for each in wandering(3)]
    assert main(["classifier", str(write(tmp_path / "failed", failed))]) == 2
    assert "shows no success: a classifier needs images" in flat(capsys.readouterr().err)
    assert main(["classifier", str(write(tmp_path / "few", wandering(2)))]) == 2
    assert "2 episodes are too few to train and to test" in flat(capsys.readouterr().err)


def test_reports_of_another_length_are_refused(tmp_path: Path) -> None:
    (episode,) = wandering(1)
    folder = write(tmp_path / "odd", [replace(episode, successes=np.ones(3, bool))])
    with pytest.raises(MerlError, match=r"success is bool \(3,\), not bool \(10,\)"):
        list(Demonstrations.open(folder).episodes())
