"""The environment of a run has only the observation keys that its agent uses."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from merl.acting.run_env import make_run_env, run_spaces
from merl.agents import AGENTS
from merl.config import EvaluationConfig, TrainConfig
from merl.core import EnvironmentFailed, MerlError
from merl.envs.config import EnvConfig
from merl.runs.plain import from_plain, to_plain
from merl.runs.resume import merge_resume_config
from merl.training.setup import Setup
from toy import DotEnv

SMALL = EnvConfig(renderer="raster", image_size=32)


def test_samples_are_recorded_and_older_records_have_one() -> None:
    env = EnvConfig(renderer="raster", image_size=24, samples=3)
    plain = to_plain(TrainConfig("reach_duplo", env=env))["env"]
    assert plain["samples"] == 3
    assert from_plain(EnvConfig, plain) == env
    del plain["samples"]
    assert from_plain(EnvConfig, plain) == dataclasses.replace(env, samples=1)


def test_resume_refuses_other_samples() -> None:
    env = EnvConfig(renderer="raster", image_size=24, samples=3)
    recorded = TrainConfig("reach_duplo", env=env)
    other = dataclasses.replace(recorded, env=dataclasses.replace(env, samples=2))
    with pytest.raises(MerlError, match=r"cannot resume with env.samples 3 -> 2"):
        merge_resume_config(recorded, other)


def test_samples_reach_the_environment_of_a_run() -> None:
    env = EnvConfig(renderer="raster", image_size=24, samples=3)
    made = make_run_env(TrainConfig("reach_duplo", env=env))
    assert made.reset(seed=0)[0]["image"].shape == (24, 24, 3)
    assert made.unwrapped.config.samples == 3  # type: ignore[attr-defined]
    made.close()


@pytest.mark.parametrize(
    ("agent", "keys"),
    [
        ("merl", {"image", "proprio"}),
        ("drqv2", {"image"}),
        ("proprio", {"proprio"}),
        ("merl_state", {"state"}),
        ("ddpg", {"state"}),
        ("sac", {"state"}),
    ],
)
def test_observation_has_the_keys_of_the_agent(agent: str, keys: set[str]) -> None:
    config = TrainConfig("reach_duplo", agent_name=agent, agent=AGENTS[agent].config, env=SMALL)
    env = make_run_env(config)
    space, _ = run_spaces(config, env)
    assert set(space) == set(env.observation_space) == keys  # type: ignore[call-overload]
    assert set(env.reset(seed=0)[0]) == keys
    assert env.unwrapped.config.observations == tuple(  # type: ignore[attr-defined]
        name for name in ("image", "proprio", "state") if name in keys
    )  # no other observation was computed
    env.close()


def test_observation_includes_privileged_keys() -> None:
    agent = dataclasses.replace(AGENTS["merl"].config, privileged=("state",))
    env = make_run_env(TrainConfig("reach_duplo", agent=agent, env=SMALL))
    assert set(env.reset(seed=0)[0]) == {"image", "proprio", "state"}
    env.close()


def test_observation_of_a_user_environment_has_the_keys_of_the_agent() -> None:
    config = TrainConfig("merl.envs.dot:whole", agent_name="drqv2", agent=AGENTS["drqv2"].config)
    env = make_run_env(config)
    assert set(env.observation_space) == set(env.reset(seed=0)[0]) == {"image"}  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"keys": ("proprio",), "privileged": ("proprio",)},
            "which the actor uses too",
        ),
        ({"modalities": ("vector",), "privileged": ("proprio",)}, "leaves no key for the actor"),
        ({"privileged": ("sonar",)}, "agent.privileged names 'sonar'"),
        ({"privileged": ("state",), "fusion": "shared"}, "use --agent.fusion decoupled"),
        (
            {"keys": ("sonar",)},
            r"agent.keys names 'sonar', but the observation has \['depth', 'image'",
        ),
        ({"keys": ()}, "can use no observation"),
    ],
)
def test_invalid_keys_are_refused_by_name(change: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(MerlError, match=message):
        make_run_env(
            TrainConfig(
                "reach_duplo", agent=dataclasses.replace(AGENTS["merl"].config, **change), env=SMALL
            )
        )


class ReplacesHandlers(DotEnv):
    """Installs its own handler for Ctrl-C in every method."""

    def __init__(self) -> None:
        signal.signal(signal.SIGINT, lambda *_: None)
        super().__init__()

    def reset(self, **options: Any) -> Any:
        signal.signal(signal.SIGINT, lambda *_: None)
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        signal.signal(signal.SIGINT, lambda *_: None)
        raise OSError("the arm is gone")

    def render(self) -> Any:
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def close(self) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        raise KeyboardInterrupt


def replaces_handlers() -> DotEnv:
    return ReplacesHandlers()


def test_signal_handlers_are_restored_after_every_call(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    config = TrainConfig("test_run_env:replaces_handlers", agent=AGENTS["merl"].config)
    env: Any = None

    def make() -> None:
        nonlocal env
        env = make_run_env(config)

    def step() -> None:
        with pytest.raises(EnvironmentFailed, match="the arm is gone"):
            env.step(np.zeros(1, np.float32))

    def close() -> None:
        env.close()
        assert "was interrupted" in caplog.text

    mine = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        before = signal.getsignal(signal.SIGINT)
        for call in (make, lambda: env.reset(seed=0), step, lambda: env.render(), close):
            call()
            assert signal.getsignal(signal.SIGINT) is before
    finally:
        signal.signal(signal.SIGINT, mine)


def test_evaluations_use_eval_start() -> None:
    trained = TrainConfig(
        "move_box",
        agent_name="merl_state",
        agent=AGENTS["merl_state"].config,
        env=dataclasses.replace(SMALL, start=("around", "holding")),
    )
    assert trained.evaluated == trained
    config = dataclasses.replace(trained, eval=EvaluationConfig(start=("above",)))
    assert config.evaluated.env == dataclasses.replace(trained.env, start=("above",))
    assert from_plain(EvaluationConfig, to_plain(config)["eval"]) == config.eval
    heights = {}
    for name, each in (("trained", config), ("evaluated", config.evaluated)):
        env = make_run_env(each)
        try:
            env.reset(seed=0)
            inner: Any = env.unwrapped
            heights[name] = inner.task.robot.tool_center_point(inner.physics)[2]
        finally:
            env.close()
    assert heights["trained"] < 0.15 < heights["evaluated"]


def test_eval_start_is_refused_for_user_environments_and_empty_values() -> None:
    with pytest.raises(MerlError, match=r"eval\.start .* my_env:make sets its own start states"):
        TrainConfig("my_env:make", eval=EvaluationConfig(start=("above",)))
    with pytest.raises(MerlError, match="start"):
        TrainConfig("move_box", eval=EvaluationConfig(start=()))


def test_the_evaluation_environment_of_a_run_uses_eval_start(tmp_path: Path) -> None:
    config = TrainConfig(
        "move_box",
        agent_name="merl_state",
        agent=dataclasses.replace(AGENTS["merl_state"].config, precision="fp32", hidden_dim=16),
        env=dataclasses.replace(SMALL, start=("around",)),
        eval=EvaluationConfig(start=("above",), video="none"),
        steps=300,
        threads=1,
        run_dir=tmp_path / "run",
    )
    with Setup.prepare(config, new=True) as parts:
        trained: Any = parts.env.unwrapped
        assert parts.eval_env is not None
        evaluated: Any = parts.eval_env.unwrapped
        assert (trained.config.start, evaluated.config.start) == (("around",), ("above",))
