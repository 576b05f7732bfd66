from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file

from merl import cli
from merl.core import NotFinite
from merl.core.guards import LossGuard, check_finite, check_weights
from merl.report.curves import read_metrics
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run

NAN, INF = float("nan"), float("inf")
BAD_STEP = 70
"""The step at which `Broken` starts to return NaN or infinity."""


class Broken(gymnasium.Env[Any, Any]):
    """Ten steps per episode; from `BAD_STEP` on, reward or observation is not finite."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, reward: float = 0.0, offset: float = 0.0) -> None:
        self.bad_reward, self.bad_offset = reward, offset
        self.taken = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:  # the first reset of a run, after the environment was timed
            self.taken = 0
        return self.np_random.normal(size=3).astype(np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken += 1
        observation = self.np_random.normal(size=3).astype(np.float32)
        bad = self.taken >= BAD_STEP
        observation[1] += self.bad_offset if bad else 0.0
        return observation, self.bad_reward if bad else 1.0, False, self.taken % 10 == 0, {}


def nan_reward() -> Broken:
    return Broken(reward=NAN)


def infinite_observation() -> Broken:
    return Broken(offset=INF)


def finite() -> Broken:
    return Broken(reward=1.0)


def train(tmp_path: Path, function: str, *flags: str) -> tuple[int, Path]:
    run = tmp_path / "run"
    line = f"""train test_guards:{function} --agent ddpg --preset smoke --steps 200
        --random-steps 20 --seed-steps 20 --updates-per-step 1 --agent.hidden-dim 16 --save-every 0
        --eval.every 1000 --eval.episodes 1 --run-dir""".split()
    return cli.main([*line, str(run), *flags]), run


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("nan_reward", f"reward is nan at step {BAD_STEP}"),
        ("infinite_observation", f"observation 'state' is inf at index 1 at step {BAD_STEP}"),
    ],
)
def test_a_non_finite_reward_or_observation_stops_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], function: str, message: str
) -> None:
    code, run = train(tmp_path, function)
    err = capsys.readouterr().err
    assert code == 3
    assert message in err
    assert "Traceback" not in err
    start = Checkpoint.find(Run.open(run).checkpoints)
    assert start.step == BAD_STEP - 1
    assert f"the run is saved at step {BAD_STEP - 1}: fix the cause" in err
    for name in ("reward", "observation.state"):
        (file,) = (run / "replay").rglob(f"{name}.bin")
        assert np.isfinite(np.fromfile(file, "<f4")).all()


def test_a_non_finite_loss_stops_the_run_and_keeps_the_last_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, run = train(tmp_path, "finite", "--agent.learning-rate", "1e30")
    err = capsys.readouterr().err
    assert code == 3
    assert "is not finite at step" in err or "no longer finite" in err
    start = Checkpoint.find(Run.open(run).checkpoints)
    weights = load_file(start.path / "weights.safetensors")
    assert all(tensor.isfinite().all() for tensor in weights.values())
    for name, values in read_metrics(run).items():
        assert not np.isinf(values).any(), name


def test_check_finite_names_the_value_and_the_step() -> None:
    good = {"image": np.zeros((4, 4, 3), np.uint8), "joints": np.zeros(3, np.float32)}
    check_finite(good, 1.0, 1)
    with pytest.raises(NotFinite, match="reward is inf at step 1,234"):
        check_finite(good, INF, 1234)
    with pytest.raises(NotFinite, match="reward is nan at step 1"):
        check_finite(good, NAN, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(NotFinite, match=r"reward is 1e\+39, which is beyond float32, at"):
            check_finite(good, 1e39, 1)
    joints = np.array([0.0, 1.0, NAN], np.float32)
    with pytest.raises(NotFinite, match="'joints' is nan at index 2 at step 5"):
        check_finite({**good, "joints": joints}, 1.0, 5)


def test_check_weights_names_the_tensor() -> None:
    good = {"layer.weight": torch.ones(2, 2), "count": torch.tensor(3)}
    check_weights({"networks": good})
    bad = {**good, "layer.bias": torch.tensor([0.0, INF])}
    with pytest.raises(NotFinite, match=r"networks\.layer\.bias"):
        check_weights({"networks": bad})


def test_the_first_bad_step_is_reported_also_by_later_checks() -> None:
    guard = LossGuard()
    guard.check()
    guard.watch({}, 1)
    guard.watch({"critic_loss": torch.tensor(1.0), "actor_loss": torch.tensor(2.0)}, 2)
    with pytest.raises(NotFinite, match=r"actor_loss is not finite at step 3$"):
        guard.watch({"critic_loss": torch.tensor(1.0), "actor_loss": torch.tensor(NAN)}, 3)
    with pytest.raises(NotFinite, match=r"actor_loss is not finite at step 3$"):
        guard.watch({"critic_loss": torch.tensor(INF), "actor_loss": torch.tensor(1.0)}, 4)


def test_updates_may_report_different_metrics() -> None:
    guard = LossGuard()
    guard.watch({"critic_loss": torch.tensor(1.0)}, 1)
    guard.watch({"critic_loss": torch.tensor(1.0), "actor_loss": torch.tensor(2.0)}, 2)
    with pytest.raises(NotFinite, match=r"learner's critic_loss is not finite at step 3$"):
        guard.watch({"critic_loss": torch.tensor(NAN)}, 3)
    with pytest.raises(NotFinite, match=r"learner's critic_loss is not finite at step 3$"):
        guard.watch({"critic_loss": torch.tensor(NAN), "actor_loss": torch.tensor(NAN)}, 4)
