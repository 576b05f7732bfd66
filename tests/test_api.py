"""The Python API: train, callbacks, evaluate."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

import merl
from merl.cli import main
from merl.core import CallbackFailed, MerlError
from merl.evaluation.evaluation import Evaluation
from merl.report.curves import read_metrics
from merl.training.loop import StepResult
from merl.training.outcome import Outcome
from toy import DotEnv

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
VECTOR: dict[str, Any] = SMALL | {"agent.modalities": ("vector",)}
TASK = "merl.envs.dot:split"


class Recorder(merl.Callback):
    """Counts its calls, and stops training at a step."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.calls: Counter[str] = Counter()
        self.stop_at = stop_at
        self.outcome: Outcome | None = None
        self.episode: Mapping[str, float] = {}

    def on_start(self, trainer: merl.Trainer) -> None:
        assert trainer.progress.step == 0
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
    with pytest.raises(CallbackFailed) as caught:
        merl.train(TASK, callbacks=[fails], run_dir=tmp_path / "run", **SMALL)
    message = str(caught.value)
    assert message.startswith(
        "callback Fails.on_step raised RuntimeError: the logger is gone (test_api.py, line"
    )
    assert "the run is saved at step 30: fix the cause, and resume with `merl resume " in message
    assert "\n" not in message
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert merl.load_policy(tmp_path / "run").step == 30
    assert (fails.calls["end"], fails.outcome) == (1, None)
    assert merl.resume(tmp_path / "run").progress.step == 60
    # The episode was cut off at step 30.
    assert read_metrics(tmp_path / "run")["step"].tolist() == [20, 50, 60]


@pytest.mark.parametrize("event", ["on_start", "on_episode", "on_evaluation", "on_checkpoint"])
def test_a_failure_in_any_event_loses_nothing(event: str, tmp_path: Path) -> None:
    def fail(*_: Any) -> None:
        if event == "on_start" or (tmp_path / "run/checkpoints/00000040").exists():
            raise RuntimeError("broken")

    fails = merl.Callback()
    setattr(fails, event, fail)
    with pytest.raises(CallbackFailed, match=f"callback Callback.{event} raised RuntimeError"):
        merl.train(TASK, callbacks=[fails], run_dir=tmp_path / "run", **SMALL)
    if event == "on_start":
        assert not (tmp_path / "run").exists()
        return
    merl.resume(tmp_path / "run")
    metrics = read_metrics(tmp_path / "run")
    assert metrics["step"].tolist() == [20, 40, 60]
    assert np.isfinite(metrics["eval/return"]).tolist() == [False, True, True]


def test_a_failure_at_the_end_is_a_warning(tmp_path: Path) -> None:
    class Fails(Recorder):
        def on_end(self, outcome: Outcome | None) -> None:
            raise RuntimeError("broken")

        def on_warning(self, message: str) -> None:
            self.calls[message] += 1

    fails, recorder = Fails(), Recorder()
    outcome = merl.train(TASK, callbacks=[fails, recorder], run_dir=tmp_path / "run", **SMALL)
    assert (outcome.saved, recorder.calls["end"]) == (True, 1)
    (message,) = (text for text in fails.calls if "Fails.on_end raised RuntimeError" in text)
    assert fails.calls[message] == 1


def test_stop_ends_training_from_any_event(tmp_path: Path) -> None:
    class Stops(Recorder):
        def on_start(self, trainer: merl.Trainer) -> None:
            self.trainer = trainer

        def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
            self.trainer.stop()

    outcome = merl.train(TASK, callbacks=[Stops()], run_dir=tmp_path / "run", **SMALL)
    assert (outcome.progress.step, outcome.saved) == (20, True)


def test_a_second_run_in_one_process_is_refused(tmp_path: Path) -> None:
    refused = []

    class Nests(Recorder):
        def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
            with pytest.raises(MerlError) as caught:
                merl.train(TASK, run_dir=tmp_path / "inner", **SMALL)
            refused.append(str(caught.value))

    outcome = merl.train(TASK, callbacks=[Nests()], run_dir=tmp_path / "run", **SMALL)
    assert outcome.progress.step == 60
    assert set(refused) == {
        "this process is training another run: wait for its end, or train in another process"
    }
    assert not (tmp_path / "inner").exists()
    again = merl.train(TASK, run_dir=tmp_path / "next", **SMALL)  # the first one has ended
    assert again.progress.step == 60


def test_training_works_in_another_thread_without_signals(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    with ThreadPoolExecutor(1) as pool:
        outcome = pool.submit(lambda: merl.train(TASK, run_dir=tmp_path / "run", **SMALL)).result()
    assert outcome.progress.step == 60
    assert signal.getsignal(signal.SIGINT) is before


def closure() -> Any:
    """Return a function that makes an environment and cannot be imported by its name."""
    length = 10

    def make() -> DotEnv:
        env = DotEnv()
        env.length = length
        return env

    return make


def importable() -> DotEnv:
    return DotEnv()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_function_makes_the_environment(workers: int, tmp_path: Path) -> None:
    make, run = closure(), tmp_path / "run"
    small = VECTOR | {"num_envs": workers}
    outcome = merl.train(env=make, run_dir=run, **small | {"steps": 40})
    assert outcome.run.config.task == "make()"
    with pytest.raises(MerlError, match=r"'make\(\)' is a Python function, which the run does not"):
        merl.resume(run, steps=60)
    assert main(["resume", str(run), "--steps", "60"]) == 2
    outcome = merl.resume(run, env=make, steps=60)
    assert outcome.progress.step == 60
    policy = merl.load_policy(run)  # needs no environment
    assert policy(make().reset(seed=0)[0]).shape == (1,)
    with pytest.raises(MerlError, match="pass it again"):
        merl.evaluate(run)
    assert outcome.evaluation is not None
    again = merl.evaluate(run, env=make, episodes=2).returns
    assert again == merl.evaluate(run, env=make, episodes=2).returns


def test_a_script_trains_without_a_guard(tmp_path: Path) -> None:
    """The processes of its environments do not run the script again."""
    script, run = tmp_path / "script.py", tmp_path / "run"
    small = VECTOR | {"num_envs": 2, "synchronous": False, "run_dir": str(run)}
    script.write_text(
        "import toy, merl\n"
        "print('begins')\n"
        "class Own(toy.DotEnv):\n"
        "    def reset(self, **options):\n"
        "        return super().reset(**options)\n"
        f"merl.train(env=Own, progress=False, **{small!r})\n"
    )
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("begins") == 1
    assert "Traceback" not in done.stderr
    assert list(run.glob("checkpoints/0*"))


def test_the_run_records_a_function_that_can_be_imported(tmp_path: Path) -> None:
    run = tmp_path / "run"
    outcome = merl.train(importable, run_dir=run, **VECTOR)
    assert outcome.run.config.task == "test_api:importable"
    assert merl.resume(run, steps=80).progress.step == 80
    assert len(merl.evaluate(run, episodes=2).episodes) == 2


def test_an_environment_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    where = {"run_dir": tmp_path / "run"} | SMALL
    lock = threading.Lock()
    with pytest.raises(MerlError, match=r"env is a DotEnv: give a function that makes it"):
        merl.train(DotEnv(), **where)  # type: ignore[arg-type]
    with pytest.raises(MerlError, match=r"train needs one of task and env"):
        merl.train(**where)
    with pytest.raises(MerlError, match=r"train needs one of task and env"):
        merl.train(TASK, env=importable, **where)
    with pytest.raises(MerlError, match=r"lambda\(\) cannot be sent to the worker processes .* 2 "):
        merl.train(lambda: (DotEnv(), lock)[0], num_envs=2, **where)
    with pytest.raises(MerlError, match=r"task 'lambda\(\)' returned int, not a gymnasium.Env"):
        merl.train(lambda: 1, **where)  # type: ignore[arg-type, return-value]
    assert not (tmp_path / "run").exists()


def test_resume_continues_a_run_and_returns_one_that_has_ended(tmp_path: Path) -> None:
    run, recorder = tmp_path / "run", Recorder()
    merl.train(TASK, run_dir=run, **SMALL)
    done = merl.resume(str(run), callbacks=[recorder])
    assert (done.progress.step, done.saved, recorder.calls["step"]) == (60, True, 0)
    recorder.on_start = lambda trainer: None  # type: ignore[method-assign]
    outcome = merl.resume(run, steps=100, callbacks=[recorder])
    assert (outcome.progress.step, recorder.calls["step"]) == (100, 40)
    with pytest.raises(MerlError, match=r"--steps 10 is less than the 100 already taken"):
        merl.resume(run, steps=10)
    with pytest.raises(MerlError, match="steps must be at least 1"):
        merl.resume(run, steps=0)
    with pytest.raises(MerlError, match="is not a run"):
        merl.resume(tmp_path / "nowhere")


def test_the_public_names_exist() -> None:
    for name in merl.__all__:
        assert getattr(merl, name) is not None


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
