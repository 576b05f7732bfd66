"""Another arm works in merl's own task: its starts, its motion, its senses, and training."""

from __future__ import annotations

import sys
import types
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from merl.cli import main
from merl.core import MerlError
from merl.tasks.arm_task import HAND_SPAWN

EXAMPLES = Path(__file__).parents[2] / "examples"
# The Panda's joints, with simple geoms and the parts of a Menagerie file that the example replaces.
LINKS = [
    ('pos="0 0 0.333"', "-2.9 2.9"),
    ('quat="1 -1 0 0"', "-1.76 1.76"),
    ('pos="0 -0.316 0" quat="1 1 0 0"', "-2.9 2.9"),
    ('pos="0.0825 0 0" quat="1 1 0 0"', "-3.07 -0.07"),
    ('pos="-0.0825 0.384 0" quat="1 -1 0 0"', "-2.9 2.9"),
    ('quat="1 1 0 0"', "-0.02 3.75"),
    ('pos="0.088 0 0" quat="1 1 0 0"', "-2.9 2.9"),
]
FINGER = """
<body name="{0}_finger" pos="0 0 0.0584" quat="{1}">
  <joint name="finger_{0}" type="slide" axis="0 1 0" range="0 0.04"/>
  <geom type="box" size="0.01 0.005 0.025" pos="0 0.005 0.027"/>
</body>"""


def small_model() -> str:
    """Return the MJCF of the arm."""
    body = '<body name="hand" pos="0 0 0.107" quat="0.9238795 0 0 -0.3826834">'
    body += '<geom type="box" size="0.02 0.1 0.03" pos="0 0 0.03"/>'
    body += FINGER.format("left", "1 0 0 0") + FINGER.format("right", "0 0 0 1") + "</body>"
    geom = '<geom size="0.06" mass="2" contype="0" conaffinity="0"/>'
    for n, (place, limits) in reversed([*enumerate(LINKS, 1)]):
        joint = f'<joint name="joint{n}" axis="0 0 1" range="{limits}"/>'
        body = f'<body name="link{n}" {place}>{joint}{geom}{body}</body>'
    return f"""<mujoco model="panda">
    <compiler angle="radian" autolimits="true"/>
    <option integrator="implicit"/>
    <worldbody><body name="link0"><geom type="box" size="0.08 0.08 0.06"/>{body}</body></worldbody>
    <tendon><fixed name="split"><joint joint="finger_left" coef="1"/></fixed></tendon>
    <equality><joint joint1="finger_left" joint2="finger_right"/></equality>
    <actuator><position joint="joint1"/><position tendon="split"/></actuator>
    <keyframe><key name="home" qpos="0 0 0 -1.6 0 1.6 -0.8 0.04 0.04"/></keyframe></mujoco>"""


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Import the example anew, since its settings are constants."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.delitem(sys.modules, "franka_reach", raising=False)
    import franka_reach

    return franka_reach


@pytest.fixture(params=["package", "file"])
def arm(
    request: pytest.FixtureRequest, module: types.ModuleType, tmp_path: Path
) -> types.ModuleType:
    """Return the example with the packaged model, and with a user's own file."""
    if request.param == "file":
        module.MODEL, module.TCP = tmp_path / "panda.xml", 0.21
        module.MODEL.write_text(small_model())
    elif find_spec("gymnasium_robotics") is None:
        pytest.skip("gymnasium-robotics is not installed")
    return module


def joints(env: Any) -> Any:
    return env.physics.bind(env.task.robot.arm.joints)


def move_to(env: Any, offset: tuple[float, float, float], steps: int) -> tuple[Any, Any]:
    """Move the hand straight to a point near the brick, and return the last observation, info."""
    robot, physics = env.task.robot, env.physics
    site = physics.bind(robot.hand.tool_center_point).element_id
    dofs = physics.model.jnt_dofadr[joints(env).element_id]
    jacobian = np.zeros((6, physics.model.nv))
    for _ in range(steps):
        mujoco.mj_jacSite(physics.model.ptr, physics.data.ptr, jacobian[:3], jacobian[3:], site)
        way = env.task.prop_position(physics) + offset - robot.tool_center_point(physics)
        speed = 5 * way * min(1, 0.06 / np.linalg.norm(way))
        turning = np.linalg.pinv(jacobian[:, dofs]) @ [*speed, 0, 0, 0]
        observation, _, _, _, info = env.step(env.action_for(np.append(turning, 0)))
    return observation, info


def test_the_hand_starts_in_its_region_and_points_down(arm: types.ModuleType) -> None:
    env = arm.make_env()
    positions = []
    for seed in range(20):
        observation, info = env.reset(seed=seed)
        assert observation in env.observation_space
        low, high = joints(env).range.T
        assert (joints(env).qpos >= low).all()
        assert (joints(env).qpos <= high).all()
        assert env.task.robot.tilt_cosine(env.physics) > 0.98
        positions.append(env.task.robot.tool_center_point(env.physics))
        assert info["distance"] > 0.15
    assert (np.array(HAND_SPAWN.lower) - 0.001 <= positions).all()
    assert (np.array(HAND_SPAWN.upper) + 0.001 >= positions).all()
    assert np.std(positions, axis=0).min() > 0.03


def test_actions_are_velocities_and_zero_holds_the_arm(arm: types.ModuleType) -> None:
    env = arm.make_env()
    env.reset(seed=0)
    before = joints(env).qpos.copy()
    for _ in range(50):
        env.step(np.zeros(8))
    np.testing.assert_allclose(joints(env).qpos, before, rtol=0, atol=0.01)
    for _ in range(10):
        env.step(np.eye(8)[0])
    assert joints(env).qvel[0] == pytest.approx(arm.VELOCITY, rel=0.05)
    for sign, width in ((-1.0, 0.0), (1.0, 0.04)):
        for _ in range(30):
            env.step(sign * np.eye(8)[7])
        fingers = env.physics.bind(env.task.robot.hand.joints).qpos
        np.testing.assert_allclose(fingers, width, rtol=0, atol=0.002)


def test_fingers_move_along_the_hand_s_x_axis(arm: types.ModuleType) -> None:
    env = arm.make_env()
    env.reset(seed=0)
    hand = env.task.robot.hand
    env.physics.bind(hand.joints).qpos = 0.04
    env.physics.forward()
    left, right = (env.physics.bind(joint.parent.geom[0]).xpos for joint in hand.joints)
    axis = env.physics.bind(hand.tool_center_point).xmat.reshape(3, 3)[:, 0]
    assert (left - right) @ axis == pytest.approx(np.linalg.norm(left - right), rel=0.01)


def test_a_straight_motion_solves_the_task(arm: types.ModuleType) -> None:
    env = arm.make_env()
    for seed in range(5):
        env.reset(seed=seed)
        _, info = move_to(env, (0, 0, 0.03), 60)
        assert info["success"] == info["reward_terms"]["reaching"] == 1.0


def test_senses_see_the_brick_and_feel_the_floor(arm: types.ModuleType) -> None:
    env = arm.make_env("rgb_array", ("image", "wrist", "proprio", "touch", "state"))
    observation, _ = env.reset(seed=1)
    assert observation["proprio"].shape == (25,)  # 7 angles as sine and cosine, 2 fingers
    assert not observation["touch"].any()
    red, green, _ = np.moveaxis(observation["image"].astype(int), -1, 0)
    assert (red > 2 * green + 50).any()
    assert env.render().shape == (480, 480, 3)
    observation, _ = move_to(env, (0.1, 0, -0.02), 60)
    assert observation["touch"].shape == (3,)
    assert observation["touch"].max() > 1


def test_training_runs_in_one_command(
    arm: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    small = ["--steps", "60", "--random-steps", "20", "--seed-steps", "20", "--threads", "1"]
    small += ["--replay.batch-size", "8", "--agent.precision", "fp32", "--eval.episodes", "1"]
    command = ["train", "franka_reach:make_env", "--preset", "laptop", *small, "--run-dir", "run"]
    assert main(command) == 0
    assert list((tmp_path / "run").rglob("*.mp4"))


def test_a_missing_model_is_named_in_one_line(
    module: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(MerlError, match="pip install --no-deps gymnasium-robotics, or"):
        module.make_env()
    monkeypatch.setattr(module, "MODEL", Path("no/panda.xml"))
    with pytest.raises(MerlError, match=r"model no/panda.xml does not exist: correct MODEL in"):
        module.make_env()
