"""`ReachDuplo` compared with dm_control's `reach_duplo`."""

import subprocess
import sys

import numpy as np
import pytest
from dm_control import manipulation

from episodes import Episodes, check_starts, check_uniform
from merl.core import MerlError
from merl.tasks import TASKS, ReachDuplo, simulator


@pytest.fixture(scope="module")
def ours():
    return Episodes("reach_duplo")


@pytest.fixture(scope="module")
def theirs():
    """dm_control's task, which recompiles the model in every episode."""
    environment = manipulation.load("reach_duplo_features")

    def start(seed):
        environment._random_state = np.random.RandomState(seed)
        return environment, environment.reset()

    return start


def assert_same_start(ours, theirs, seed):
    physics = ours.start(seed)
    reference = theirs(seed)[0].physics
    np.testing.assert_allclose(physics.data.qpos, reference.data.qpos, rtol=0, atol=1e-6)
    np.testing.assert_allclose(physics.data.qvel, reference.data.qvel, rtol=0, atol=1e-6)


def test_starts_equal_those_of_dm_control(ours, theirs):
    for seed in range(5):
        assert_same_start(ours, theirs, seed)


@pytest.mark.long
def test_100_starts_equal_those_of_dm_control(ours, theirs):
    for seed in range(100):
        assert_same_start(ours, theirs, seed)


def test_motion_and_proprioception_equal_those_of_dm_control(ours, theirs):
    physics = ours.start(0)
    environment, timestep = theirs(0)
    spec = environment.action_spec()
    noise = np.random.RandomState(0)
    keys = ["joints_pos", "joints_vel", "jaco_hand/joints_pos", "jaco_hand/joints_vel"]
    keys += ["joints_torque", "jaco_hand/pinch_site_pos", "jaco_hand/pinch_site_rmat"]
    prop = ["position", "orientation", "linear_velocity", "angular_velocity"]
    for _ in range(10):
        expected = [timestep.observation["jaco_arm/" + key].ravel() for key in keys]
        expected += [timestep.observation["duplo2x4/" + key].ravel() for key in prop]
        state = ours.task.state(physics)
        np.testing.assert_allclose(state, np.concatenate(expected), rtol=1e-6, atol=1e-7)
        np.testing.assert_array_equal(ours.task.robot.proprio(physics, "full"), state[:42])
        np.testing.assert_array_equal(ours.task.robot.proprio(physics), state[:24])
        relative = ours.task.state(physics, "relative")
        np.testing.assert_array_equal(relative[:55], state)
        way = ours.task.prop_position(physics) - ours.task.robot.tool_center_point(physics)
        np.testing.assert_array_equal(relative[55:], np.float32(way))
        action = noise.uniform(spec.minimum, spec.maximum)
        timestep = environment.step(action)
        physics.set_control(action)
        physics.step(ours.task.physics_steps_per_control_step)
        assert ours.task.get_reward(physics) == pytest.approx(timestep.reward, abs=1e-12)


def test_reward_equals_that_of_dm_control_at_every_distance(ours, theirs):
    physics, (environment, _) = ours.start(3), theirs(3)
    reference = environment.physics
    draw = np.random.RandomState(0)
    distances = draw.uniform(0.0, 0.15, 300)
    assert np.histogram(distances, bins=5, range=(0, 0.15))[0].min() > 30
    for distance in distances:
        direction = draw.normal(size=3)
        offset = distance * direction / np.linalg.norm(direction)
        for simulation in (physics, reference):  # the brick's free joint is the last
            simulation.data.qpos[-7:-4] = ours.task.robot.tool_center_point(physics) + offset
            simulation.forward()
        reward = ours.task.get_reward(physics)
        assert reward == pytest.approx(environment.task.get_reward(reference), abs=1e-9)
        assert 0.0 <= reward <= 1.0
        assert ours.task.distance(physics) == pytest.approx(distance, abs=1e-9)
        assert ours.task.success(physics) == (ours.task.distance(physics) <= 0.05)


def test_starts_are_in_their_regions(ours):
    check_starts(ours, range(30), resting_height=0.0)


@pytest.mark.long
def test_yaw_and_finger_closure_at_the_start_are_uniform(ours):
    check_uniform(*check_starts(ours, range(500), resting_height=0.0))


def test_reach_duplo_is_in_the_list_of_tasks():
    assert TASKS["reach_duplo"] is ReachDuplo


def test_a_wrong_simulator_version_is_rejected_in_one_line(monkeypatch):
    monkeypatch.setattr(simulator, "version", lambda _: "4.0.0")
    with pytest.raises(MerlError, match=r"merl needs mujoco 3\.17\.0, found 4\.0\.0: pip install"):
        simulator.check_versions()


def test_importing_the_tasks_leaves_python_s_warnings_as_they_were():
    """dm_control lets Python show every deprecation, in every package."""
    shown = "[w for w in warnings.filters if (w[0], w[2]) == ('always', DeprecationWarning)]"
    code = f"import warnings, merl.tasks; assert not {shown}"
    subprocess.run([sys.executable, "-c", code], check=True)
