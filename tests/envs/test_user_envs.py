"""User environments: found by name, converted for agents, or rejected in one line."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from merl.core import EnvironmentFailed, MerlError, NotFinite
from merl.core.user_code import in_one_line
from merl.envs.user_env import adapt, load_module, make_user_env


class SpaceEnv(gymnasium.Env[Any, Any]):
    """An environment that returns samples of its observation space."""

    def __init__(self, space: spaces.Space[Any], actions: spaces.Space[Any] | None = None) -> None:
        self.observation_space = space
        self.action_space = actions or spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(0)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self.received_action = action
        return self.observation_space.sample(), np.float64(1.5), False, True, {"is_success": True}


def image(*shape: int) -> spaces.Box:
    return spaces.Box(0, 255, shape, np.uint8)


def vector(n: int, dtype: type = np.float32) -> spaces.Box:
    return spaces.Box(-9, 9, (n,), dtype)


@pytest.mark.parametrize(
    ("given", "taken"),
    [
        (vector(3), {"state": (3,)}),
        (vector(3, np.float64), {"state": (3,)}),
        (spaces.Box(0, 255, (128,), np.uint8), {"state": (128,)}),
        (image(20, 30, 3), {"image": (20, 30, 3)}),
        (image(20, 30), {"image": (20, 30, 1)}),
        (image(3, 20, 30), {"image": (20, 30, 3)}),
        (
            spaces.Dict({"top": image(20, 20, 3), "arm": vector(7, np.float64)}),
            {"arm": (7,), "top": (20, 20, 3)},
        ),
    ],
)
def test_observations_become_images_and_vectors(given: Any, taken: dict[str, Any]) -> None:
    env = adapt(SpaceEnv(given))
    assert isinstance(env.observation_space, spaces.Dict)
    assert {key: space.shape for key, space in env.observation_space.items()} == taken
    for space in env.observation_space.values():
        assert space.dtype == (np.uint8 if len(space.shape or ()) == 3 else np.float32)
    for observation in (env.reset(seed=0)[0], env.step(np.zeros(2, np.float32))[0]):
        assert env.observation_space.contains(observation)


def test_channels_first_images_become_channels_last() -> None:
    plain, adapted = SpaceEnv(image(3, 20, 30)), adapt(SpaceEnv(image(3, 20, 30)))
    before, after = plain.reset()[0], adapted.reset()[0]["image"]
    for channel in range(3):
        np.testing.assert_array_equal(after[..., channel], before[channel])


def test_other_keys_than_images_and_vectors_are_left_out_with_a_reason() -> None:
    space = spaces.Dict({"arm": vector(2), "gear": spaces.Discrete(3), "map": vector(4)})
    env = adapt(SpaceEnv(space))
    assert env.get_wrapper_attr("left_out") == {
        "gear": "Discrete(3): encode it as one-hot, a float32 box of 3 numbers"
    }
    assert set(env.observation_space) == {"arm", "map"}  # type: ignore[call-overload]
    assert set(env.reset()[0]) == {"arm", "map"}


def test_actions_are_rescaled_and_is_success_becomes_success() -> None:
    low, high = np.array([-2.0, 0.0]), np.array([2.0, 10.0])
    given = SpaceEnv(vector(2), spaces.Box(low, high, dtype=np.float64))
    rng = np.random.default_rng(0)
    for _ in range(200):  # rounding never exceeds the bounds
        ends = np.sort(rng.normal(size=(2, 2)).astype(np.float32), axis=0)
        odd = SpaceEnv(vector(2), spaces.Box(*ends))
        adapted = adapt(odd)
        adapted.reset(seed=0)
        for action in (-np.ones(2, np.float32), np.ones(2, np.float32)):
            adapted.step(action)
            assert odd.action_space.contains(odd.received_action)
    env = adapt(given)
    assert env.action_space == spaces.Box(-1.0, 1.0, (2,), np.float32)
    env.reset(seed=0)
    for action, expected in (((-1, -1), low), ((0, 0), (0, 5)), ((1, 1), high)):
        _, reward, _, truncated, info = env.step(np.array(action, np.float32))
        np.testing.assert_allclose(given.received_action, expected)
    assert (reward, truncated, info["success"]) == (1.5, True, True)


@pytest.mark.parametrize(
    ("space", "actions", "message"),
    [
        (vector(2), spaces.Discrete(4), r"actions are Discrete\(4\)"),
        (vector(2), spaces.Box(-np.inf, np.inf, (2,)), "set finite bounds"),
        (vector(2), spaces.Box(-1, 1, (2, 2)), "a box of real numbers"),
        (vector(2), spaces.Box(-9, 9, (2,), np.int32), "a box of real numbers"),
        (spaces.Discrete(5), None, "neither an image"),
        (spaces.Dict({"a": spaces.Dict({"b": vector(2)})}), None, "neither an image"),
        (spaces.Box(-1, 1, (4, 4, 4), np.float32), None, "neither an image"),
    ],
)
def test_unusable_spaces_are_rejected(space: Any, actions: Any, message: str) -> None:
    with pytest.raises(MerlError, match=message):
        adapt(SpaceEnv(space, actions))


def test_a_robot_is_connected_once(caplog: pytest.LogCaptureFixture) -> None:
    """Videos are asked for by default; an environment that has none is not made again for it."""
    calls: list[str] = []

    class Robot(SpaceEnv):
        def close(self) -> None:
            calls.append("close")
            raise OSError("the motors do not answer")

    def make() -> Robot:
        calls.append("make")
        return Robot(vector(2))

    env = make_user_env("make()", "rgb_array", make=make)
    assert calls == ["make"]
    env.close()
    assert calls == ["make", "close"]
    assert "the motors do not answer" in caplog.text

    def broken() -> Robot:
        calls.append("make")
        raise OSError("no such port")

    with pytest.raises(EnvironmentFailed, match="no such port"):
        make_user_env("broken()", "rgb_array", make=broken)
    assert calls == ["make", "close", "make"]


def test_environments_are_found_by_id_and_by_function(tmp_path: Path, monkeypatch: Any) -> None:
    assert make_user_env("merl.envs.dot:whole", "rgb_array").render_mode == "rgb_array"
    pendulum = make_user_env("Pendulum-v1")
    assert set(pendulum.observation_space) == {"state"}  # type: ignore[call-overload]
    (tmp_path / "my_robot_here.py").write_text(
        "import gymnasium\n"
        "def make():\n    return gymnasium.make('Pendulum-v1', g=1.0)\n"
        "def number():\n    return 3\n"
        "limit = 3\n"
        "gymnasium.register('Robot-v7', entry_point=make)\n"
    )
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    load_module("my_robot_here:make", tmp_path)
    assert make_user_env("my_robot_here:make").unwrapped.g == 1.0  # type: ignore[attr-defined]
    assert make_user_env("my_robot_here:Robot-v7", "rgb_array").render_mode is None
    for task, message in {
        "Pendulm-v1": "did you mean 'Pendulum-v1'",
        "reach_dulpo": "did you mean 'reach_duplo'",
        "zzz": "choose from reach_duplo, move_box, lift_box, or name a Gymnasium id",
        "no_such_module:make": "add its folder to PYTHONPATH",
        "my_robot_here:maker": "has no function 'maker'",
        "my_robot_here:limit": "must name a function",
        "my_robot_here:number": "returned int",
        "CartPole-v1": "Discrete",
    }.items():
        with pytest.raises(MerlError, match=message):
            make_user_env(task)


class WrongObservationEnv(SpaceEnv):
    """Returns floats for a uint8 space, and leaves a key out."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observation, info = super().reset(seed=seed)
        observation.pop("arm")
        observation["top"] = observation["top"] / 255
        return observation, info


@pytest.mark.parametrize(
    ("keys", "message"), [(("top",), "has dtype float64"), (("arm",), "lacks 'arm'")]
)
def test_observations_that_contradict_their_space_are_rejected(
    keys: tuple[str], message: str
) -> None:
    spaces_by_key = {"top": image(20, 20, 3), "arm": vector(2)}
    env = WrongObservationEnv(spaces.Dict(spaces_by_key))
    adapted = adapt(env)
    adapted.keys = {key: adapted.keys[key] for key in keys}  # type: ignore[attr-defined]
    with pytest.raises(MerlError, match=message):
        adapted.reset()


@pytest.mark.parametrize("task", ["merl.envs.dot:whole", "merl.envs.dot:split"])
def test_the_dot_environment(task: str) -> None:
    env = make_user_env(task, "rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    returns = {}
    for name in ("straight", "still"):
        env.reset(seed=1)
        total, over = 0.0, False
        while not over:
            action = env.unwrapped.best_action()  # type: ignore[attr-defined]
            if name == "still":
                action = 0 * action
            _, reward, _, over, _ = env.step(action)
            total += float(reward)
        returns[name] = total
    assert returns["still"] < returns["straight"] <= 20
    assert env.reset(seed=1)[0]["image"][..., 0].any() == task.endswith("whole")
    assert np.asarray(env.render())[..., 0].any()


class ScriptedEnv(SpaceEnv):
    """An environment whose `reset` and `step` return given values."""

    def __init__(self, reset: Any = None, step: Any = None) -> None:
        super().__init__(spaces.Dict({"arm": vector(2), "eye": image(20, 30, 3)}))
        self.from_reset, self.from_step = reset, step

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.from_reset or (self.seen(), {})

    def step(self, action: Any) -> Any:
        return self.from_step(self.seen())

    def seen(self) -> dict[str, Any]:
        return {"arm": np.zeros(2), "eye": np.zeros((20, 30, 3), np.uint8)}


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (lambda o: (o, 0.0, False, {}), "step returned 4 values: it must return observation, "),
        (lambda o: None, "step returned NoneType"),
        (lambda o: (o, None, False, False, {}), "reward is None: it must be a number"),
        (lambda o: (o, np.zeros(2), False, False, {}), "reward is array"),
        (lambda o: (o, 0.0, np.zeros(2), False, {}), "terminated is array"),
        (lambda o: (o, 0.0, False, False, None), "info is None: it must be a dict"),
        (lambda o: (o, 0.0, False, False, {"reward_terms": [1]}), "must be a dict of numbers"),
        (lambda o: (o, 0.0, False, False, {"reward_terms": {"a": "b"}}), "reward term 'a' is 'b'"),
        (lambda o: (o, 0.0, False, False, {"success": np.zeros(2)}), "must be true or false"),
        (lambda o: (None, 0.0, False, False, {}), "observation is a NoneType"),
        (lambda o: ({"arm": o["arm"]}, 0.0, False, False, {}), "lacks 'eye'"),
        (lambda o: (o | {"arm": np.zeros(3)}, 0.0, False, False, {}), r"\(3,\), but its space"),
        (lambda o: (o | {"arm": ["a", "b"]}, 0.0, False, False, {}), "'arm' contains a value"),
        (lambda o: (o | {"eye": np.zeros((31, 32, 3), np.uint8)}, 0.0, False, False, {}),
         r"'eye' has shape \(31, 32, 3\)"),
        (lambda o: 1 / 0, r"raised ZeroDivisionError: division by zero \(test_user_envs.py, line"),
        (lambda o: sys.exit("no arm"), r"step raised SystemExit: no arm \(test_user_envs.py, line"),
    ],
)  # fmt: skip
def test_invalid_step_results_are_rejected(step: Any, message: str) -> None:
    env = adapt(ScriptedEnv(step=step))
    env.reset()
    with pytest.raises(EnvironmentFailed, match=message):
        env.step(np.zeros(2, np.float32))


def interrupted(observation: Any) -> Any:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("handler", "raised"),
    [
        (signal.default_int_handler, KeyboardInterrupt),  # the user's Ctrl-C may have raised it
        (signal.SIG_IGN, EnvironmentFailed),  # as in a worker process
        (lambda *_: None, EnvironmentFailed),  # as during training
    ],
)
def test_keyboard_interrupt_is_an_error_where_ctrl_c_does_not_raise_it(
    handler: Any, raised: type[BaseException]
) -> None:
    env = adapt(ScriptedEnv(step=interrupted))
    env.reset()
    former = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(raised, match=r"step raised KeyboardInterrupt|^$"):
            env.step(np.zeros(2, np.float32))
    finally:
        signal.signal(signal.SIGINT, former)


def test_common_types_of_step_results_are_accepted() -> None:
    env = adapt(ScriptedEnv(step=lambda o: (o, np.ones(1), np.bool_(True), 0, {"lap": None})))
    env.reset()
    _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (reward, terminated, truncated, info) == (1.0, True, False, {"lap": None})


def test_reset_without_info_is_rejected() -> None:
    given = ScriptedEnv(reset=({"arm": np.zeros(2)},))
    with pytest.raises(EnvironmentFailed, match="reset returned 1 value: it must return obs"):
        adapt(given).reset()


def test_nan_actions_do_not_reach_the_environment() -> None:
    given = SpaceEnv(vector(2))
    env = adapt(given)
    env.reset()
    with pytest.raises(NotFinite, match="not sent to the environment"):
        env.step(np.array([0.0, np.nan], np.float32))
    assert not hasattr(given, "received_action")


def test_keys_that_are_not_strings_and_missing_spaces_are_rejected() -> None:
    with pytest.raises(MerlError, match="has the key 1: use a string as key"):
        adapt(SpaceEnv(spaces.Dict({1: vector(2)})))  # type: ignore[dict-item]

    class Bare(gymnasium.Env[Any, Any]):
        pass

    with pytest.raises(MerlError, match="has no observation_space"):
        adapt(Bare())


def test_a_failing_close_only_warns(caplog: pytest.LogCaptureFixture) -> None:
    class Stuck(SpaceEnv):
        def close(self) -> None:
            raise OSError("the port is busy")

    adapt(Stuck(vector(2))).close()
    assert "close raised OSError: the port is busy" in caplog.text


def described_error(path: Path, code: str) -> str:
    """Return the description of the exception that `step` in this file raises."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(code)
    names: dict[str, Any] = {}
    exec(compile(code, str(path), "exec"), names)
    try:
        names["step"]()
    except Exception as error:
        return in_one_line(error)
    raise AssertionError


@pytest.mark.parametrize(
    ("inner", "raised"),
    [
        ("import json; json.loads('{')", "JSONDecodeError"),  # raised in the standard library
        ("import numpy; numpy.linalg.inv([[0.0]])", "LinAlgError"),  # in an installed package
        ("import gymnasium; gymnasium.make('No-v0')", "NameNotFound"),
        ("exec(compile('1 / 0', '<string>', 'exec'))", "ZeroDivisionError"),
        ("exec(compile('1 / 0', 'gone.py', 'exec'))", "ZeroDivisionError"),  # no such file
        ("import merl.envs as e; e.make_env('x')", "MerlError"),
        ("raise OSError('servo 3')", "OSError: servo 3"),
    ],
)
def test_errors_name_the_last_line_in_the_users_files(
    inner: str, raised: str, tmp_path: Path
) -> None:
    description = described_error(tmp_path / "arm.py", f"def step():\n    {inner}\n")
    assert description.startswith(raised)
    assert description.endswith("(arm.py, line 2)")


def test_errors_name_no_line_in_packages_merl_or_missing_files(tmp_path: Path) -> None:
    code = "def step():\n    raise OSError('servo 3')\n"
    installed = tmp_path / "lib" / "site-packages" / "driver.py"
    assert "driver.py" not in described_error(installed, code)
    assert described_error(tmp_path / "merl_arm.py", code).endswith("(merl_arm.py, line 2)")
    with patch("merl.core.user_code.__file__", str(tmp_path / "merl" / "core" / "user_code.py")):
        assert "dot.py" not in described_error(tmp_path / "merl" / "dot.py", code)
        assert described_error(tmp_path / "merl_arm" / "arm.py", code).endswith("(arm.py, line 2)")
    (tmp_path / "gone.py").write_text(code)
    names: dict[str, Any] = {}
    exec(compile(code, str(tmp_path / "gone.py"), "exec"), names)
    (tmp_path / "gone.py").unlink()
    with pytest.raises(OSError, match="servo") as caught:
        names["step"]()
    assert "gone.py" not in in_one_line(caught.value)


class UnprintableError(BaseException):
    """An exception that is not an `Exception`, and whose text cannot be read."""

    def __str__(self) -> str:
        raise RuntimeError


def raise_unprintable() -> None:
    raise UnprintableError


class LostCamera(dict[str, Any]):
    def __getitem__(self, key: str) -> Any:
        raise RuntimeError("camera lost")


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (lambda o: raise_unprintable(), r"step raised UnprintableError \(test_user_envs.py, line"),
        (lambda o: (LostCamera(o), 0.0, False, False, {}), "raised RuntimeError: camera lost"),
        (lambda o: (o, 0.0, False, False, LostCamera(success=True)), "RuntimeError: camera lost"),
    ],
)
def test_every_exception_of_user_code_is_reported_in_one_line(step: Any, message: str) -> None:
    env = adapt(ScriptedEnv(step=step))
    env.reset()
    with pytest.raises(EnvironmentFailed, match=message) as caught:
        env.step(np.zeros(2, np.float32))
    assert len(str(caught.value).splitlines()) == 1
