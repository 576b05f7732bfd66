"""The Python API: train, callbacks, evaluate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

import merl
from merl.core import MerlError
from merl.evaluation.evaluation import Evaluation
from merl.training.loop import StepResult
from merl.training.trainer import Outcome

SMALL: dict[str, Any] = {
    "preset": "smoke",
    "steps": 60,
    "random_steps": 20,
    "seed_steps": 20,
    "device": "cpu",
    "threads": 1,
    "eval.every": 40,
    "eval.video": "none",
    "eval.references": False,
    "agent.hidden_dim": 16,
    "replay.batch_size": 4,
}
TASK = "merl.envs.dot:split"


class Recorder(merl.Callback):
    """Counts its calls, and stops training at a step."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.calls: Counter[str] = Counter()
        self.stop_at = stop_at
        self.outcome: Outcome | None = None
        self.episode: Mapping[str, float] = {}

    def on_start(self, trainer: merl.Trainer) -> None:
        assert trainer.setup.progress.step == 0
        self.calls["start"] += 1

    def on_step(self, result: StepResult) -> bool | None:
        self.calls["step"] += 1
        return False if result.step == self.stop_at else None

    def on_update(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        assert "critic_loss" in metrics
        self.calls["update"] += 1

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        self.episode = metrics
        self.calls["episode"] += 1

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        self.calls[f"evaluation at {step}"] += 1

    def on_checkpoint(self, step: int) -> None:
        self.calls[f"checkpoint at {step}"] += 1

    def on_end(self, outcome: Outcome | None) -> None:
        self.outcome = outcome
        self.calls["end"] += 1


def test_train_calls_the_callbacks_and_evaluate_repeats_its_last_evaluation(tmp_path: Path) -> None:
    recorder = Recorder()
    outcome = merl.train(TASK, callbacks=[recorder], run_dir=f"{tmp_path}/run", **SMALL)
    assert outcome.progress.step == 60
    assert recorder.outcome is not None
    assert recorder.outcome.run.path == outcome.run.path == tmp_path / "run"
    assert outcome.run.config.agent.hidden_dim == 16
    assert recorder.calls == {
        "start": 1,
        "step": 60,
        "update": 4,  # 0.1 a step after 20 steps
        "episode": 3,
        "evaluation at 40": 1,
        "evaluation at 60": 1,
        "checkpoint at 0": 1,
        "checkpoint at 40": 2,  # before and after the evaluation
        "checkpoint at 60": 2,
        "end": 1,
    }
    assert "train/return" in recorder.episode
    again = merl.evaluate(tmp_path / "run", episodes=2)
    assert outcome.evaluation is not None
    assert again.returns == outcome.evaluation.returns
    with pytest.raises(MerlError, match="episodes must be at least 1, not 0"):
        merl.evaluate(tmp_path / "run", episodes=0)


def test_a_callback_stops_training_and_the_run_is_saved(tmp_path: Path) -> None:
    recorder = Recorder(stop_at=30)
    outcome = merl.train(TASK, callbacks=[recorder], run_dir=tmp_path / "run", **SMALL)
    assert (outcome.progress.step, outcome.signal, outcome.saved) == (30, None, True)
    assert recorder.calls["step"] == 30
    assert recorder.calls["evaluation at 30"] == 1  # as at the end of every run
    assert merl.load_policy(tmp_path / "run").step == 30


def test_a_callback_that_raises_ends_the_run_which_is_saved(tmp_path: Path) -> None:
    class Fails(Recorder):
        def on_step(self, result: StepResult) -> bool | None:
            if result.step == 30:
                raise RuntimeError("the logger is gone")
            return None

    fails = Fails()
    with pytest.raises(RuntimeError, match="the logger is gone"):
        merl.train(TASK, callbacks=[fails], run_dir=tmp_path / "run", **SMALL)
    assert merl.load_policy(tmp_path / "run").step == 30
    assert (fails.calls["end"], fails.outcome) == (1, None)


def test_a_whole_config_can_be_trained(tmp_path: Path) -> None:
    outcome = merl.train(TASK, run_dir=tmp_path / "one", **SMALL)
    config = outcome.run.config
    other = merl.train(config, run_dir=tmp_path / "two", **{"steps": 25, "eval.every": 0})
    assert other.progress.step == 25
    assert other.run.config.agent == config.agent


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"step": 5}, r"config 'step' is unknown: did you mean 'steps'\?"),
        ({"agent.noise": 0.1}, r"config agent.'noise' is unknown: did you mean 'noise_std'\?"),
        ({"steps.many": 5}, "config 'steps.many' is unknown"),
        ({"agent.noise_std": -1.0}, "agent.noise-std must be at least 0, not -1.0"),
    ],
)
def test_a_bad_value_is_named(values: dict[str, Any], says: str, tmp_path: Path) -> None:
    with pytest.raises(MerlError, match=says):
        merl.train(TASK, preset="smoke", run_dir=tmp_path / "run", **values)
    assert not (tmp_path / "run").exists()
