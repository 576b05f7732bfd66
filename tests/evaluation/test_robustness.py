"""A policy with disturbed senses, actions and scene."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from matplotlib.image import imread

import merl
from merl.cli import main
from merl.envs import make_env
from merl.evaluation.robustness import Changed, Disturbance, LateActions, disturbances
from merl.report.robustness import Row, draw_rows


class Counter(gymnasium.Env[Any, Any]):
    """Observes the step as an image and as a number; its reward is the action."""

    observation_space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (20, 20, 3), np.uint8),
            "joints": spaces.Box(-1.0, 1.0, (2,), np.float32),
        }
    )
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at += 1
        return self._observe(), float(action[0]), False, self.at == 20, {}

    def _observe(self) -> dict[str, Any]:
        image = np.full((20, 20, 3), 100 + self.at, np.uint8)
        image[:, :2] = 200
        return {"image": image, "joints": np.full(2, self.at / 20, np.float32)}


@pytest.fixture(scope="module")
def found() -> dict[tuple[str, str], Disturbance]:
    """Return the disturbances of the policy that comes with merl, for a deviation of 1."""
    policy = merl.load_policy("pretrained/reach_duplo")
    known = disturbances(policy, {"proprio": np.ones(2)})
    return {(each.sense, each.name): each for each in known}


def observed(disturbance: Disturbance, steps: int = 8) -> list[dict[str, np.ndarray[Any, Any]]]:
    """Return the observations of an episode of `Counter` with a disturbance."""
    own = {"image": "image", "proprio": "joints"}
    changed = disturbance.wrap(Counter())
    assert isinstance(changed, Changed)
    changes = {own[key]: change for key, change in changed._changes.items()}
    env = Changed(Counter(), changes)
    seen = [env.reset(seed=3)[0]]
    return seen + [env.step(np.zeros(1, np.float32))[0] for _ in range(steps)]


def test_a_policy_of_camera_and_joints_has_every_disturbance(
    found: dict[tuple[str, str], Disturbance],
) -> None:
    names = {sense: [name for s, name in found if s == sense] for sense, _ in found}
    late = ["delayed by 1", "delayed by 2", "delayed by 5"]
    assert names == {
        "camera": ["frozen", "black", "shifted", "noise", *late],
        "joints": ["frozen", "dropped", *late, "noise 0.1", "noise 0.5", "bias 0.1", "bias 0.5"],
        "actions": late,
        "scene": ["darker light", "other floor"],
    }


def test_disturbances_of_the_camera(found: dict[tuple[str, str], Disturbance]) -> None:
    middle = {
        name: [int(each["image"][10, 10, 0]) for each in observed(found["camera", name])]
        for name in ("frozen", "black", "delayed by 2", "noise", "shifted")
    }
    assert middle["frozen"] == [100] * 9
    assert middle["black"] == [0] * 9
    assert middle["delayed by 2"] == [100, 100, *range(100, 107)]
    noisy = np.stack([each["image"] for each in observed(found["camera", "noise"])]).astype(float)
    assert noisy.dtype == float
    assert 15 < noisy[:, :, 2:].std() < 25
    shifted = observed(found["camera", "shifted"])[0]["image"]
    assert (shifted[:, :3] == 200).all()
    assert (shifted[:, 3:] == 100).all()
    assert shifted.dtype == np.uint8


def test_disturbances_of_the_joints(found: dict[tuple[str, str], Disturbance]) -> None:
    clean = np.arange(9) / 20
    joints = {
        name: np.stack([each["joints"] for each in observed(found["joints", name])])
        for name in ("frozen", "dropped", "delayed by 1", "noise 0.5", "bias 0.5")
    }
    assert all(each.dtype == np.float32 for each in joints.values())
    assert not joints["frozen"].any()
    assert not joints["dropped"].any()
    np.testing.assert_allclose(joints["delayed by 1"][:, 0], [0, *clean[:-1]], atol=1e-6)
    errors = joints["noise 0.5"] - clean[:, None]
    assert 0.25 < errors.std() < 0.75
    bias = joints["bias 0.5"] - clean[:, None]
    np.testing.assert_allclose(np.abs(bias), 0.5, atol=1e-6)
    np.testing.assert_allclose(bias, bias[:1].repeat(9, 0), atol=1e-6)


def test_the_same_seed_gives_the_same_noise(found: dict[tuple[str, str], Disturbance]) -> None:
    one, other = (observed(found["camera", "noise"]) for _ in range(2))
    for first, second in zip(one, other, strict=True):
        np.testing.assert_array_equal(first["image"], second["image"])


def test_actions_are_executed_later() -> None:
    env = LateActions(Counter(), 2)
    for _ in range(2):
        env.reset(seed=0)
        rewards = [env.step(np.full(1, value / 10, np.float32))[1] for value in range(1, 6)]
        np.testing.assert_allclose(rewards, [0, 0, 0.1, 0.2, 0.3], atol=1e-6)


@pytest.mark.parametrize("name", ["darker light", "other floor"])
def test_the_scene_looks_different_and_moves_alike(
    name: str, found: dict[tuple[str, str], Disturbance]
) -> None:
    config = {"image_size": 32, "observations": ("image", "state")}
    plain, changed = (make_env("reach_duplo", **config) for _ in range(2))
    one, other = plain.reset(seed=0)[0], found["scene", name].wrap(changed).reset(seed=0)[0]
    np.testing.assert_array_equal(one["state"], other["state"])
    assert np.abs(one["image"].astype(float) - other["image"]).mean() > 5
    plain.close()
    changed.close()


@pytest.mark.parametrize(
    ("start", "occluded", "expected"),
    [(("above",), False, True), (("above",), True, False), (("around",), False, False)],
)
def test_box_tasks_are_occluded_where_the_disc_fits(
    start: tuple[str, ...], occluded: bool, expected: bool
) -> None:
    policy = merl.load_policy("pretrained/reach_duplo")
    config = policy.config
    env = dataclasses.replace(config.env, start=start, occluded=occluded)
    policy.config = dataclasses.replace(config, task="move_box", env=env)
    found = {each.name: each for each in disturbances(policy, {"proprio": np.ones(2)})}
    assert ("occluded" in found) is expected
    if expected:
        images = [
            policy.make_env(**form).reset(seed=0)[0]["image"]
            for form in ({}, found["occluded"].form)
        ]
        assert np.abs(images[0].astype(float) - images[1]).mean() > 2


def test_the_command_writes_a_table_and_a_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("merl.evaluation.robustness.DELAYS", (1,))
    monkeypatch.setattr("merl.evaluation.robustness.SHARES", (0.5,))
    assert main(["robustness", "pretrained/reach_duplo", "--episodes", "1", "--out", "it"]) == 0
    with Path("it/robustness.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["disturbance"] == "undisturbed"
    assert len(rows) == 14
    assert all(row["reports_success"] == "True" for row in rows)
    printed = capsys.readouterr().out
    assert all(row["disturbance"] in printed for row in rows)
    assert imread("it/robustness.png").shape[0] > 300


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pretrained/reach_duplo", "--episodes", "0"], "--episodes"),
        (["nowhere"], "nowhere"),
        (["pretrained/reach_duplo", "--out", "file/folder"], "file/folder cannot be created"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert main(["robustness", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_returns_are_drawn_without_success(tmp_path: Path) -> None:
    rows = [
        Row("none", "undisturbed", 5, 10.0, 8.0, 12.0, reports_success=False),
        Row("joints", "frozen", 5, -3.0, -4.0, -1.0, reports_success=False),
    ]
    assert rows[1].text == "-3 [-4, -1]"
    assert draw_rows(rows, "an environment", tmp_path / "figure.png").stat().st_size > 5000
