"""A run in an environment with every kind of observation: train, resume, evaluate, load_policy."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

import merl
from merl.cli import main
from merl.envs.user_env import adapt
from merl.modalities import Depth, Image, Sequence, Vector, modality_of
from merl.report.curves import read_metrics

LENGTH = 6
FORMS: dict[str, tuple[spaces.Box, type, tuple[int, ...]]] = {
    "rgb": (spaces.Box(0, 255, (24, 26, 3), np.uint8), Image, (24, 26, 3)),
    "grey": (spaces.Box(0, 255, (24, 26), np.uint8), Image, (24, 26, 1)),
    "rgba": (spaces.Box(0, 255, (4, 24, 26), np.uint8), Image, (24, 26, 4)),
    "metres": (spaces.Box(0.1, 2.0, (24, 26), np.float32), Depth, (24, 26, 1)),
    "doubles": (spaces.Box(0.0, 2.0, (1, 24, 26), np.float64), Depth, (24, 26, 1)),
    "millimetres": (spaces.Box(0, 5000, (24, 26, 1), np.uint16), Depth, (24, 26, 1)),
    "force": (spaces.Box(-np.inf, np.inf, (16, 6), np.float32), Sequence, (16, 6)),
    "counts": (spaces.Box(0, 9, (5, 4), np.int64), Sequence, (5, 4)),
    "scalar": (spaces.Box(-1, 1, (), np.float32), Vector, (1,)),
    "column": (spaces.Box(-1, 1, (3, 1), np.float64), Vector, (3,)),
    "joints": (spaces.Box(-1, 1, (2,), np.float32), Vector, (2,)),
}
here = __name__


class Senses(gymnasium.Env[Any, Any]):
    """An environment whose observations of every kind are random, from Gymnasium's generator."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    stops = 0
    """Episode in which the process gets SIGTERM; 0: in none."""

    def __init__(self) -> None:
        self.episodes = 0
        self.observation_space = spaces.Dict({key: form[0] for key, form in FORMS.items()})

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.taken, self.episodes = 0, self.episodes + 1
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.taken += 1
        if self.taken == LENGTH and self.episodes == Senses.stops:
            signal.raise_signal(signal.SIGTERM)
        return self._observe(), float(action[0]), False, self.taken == LENGTH, {"success": 0.0}

    def _observe(self) -> dict[str, Any]:
        draw = self.np_random
        observation = {}
        for key, (box, _, _) in FORMS.items():
            low, high = np.maximum(box.low, -5.0), np.minimum(box.high, 5000.0)
            same = min(box.shape[-2:], default=0) > 10  # frames that can be compressed well
            share = np.broadcast_to(draw.uniform(size=() if same else box.shape), box.shape)
            observation[key] = np.asarray(low + share * (high - low)).astype(box.dtype)
        observation["metres"][0, 0] = np.inf  # no return
        return observation


def arguments(run: Path, *options: str) -> list[str]:
    return [
        *("train", f"{here}:Senses", "--preset", "smoke", "--threads", "1", "--steps", "60"),
        *("--random-steps", "10", "--seed-steps", "20", "--eval.every", "30", "--eval.episodes"),
        *("2", "--eval.video", "none", "--eval.no-references", "--agent.precision", "fp32"),
        *(
            "--agent.hidden-dim",
            "8",
            "--replay.batch-size",
            "8",
            "--agent.latent-dim",
            "88",
            "--agent.standardize",
        ),
        *("--agent.encoders.force", "transformer", "--agent.encoders.rgb", "impala"),
        *("--agent.encoders.joints", "mlp", "--run-dir", str(run), *options),
    ]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return merl.load_policy(run).agent.networks.state_dict()  # type: ignore[attr-defined]


def test_each_box_has_its_modality_and_form() -> None:
    env = adapt(Senses())
    observation, _ = env.reset(seed=0)
    for key, (_, kind, shape) in FORMS.items():
        space = env.observation_space[key]  # type: ignore[index]
        assert type(modality_of(space)) is kind
        assert space.shape == shape == observation[key].shape
        assert space.contains(observation[key])


def test_depth_in_other_types_is_the_same_image() -> None:
    env = adapt(Senses())
    given = env.env._observe() if env.reset(seed=0) else None  # type: ignore[attr-defined]
    adapted = env._adapted(given)  # type: ignore[attr-defined]
    assert adapted["metres"][0, 0, 0] == 2.0
    np.testing.assert_allclose(adapted["doubles"][..., 0], given["doubles"][0], rtol=1e-6)
    assert adapted["millimetres"].dtype == np.uint16
    assert np.array_equal(adapted["rgba"], np.moveaxis(given["rgba"], 0, -1))


@pytest.mark.parametrize(
    "compress",
    ["--replay.compress", pytest.param("--replay.no-compress", marks=pytest.mark.long)],
)
def test_a_run_resumes_bit_for_bit_and_its_policy_acts(
    compress: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main(arguments(whole, compress)) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for line in (
        "images used: grey (24 x 26 x 1, from 0 to 255), rgb (24 x 26 x 3, from 0 to 255), rgba",
        "depth images used: doubles (24 x 26, from 0 to 2), metres (24 x 26, from 0.1 to 2)",
        "vectors used: column (3 numbers), joints (2 numbers), scalar (1 number)",
        "histories used: counts (5 samples of 4 numbers), force (16 samples of 6 numbers)",
    ):
        assert line in printed
    monkeypatch.setattr(Senses, "stops", 9)
    assert main(arguments(parts, compress)) != 0
    assert read_metrics(parts)["step"][-1] < 60
    monkeypatch.setattr(Senses, "stops", 0)
    assert main(["resume", str(parts)]) == 0
    resumed = weights(parts)
    for name, value in weights(whole).items():
        assert torch.equal(value, resumed[name]), name
    assert main(["evaluate", str(whole), "--episodes", "2"]) == 0
    policy = merl.load_policy(whole)
    env = adapt(Senses())
    observation, _ = env.reset(seed=3)
    action = policy(observation)
    assert action.shape == (2,)
    policy.reset()
    for key in ("metres", "millimetres", "grey", "scalar"):  # also as the environment gives them
        observation[key] = observation[key].reshape(FORMS[key][0].shape)
    np.testing.assert_array_equal(policy(observation), action)
    changed = {**observation, "metres": observation["metres"][::-1].copy()}
    policy.reset()
    assert not np.array_equal(policy(changed), action)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--agent.encoders.rgb", "conv1d"], "'rgb': encoder 'conv1d' does not fit"),
        (["--agent.encoders.wrist", "conv"], "agent.encoders names 'wrist', but the observation"),
        (["--agent.encoders.rgb"], "--agent.encoders.rgb needs a value"),
        (["--agent.frozen-encoders", "wrist"], "agent.frozen-encoders names 'wrist'"),
        (["--agent.encoder-weights.rgb", "w.pt"], "'rgb', whose encoder is not a model of timm"),
        (["--agent.fusion-layer", "attention", "--agent.latent-dim", "66"], "a multiple of 4"),
        (["--agent.conv-strides", "8", "8", "8"], "24x26 pixels is too small"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_one_line(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    without = [a for a in arguments(run) if a not in ("--agent.encoders.rgb", "impala")]
    assert main([*without, *options]) != 0
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1
    assert not run.exists()


class Changing(Senses):
    """An environment whose history changes its length, as a driver with a variable rate."""

    def _observe(self) -> dict[str, Any]:
        observation = super()._observe()
        if self.taken == 3:
            observation["force"] = observation["force"][:-1]
        return observation


def test_a_history_of_changing_length_is_reported_and_nothing_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    line = arguments(run)
    line[1] = f"{here}:Changing"
    assert main(line) == 4
    printed = " ".join(capsys.readouterr().err.split())
    assert "observation 'force' has shape (15, 6), but its space has (16, 6)" in printed
