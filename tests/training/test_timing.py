from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from merl.agents.merl import MERLConfig
from merl.config import EvaluationConfig, TrainConfig
from merl.core import MerlError
from merl.replay import ReplayConfig
from merl.training import timing
from merl.training.timing import WORTH_COMPILING, Arithmetic, Timing, measure, worth_compiling
from toy import DotEnv

FP32, BF16, BF16_ALL = Arithmetic("fp32", 1), Arithmetic("bf16", 1), Arithmetic("bf16", 4)
CONFIG = TrainConfig(
    "reach_duplo",  # one of merl's tasks, whose steps are timed
    steps=1000,
    seed_steps=200,
    replay=ReplayConfig(batch_size=4),
    agent=MERLConfig(latent_dim=8, hidden_dim=16),
)


def test_bf16_and_several_threads_need_a_minimum_speedup() -> None:
    assert Timing({FP32: 2.0, BF16: 1.0}, 0.1).best == BF16
    assert Timing({FP32: 2.0, BF16: 1.85}, 0.1).best == FP32  # about equally fast
    assert Timing({FP32: 2.0, BF16: 1.8}, 0.1).best == BF16
    assert Timing({FP32: 2.0, BF16: 1.0, BF16_ALL: 0.9}, 0.1).best == BF16
    assert Timing({FP32: 2.0, BF16: 1.0, BF16_ALL: 0.7}, 0.1).best == BF16_ALL


def test_the_time_of_a_run_counts_updates_steps_and_evaluations() -> None:
    timing = Timing({FP32: 0.5}, 0.25)
    config = dataclasses.replace(CONFIG, updates_per_step=0.5)
    evaluated = 10 * 250  # one evaluation of ten episodes
    assert timing.seconds(config) == 400 * 0.5 + (1000 + evaluated) * 0.25
    assert timing.seconds(config, done=900) == 50 * 0.5 + (100 + evaluated) * 0.25
    assert timing.seconds(dataclasses.replace(config, minutes=1.0)) == 60


def test_the_time_of_a_run_counts_its_videos() -> None:
    timing = Timing({FP32: 0.0}, 0.0, frame=0.01)
    seconds = {}
    for video in ("each", "last", "none"):
        evaluation = EvaluationConfig(every=250, video=video)
        seconds[video] = timing.seconds(dataclasses.replace(CONFIG, eval=evaluation))
    assert seconds == {"each": pytest.approx(4 * 2.5), "last": pytest.approx(2.5), "none": 0}


def test_a_frame_is_timed_only_if_videos_are_made() -> None:
    env, eval_env = DotEnv(), DotEnv()
    env.length = 10_000
    none = dataclasses.replace(CONFIG, eval=EvaluationConfig(video="none"))
    for config, has_video in ((CONFIG, True), (none, False)):
        timing = measure(config, env, eval_env, env.observation_space, torch.device("cpu"))
        assert (timing.frame > 0) == has_video


class Untouchable(DotEnv):
    """A robot that must not move: `reset`, `step` and `render` fail."""

    def reset(self, **_: Any) -> Any:
        raise AssertionError("the environment was used")

    step = render = reset


def test_a_user_environment_is_not_used() -> None:
    config = dataclasses.replace(CONFIG, task="my_robot:make")
    env = Untouchable()
    timing = measure(config, env, Untouchable(), env.observation_space, torch.device("cpu"))
    assert not timing.knows_env
    assert all(seconds > 0 for seconds in [*timing.update.values(), timing.step])


@pytest.mark.parametrize(
    ("precision", "threads", "tried"),
    [("auto", 1, {FP32, BF16}), ("fp32", 1, {FP32}), ("bf16", 1, {BF16})],
)
def test_only_open_choices_are_timed(precision: Any, threads: int, tried: set[Arithmetic]) -> None:
    agent = dataclasses.replace(CONFIG.agent, precision=precision)
    config = dataclasses.replace(CONFIG, agent=agent, threads=threads)
    env = DotEnv()
    env.length = 10_000
    timing = measure(config, env, DotEnv(), env.observation_space, torch.device("cpu"))
    assert set(timing.update) == tried
    assert all(seconds > 0 for seconds in timing.update.values())
    assert timing.step > 0


@pytest.mark.parametrize(
    ("cores", "synchronous", "threads"),
    [(1, True, {1}), (2, True, {1, 2}), (2, False, {1}), (3, False, {1, 2}), (1, False, {1})],
)
def test_a_core_is_left_to_environments_beside_the_updates(
    cores: int, synchronous: bool, threads: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {*range(cores)})
    agent = dataclasses.replace(CONFIG.agent, precision="fp32")
    config = dataclasses.replace(CONFIG, agent=agent, synchronous=synchronous)
    env = DotEnv()
    env.length = 10_000
    timing = measure(config, env, DotEnv(), env.observation_space, torch.device("cpu"))
    assert {kind.threads for kind in timing.update} == threads


def with_compile(torch_compile: Any) -> TrainConfig:
    agent = dataclasses.replace(CONFIG.agent, precision="fp32", torch_compile=torch_compile)
    return dataclasses.replace(CONFIG, agent=agent, threads=1)


@pytest.mark.parametrize(
    ("asked", "device", "seconds", "tried"),
    [
        ("auto", "cuda", 1.1 * WORTH_COMPILING, True),
        ("auto", "cuda", 0.9 * WORTH_COMPILING, False),
        ("auto", "cpu", 1.1 * WORTH_COMPILING, False),
        ("no", "cuda", 1.1 * WORTH_COMPILING, False),
        ("yes", "cuda", 1.1 * WORTH_COMPILING, False),  # the timed update was already compiled
    ],
)
def test_compiling_is_tried_on_a_gpu_for_a_long_run(
    asked: str, device: str, seconds: float, tried: bool
) -> None:
    slow = Timing({FP32: 0.0}, seconds / (CONFIG.steps + 10 * 250))
    assert worth_compiling(with_compile(asked), slow, torch.device(device)) == tried


def test_a_failing_compilation_is_skipped_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no compiler\n  at all")

    monkeypatch.setattr("merl.accelerate.speed_up.compile_networks", fail)
    monkeypatch.setattr(timing, "worth_compiling", lambda *_: True)
    env = DotEnv()
    env.length = 10_000
    cpu = torch.device("cpu")
    result = measure(with_compile("auto"), env, DotEnv(), env.observation_space, cpu)
    assert set(result.update) == {FP32}
    assert result.not_compiled == "no compiler"
    assert result.best.decided(CONFIG.agent).torch_compile == "no"
    with pytest.raises(MerlError, match=r"yes: the compiled update fails here \(no compiler\)"):
        measure(with_compile("yes"), env, DotEnv(), env.observation_space, cpu)


@pytest.mark.long
def test_a_working_compilation_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """This test takes a minute and needs a C++ compiler."""
    monkeypatch.setattr(timing, "worth_compiling", lambda *_: True)
    env = DotEnv()
    env.length = 10_000
    cpu = torch.device("cpu")
    result = measure(with_compile("auto"), env, DotEnv(), env.observation_space, cpu)
    compiled = dataclasses.replace(FP32, compiled=True)
    assert set(result.update) == {FP32, compiled}
    assert result.not_compiled is None
    assert compiled.decided(CONFIG.agent).torch_compile == "yes"
