"""An exported policy acts as the policy of the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import merl
from merl.cli import main
from merl.core import MerlError
from merl.evaluation.export import Deployed, export_policy, inputs_of
from merl.evaluation.exported import FORMER, NEXT, SUFFIXES, ExportedPolicy, Form, load_exported
from merl.evaluation.policy import Policy

PRETRAINED = "pretrained/reach_duplo"
NAMES, OUTPUTS = ["image", "proprio", "image_former"], ["action", "image_next"]


@pytest.fixture(scope="module")
def policy() -> Policy:
    return merl.load_policy(PRETRAINED)


@pytest.fixture(scope="module", params=["onnx", "torch", "numpy"])
def exported(
    request: pytest.FixtureRequest, policy: Policy, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    form: Form = request.param
    if form == "onnx":
        pytest.importorskip("onnxruntime")
    path = tmp_path_factory.mktemp("export") / f"p{SUFFIXES[form]}"
    return path, export_policy(policy, path, form)


def test_actions_equal_those_of_the_policy(
    exported: tuple[Path, dict[str, Any]], policy: Policy
) -> None:
    run, rng = load_exported(exported[0], NAMES, OUTPUTS), np.random.default_rng(0)
    policy.reset()
    former = None
    for step in range(1000):
        values = inputs_of(policy, seed=step)
        if step % 100 == 0:
            policy.reset()
            former = values["image"][None]
        values["image" + FORMER] = former
        values["proprio"] = values["proprio"] * rng.choice([0.1, 1.0, 3.0]).astype(np.float32)
        found = run(values)
        expected = policy({key: values[key] for key in ("image", "proprio")})
        np.testing.assert_allclose(found["action"], expected, rtol=0, atol=1e-5)
        former = found["image" + NEXT]
        np.testing.assert_array_equal(former[-1], values["image"])


def test_it_solves_the_same_episodes(exported: tuple[Path, dict[str, Any]], policy: Policy) -> None:
    run = load_exported(exported[0], NAMES, OUTPUTS)
    env = policy.make_env()
    ends = []
    for act_exported in (False, True):
        observation, _ = env.reset(seed=1_000_001)
        policy.reset()
        former, over, total = observation["image"][None], False, 0.0
        while not over:
            if act_exported:
                given = {key: observation[key] for key in ("image", "proprio")}
                found = run(given | {"image" + FORMER: former})
                action, former = found["action"], found["image" + NEXT]
            else:
                action = policy(observation)
            observation, reward, _, over, info = env.step(action)
            total += float(reward)
        ends.append((info["success"], total))
    env.close()
    assert ends[0][0] == ends[1][0] == 1.0
    assert ends[0][1] == pytest.approx(ends[1][1], abs=2.0)


def test_the_card_tells_what_a_robot_needs(exported: tuple[Path, dict[str, Any]]) -> None:
    path, card = exported
    assert json.loads(path.with_name(path.name + ".json").read_text()) == json.loads(
        json.dumps(card)
    )
    assert card["inputs"]["image"] == {"dtype": "uint8", "shape": [24, 24, 3]}
    assert card["inputs"]["image_former"]["shape"] == [1, 24, 24, 3]
    assert card["outputs"]["action"] == {"dtype": "float32", "shape": [9]}
    assert card["action_bounds"] == [[-1.0] * 9, [1.0] * 9]
    assert 0 < card["milliseconds"]["p50"] <= card["milliseconds"]["p99"]
    assert {part.name for part in path.parent.iterdir()} == {path.name, path.name + ".json"}
    assert path.stat().st_size < 1_200_000  # the critic is not in it


def test_actions_are_in_the_units_of_the_environment(policy: Policy) -> None:
    low, high = [-3.0] * 9, [5.0] * 9
    module = Deployed(policy, (low, high))
    plain = Deployed(policy, None)
    values = [torch.from_numpy(value) for value in inputs_of(policy, 0).values()]
    scaled, unit = module(*values)[0], plain(*values)[0]
    torch.testing.assert_close(scaled, 1.0 + 4.0 * unit)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "tflite"], "--to 'tflite' is unknown"),
        (["--out", "no/folder/p.onnx"], "cannot be written"),
        (["--checkpoint", "12"], "12"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", PRETRAINED, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_the_command_prints_inputs_and_outputs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", PRETRAINED, "--to", "torch", "--out", str(tmp_path / "p")]) == 0
    captured = capsys.readouterr()
    assert f"{tmp_path}/p.pt2: " in captured.out
    assert "input image_former: uint8 (1, 24, 24, 3)" in captured.out
    assert captured.err == ""


def test_a_policy_on_bare_numbers_can_be_exported(tmp_path: Path) -> None:
    run = ["train", "reach_duplo", "--preset", "smoke", "--agent", "sac", "--steps", "300"]
    run += ["--eval.every", "0", "--run-dir", str(tmp_path / "run"), "--threads", "1"]
    assert main(run) == 0
    sac = merl.load_policy(tmp_path / "run")
    export_policy(sac, tmp_path / "p.pt2", "torch")
    exported = load_exported(tmp_path / "p.pt2", ["state"], ["action"])
    values = inputs_of(sac, 3)
    sac.reset()
    np.testing.assert_allclose(exported(values)["action"], sac(values), rtol=0, atol=1e-5)


def test_as_an_object_it_keeps_the_frames_itself(
    exported: tuple[Path, dict[str, Any]], policy: Policy
) -> None:
    again, env = ExportedPolicy(exported[0]), policy.make_env()
    for seed in (1, 2):
        observation, _ = env.reset(seed=seed)
        policy.reset()
        again.reset()
        for _ in range(20):
            action = policy(observation)
            np.testing.assert_allclose(again(observation), action, rtol=0, atol=1e-5)
            observation, *_ = env.step(action)
    env.close()
    with pytest.raises(MerlError, match="lacks 'image'"):
        again({"proprio": observation["proprio"]})
    with pytest.raises(MerlError, match=r"'proprio' has shape \(23,\), but its space has \(24,\)"):
        again({**observation, "proprio": observation["proprio"][:-1]})
