"""A run in a user's own environment: keys, success, and instances that differ."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

import merl
from merl.acting.instances import EnvSpaces
from merl.acting.run_env import key_lines, make_run_env, recipe, run_spaces
from merl.acting.workers import _Maker
from merl.agents import AGENTS
from merl.cli import main
from merl.config import TrainConfig
from merl.core import EnvironmentFailed, MerlError
from merl.envs.config import UserEnvConfig
from merl.envs.wrappers import adapt
from merl.evaluation.evaluation import evaluate
from merl.experiments.presets import compose
from merl.report.curves import read_metrics
from merl.runs.plain import box, describe, told
from merl.runs.run import Run
from merl.training.setup import Setup

LENGTH = 5
SMALL = [
    *("--preset", "smoke", "--threads", "1", "--steps", "40", "--random-steps", "10"),
    *("--seed-steps", "20", "--eval.every", "20", "--eval.episodes", "4", "--eval.video", "none"),
    *("--eval.no-references", "--agent.precision", "fp32", "--agent.hidden-dim", "8"),
]
here = __name__


def vector(n: int) -> spaces.Box:
    return spaces.Box(-9, 9, (n,), np.float32)


class Toy(gymnasium.Env[Any, Any]):
    """An environment with episodes of five steps; `info_at` returns the info of a step."""

    observation_space: spaces.Space[Any] = vector(3)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, info_at: Callable[[int, int], dict[str, Any]] = lambda episode, step: {}):
        self.info_at, self.episode, self.taken = info_at, -1, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(0)
        self.episode, self.taken = self.episode + 1, 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self.taken += 1
        info = self.info_at(self.episode, self.taken)
        over = self.taken == LENGTH
        return self.observation_space.sample(), 0.0, False, over, info


# -- observation keys -----------------------------------------------------------------------------


class Arm(Toy):
    """Two cameras, joints, a vector called `state`, and `gear`, which agents cannot use."""

    observation_space = spaces.Dict(
        {
            "pixels": spaces.Box(0, 255, (24, 24, 3), np.uint8),
            "mask": spaces.Box(0, 1, (24, 26), np.uint8),
            "joints": vector(4),
            "state": vector(2),
            "gear": spaces.Discrete(3),
        }
    )


class Plain(Toy):
    """The observation is a plain box."""


def config_of(agent: str, task: str = f"{here}:Arm", **values: Any) -> TrainConfig:
    config = compose("smoke", task, agent)
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, **values))


@pytest.mark.parametrize(
    ("agent", "values", "images", "vectors", "critic"),
    [
        ("merl", {}, ["mask", "pixels"], ["joints", "state"], []),
        ("proprio", {}, [], ["joints", "state"], []),
        ("drqv2", {}, ["mask", "pixels"], [], []),
        ("ddpg", {}, [], ["joints", "state"], []),
        ("sac", {}, [], ["joints", "state"], []),
        ("merl_state", {}, [], ["joints", "state"], []),
        ("ddpg", {"keys": ("state",)}, [], ["state"], []),
        ("merl", {"keys": ("mask", "joints")}, ["mask"], ["joints"], []),
        ("merl", {"privileged": ("state",)}, ["mask", "pixels"], ["joints"], ["state"]),
    ],
)
def test_every_modality_is_used_and_unused_keys_are_reported(
    agent: str, values: dict[str, Any], images: list[str], vectors: list[str], critic: list[str]
) -> None:
    config = config_of(agent, **values)
    env = make_run_env(config)
    assert run_spaces(config, env)[0].keys() == {*images, *vectors, *critic}
    described = {
        "pixels": "pixels (24 x 24 x 3, from 0 to 255)",
        "mask": "mask (24 x 26 x 1, from 0 to 1)",
        "joints": "joints (4 numbers)",
        "state": "state (2 numbers)",
    }
    lines = key_lines(config, env)
    for start, keys in (
        ("images used: ", images),
        ("vectors used: ", vectors),
        ("vectors used by the critic alone: ", critic),
    ):
        expected = [start + ", ".join(described[key] for key in keys)] if keys else []
        assert [line for line in lines if line.startswith(start)] == expected
    left_out = lines[-1]
    assert "'gear' is not used: Discrete(3): encode it as one-hot" in left_out
    for key in described:
        assert (f"{key!r} is not used: " in left_out) == (key not in [*images, *vectors, *critic])


def test_the_reason_for_an_unused_key_names_the_option() -> None:
    config = config_of("drqv2")
    left_out = key_lines(config, make_run_env(config))[-1]
    assert (
        "'joints' is not used: agent drqv2 uses no vectors, --agent.modalities vector adds them"
        in left_out
    )
    config = config_of("merl", keys=("mask", "joints"))
    assert (
        "'pixels' is not used: --agent.keys names others"
        in key_lines(config, make_run_env(config))[-1]
    )


def test_a_plain_box_of_numbers_is_the_key_state() -> None:
    for agent in ("merl", "ddpg"):
        config = config_of(agent, f"{here}:Plain")
        env = make_run_env(config)
        assert key_lines(config, env) == ["vectors used: state (3 numbers)"]


def test_merls_own_tasks_use_the_state_only_if_it_is_named() -> None:
    config = compose("smoke", "reach_duplo")
    env_config = dataclasses.replace(config.env, observations=("image", "proprio", "state"))
    config = dataclasses.replace(config, env=env_config)
    env = make_run_env(config)
    lines = key_lines(config, env)
    env.close()
    assert lines == [
        "images used: image (32 x 32 x 3, from 0 to 255)",
        "vectors used: proprio (24 numbers)",
    ]
    assert AGENTS["ddpg"].config.keys == compose("smoke", "reach_duplo", "ddpg").agent.keys


def test_a_run_prints_its_keys_and_resumes_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    keys = ["--agent.keys", "joints", "mask"]
    line = ["train", f"{here}:Arm", *SMALL, "--run-dir", str(run)]
    assert main([*line, *keys]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "images used: mask (24 x 26 x 1, from 0 to 1)" in printed
    assert "'pixels' is not used: --agent.keys names others" in printed
    record = json.loads((run / "config.json").read_text())
    assert record["observation_space"]["mask"]["bounds"] == [0, 1]
    policy = merl.load_policy(run)
    encoder = policy.agent.networks.encoders.by_key["mask"]  # type: ignore[attr-defined]
    assert encoder.frames.bounds == (0, 1)
    agent = Run.open(run).config.agent
    assert agent.keys == ("joints", "mask")
    assert main([*line, "--resume", "--steps", "50"]) == 0


# -- the policy in Python -------------------------------------------------------------------------


def test_a_policy_accepts_tensors_and_rejects_invalid_observations(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert main(["train", f"{here}:Arm", *SMALL, "--run-dir", str(run)]) == 0
    policy = merl.load_policy(run)
    env = policy.make_env()
    observation = env.reset(seed=0)[0]
    action = policy(observation)
    policy.reset()
    tensors = {key: torch.from_numpy(value) for key, value in observation.items()}
    tensors["joints"] = tensors["joints"].double().requires_grad_()
    np.testing.assert_array_equal(policy(tensors), action)  # type: ignore[arg-type]
    policy.reset()
    channels_first = {**observation, "pixels": np.moveaxis(observation["pixels"], -1, 0)}
    np.testing.assert_array_equal(policy(channels_first), action)
    for key, value, message in (
        ("joints", [[1.0], [1.0, 2.0]], "cannot be converted"),
        ("joints", None, "'joints' contains a value that is not a number: None"),
        ("joints", np.zeros(3), r"'joints' has shape \(3,\)"),
        ("joints", np.full(4, 1e300), "beyond float32"),
        ("pixels", observation["pixels"] / 255, "'pixels' has dtype float64"),
        ("mask", observation["mask"] + 1, "but its space has 0 to 1"),
    ):
        with pytest.raises(MerlError, match=message) as caught:
            policy(observation | {key: value})
        assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(MerlError, match="the observation is a ndarray: give a dict with"):
        policy(np.zeros(3))  # type: ignore[arg-type]


class Ragged(Toy):
    """An environment that returns a ragged list in its third episode."""

    def step(self, action: Any) -> Any:
        observation, *others = super().step(action)
        return ([[1.0], [2.0, 3.0]] if self.episode == 2 else observation), *others


def test_an_observation_that_cannot_be_converted_leaves_a_saved_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("merl.training.timing._time_step", lambda env: 0.001)
    run = tmp_path / "run"
    assert main(["train", f"{here}:Ragged", *SMALL, "--run-dir", str(run)]) == 4
    error = capsys.readouterr().err.strip()
    assert "observation 'state' cannot be converted" in error
    assert "the run is saved at step 1" in error
    assert len(error.splitlines()) == 1


# -- success --------------------------------------------------------------------------------------


def success_in_every_fifth_episode(episode: int, step: int) -> dict[str, Any]:
    """Report success at the end of every fifth episode, and nothing otherwise."""
    return {"is_success": True} if episode % 5 == 0 and step == LENGTH else {}


def zero_action(_: Any) -> Any:
    return np.zeros(2, np.float32)


def test_episodes_without_a_success_report_count_as_failed() -> None:
    result = evaluate(zero_action, adapt(Toy(success_in_every_fifth_episode)), 20)
    for interval in (result.success_end, result.success_any, result.success_share):
        assert interval is not None
        assert interval.mean == pytest.approx(4 / 20)
    without_report = evaluate(zero_action, adapt(Toy()), 4)
    assert without_report.success_end is None
    known = evaluate(zero_action, adapt(Toy()), 4, reports_success=True)
    assert known.success_end is not None
    assert known.success_end.mean == 0
    assert known.metrics()["success_share"] == 0


class Rare(Toy):
    """An environment that reports success only in the second episode of its first instance."""

    instances = itertools.count()

    def __init__(self) -> None:
        first = next(self.instances) == 0
        super().__init__(
            lambda episode, step: {"success": True} if first and episode == 1 and step == 5 else {}
        )


def test_after_a_success_report_no_report_means_failure_also_after_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("merl.training.timing._time_step", lambda env: 0.001)
    monkeypatch.setattr(Rare, "instances", itertools.count())
    run = tmp_path / "run"
    assert main(["train", f"{here}:Rare", *SMALL, "--run-dir", str(run)]) == 0
    assert main(["resume", str(run), "--steps", "60"]) == 0
    metrics = read_metrics(run)
    ends = metrics["train/success_end"][~np.isnan(metrics["train/return"])]
    assert np.isnan(ends[0])  # success was not reported yet
    assert ends[1:].tolist() == [1.0] + [0.0] * 10
    evaluated = ~np.isnan(metrics["eval/return"])
    assert metrics["eval/success_end"][evaluated].tolist() == [0.0, 0.0, 0.0]
    out = tmp_path / "evaluation.json"
    assert main(["evaluate", str(run), "--episodes", "2", "--json", str(out)]) == 0
    episodes = json.loads(out.read_text())["episodes"]
    assert [episode["success_any"] for episode in episodes] == [0.0, 0.0]


def test_an_invalid_success_value_is_reported() -> None:
    env = adapt(Toy(lambda episode, step: {"is_success": {"other": True}}))
    with pytest.raises(EnvironmentFailed, match=r"info\[\"is_success\"\] is \{'other': True\}"):
        evaluate(zero_action, env, 1)


# -- instances that differ ------------------------------------------------------------------------


class Changing(Toy):
    """An environment whose second instance differs in `change`."""

    change = ""
    instances = itertools.count()

    def __init__(self) -> None:
        super().__init__()
        other = next(self.instances) > 0
        self.observation_space = vector(4 if other and self.change == "shape" else 3)
        if other and self.change == "key":
            self.observation_space = spaces.Dict({"joints": vector(3)})
        if other and self.change == "pixels":
            self.observation_space = spaces.Box(0, 1, (24, 24, 3), np.uint8)
        elif self.change == "pixels":
            self.observation_space = spaces.Box(0, 255, (24, 24, 3), np.uint8)
        limit = 2.0 if other and self.change == "bounds" else 1.0
        size = 3 if other and self.change == "actions" else 2
        self.action_space = spaces.Box(-limit, limit, (size,), np.float32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("shape", r"'state' is a float32 box \(3,\) .* and a float32 box \(4,\)"),
        ("key", "'joints' is missing and a float32 box"),
        ("pixels", r"'image' is .* from 0 to 255 and .* from 0 to 1"),
        ("bounds", r"the actions' bounds is low \[-1.0, -1.0\].* and low \[-2.0, -2.0\]"),
        ("actions", r"action is a float32 box \(2,\) .* and a float32 box \(3,\)"),
    ],
)
def test_instances_that_differ_are_refused_at_the_start(
    change: str, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Changing, "change", change)
    monkeypatch.setattr(Changing, "instances", itertools.count())
    config = dataclasses.replace(
        compose("smoke", f"{here}:Changing"), run_dir=tmp_path / "run", device="cpu", threads=1
    )
    with (
        pytest.raises(MerlError, match=f"two instances of the environment.*{message}") as error,
        Setup.prepare(config, new=True),
    ):
        pass
    assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_a_worker_compares_its_instance_with_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Changing, "change", "bounds")
    monkeypatch.setattr(Changing, "instances", itertools.count())
    config = compose("smoke", f"{here}:Changing")
    expected = EnvSpaces.of(make_run_env(config))
    monkeypatch.setattr("merl.acting.workers.belong_to", lambda _: None)
    worker = _Maker(recipe(config), 1, expected, None, None)()
    assert worker.observation_space == expected.observation
    with pytest.raises(MerlError, match="and that of worker 1: the actions' bounds"):
        worker.reset()


def test_allow_wide_actions_is_part_of_the_config() -> None:
    config = compose("smoke", f"{here}:Wide")
    with pytest.raises(MerlError, match=r"use --env.allow-wide-actions"):
        make_run_env(config)
    allowed = dataclasses.replace(config, user_env=UserEnvConfig(allow_wide_actions=True))
    assert make_run_env(allowed).action_space == spaces.Box(-1, 1, (2,), np.float32)


class Wide(Toy):
    """An environment whose action bounds are placeholders."""

    action_space = spaces.Box(-1e30, 1e30, (2,), np.float32)


def test_bounds_are_recorded_and_are_described_only_for_pixels() -> None:
    mask, image = (spaces.Box(0, high, (24, 24, 1), np.uint8) for high in (1, 255))
    assert box(describe(mask)) == mask
    assert told(describe(mask)) == "uint8 (24, 24, 1) from 0 to 1"
    assert told(describe(mask)) != told(describe(image))
    assert told(describe(vector(3))) == told(describe(spaces.Box(-1, 1, (3,), np.float32)))
