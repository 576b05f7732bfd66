from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from gymnasium.vector import SyncVectorEnv

from merl.acting.env_checks import check_instances, refuse_running_statistics
from merl.core import MerlError
from merl.envs.wrappers import adapt


class Plain(gymnasium.Env[Any, Any]):
    """Three numbers from the seed."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-9.0, 9.0, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(size=3).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.np_random.normal(size=3).astype(np.float32), 0.0, False, False, {}


class MyNormalizer(wrappers.NormalizeObservation):  # type: ignore[misc]
    pass


class RunningMeanStd:
    """A class with the name that other libraries use."""


class TheirNormalizer(gymnasium.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.statistics = RunningMeanStd()


class Holding(Plain):
    """An environment that holds another one but is not a Gymnasium wrapper."""

    def __init__(self, inner: Any) -> None:
        super().__init__()
        self._robots = [inner]


def frozen(env: Any) -> Any:
    normalized = wrappers.NormalizeObservation(env)
    normalized.update_running_mean = False
    return normalized


@pytest.mark.parametrize(
    "make",
    [
        lambda: wrappers.NormalizeObservation(Plain()),
        lambda: wrappers.NormalizeReward(Plain()),
        lambda: MyNormalizer(Plain()),
        lambda: TheirNormalizer(Plain()),
        lambda: wrappers.TimeLimit(wrappers.ClipReward(wrappers.NormalizeReward(Plain()), -1), 9),
        lambda: Holding(wrappers.NormalizeObservation(Plain())),
        lambda: Holding(wrappers.vector.NormalizeObservation(SyncVectorEnv([Plain]))),
        lambda: Holding(wrappers.vector.NormalizeReward(SyncVectorEnv([Plain]))),
        lambda: Holding(SyncVectorEnv([lambda: wrappers.NormalizeReward(Plain())])),
    ],
)
def test_running_statistics_are_refused_in_every_layer(make: Any) -> None:
    with pytest.raises(MerlError, match=r"--agent\.standardize") as refused:
        refuse_running_statistics(adapt(make()))
    assert "Normalize" in str(refused.value) or "MyNormalizer" in str(refused.value)


class Keeping(Plain):
    """An environment with statistics inside a container, e.g. a dict or an object."""

    def __init__(self, statistics: Any) -> None:
        super().__init__()
        self.kept = statistics


@pytest.mark.parametrize(
    "kept",
    [
        {"obs": RunningMeanStd()},
        [RunningMeanStd()],
        SimpleNamespace(obs=RunningMeanStd()),
        SimpleNamespace(parts=[RunningMeanStd()]),
    ],
    ids=["dict", "list", "object", "object with a list"],
)
def test_running_statistics_in_containers_are_refused(kept: Any) -> None:
    with pytest.raises(MerlError, match="wrapped in Keeping"):
        refuse_running_statistics(adapt(Keeping(kept)))


class SubtractsTheMean(gymnasium.ObservationWrapper[Any, Any, Any]):
    """A wrapper with a simple running mean: after one observation, the mean is that observation."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.count, self.mean = 0, 0.0

    def observation(self, observation: Any) -> Any:
        self.count += 1
        self.mean += (observation - self.mean) / self.count
        return (observation - self.mean).astype(np.float32)


def test_check_instances_warns_of_a_running_mean(caplog: pytest.LogCaptureFixture) -> None:
    check_instances(adapt(Plain()), adapt(SubtractsTheMean(Plain())))
    assert "after resets with the same seed differs" in caplog.text


HARMLESS = [
    Plain,
    lambda: wrappers.TimeLimit(Plain(), 10),
    lambda: wrappers.RecordEpisodeStatistics(Plain()),
    lambda: wrappers.TransformReward(Plain(), lambda reward: reward / 2),
    lambda: wrappers.ClipReward(Plain(), -1.0, 1.0),
    lambda: wrappers.RescaleObservation(Plain(), np.float32(-1), np.float32(1)),
    lambda: wrappers.FlattenObservation(wrappers.FrameStackObservation(Plain(), 3)),
    lambda: wrappers.TimeAwareObservation(wrappers.TimeLimit(Plain(), 10), flatten=True),
    lambda: wrappers.DelayObservation(Plain(), 2),
    lambda: frozen(Plain()),
]


@pytest.mark.parametrize("make", HARMLESS)
def test_harmless_wrappers_pass_without_a_warning(
    make: Any, caplog: pytest.LogCaptureFixture
) -> None:
    env, eval_env = adapt(make()), adapt(make())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refuse_running_statistics(env)
        check_instances(env, eval_env)
    assert not caplog.records
    assert eval_env.unwrapped.steps == 0  # no step was taken  # type: ignore[attr-defined]


class Filter(gymnasium.ObservationWrapper[Any, Any, Any]):
    """A low-pass filter that is not cleared by a reset."""

    filtered = 0.0

    def observation(self, observation: Any) -> Any:
        self.filtered = np.float32(0.9) * self.filtered + np.float32(0.1) * observation
        return self.filtered


class Unseeded(Plain):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.random.default_rng().normal(size=3).astype(np.float32), {}


@pytest.mark.parametrize("make", [lambda: Filter(Plain()), Unseeded])
def test_check_instances_warns_if_resets_with_one_seed_differ(
    make: Any, caplog: pytest.LogCaptureFixture
) -> None:
    check_instances(adapt(make()), adapt(make()))
    assert "after resets with the same seed differs in 'state'" in caplog.text


def test_check_instances_warns_of_one_shared_object(caplog: pytest.LogCaptureFixture) -> None:
    robot = Plain()
    check_instances(adapt(robot), adapt(wrappers.TimeLimit(robot, 5)))
    assert "same environment object" in caplog.text
