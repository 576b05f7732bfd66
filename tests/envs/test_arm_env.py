"""`ArmEnv` and `make_env`: spaces, episodes, seeds, settings."""

import warnings
from contextlib import closing
from dataclasses import fields

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from merl.core import MerlError
from merl.envs import EnvConfig, make_env
from merl.envs.registration import ENV_IDS, register
from merl.tasks import TASKS

ACTION = np.zeros(9, np.float32)


@pytest.fixture(scope="module")
def env_without_images():
    """An environment without images, which is fast."""
    env = make_env("reach_duplo", renderer="raster", observations=("proprio", "state"))
    yield env
    env.close()


def same(one, other):
    return all(np.array_equal(one[key], other[key]) for key in one) and one.keys() == other.keys()


def episode(env, steps=5, action_seed=0, **reset):
    noise = np.random.RandomState(action_seed)
    seen = [env.reset(**reset)[0]]
    for _ in range(steps):
        seen.append(env.step(noise.uniform(-1, 1, 9).astype(np.float32))[0])
    return seen


@pytest.mark.parametrize(
    ("task", "config"),
    [
        ("reach_duplo", {"proprio": "paper"}),
        ("reach_duplo", {"proprio": "full"}),
        ("move_box", {"proprio": "paper", "state": "relative"}),
        ("lift_box", {"proprio": "full", "occluded": True}),
    ],
)
def test_the_environment_passes_gymnasiums_checks(task, config):
    config = {**config, "observations": ("image", "proprio", "state")}
    env = make_env(task, renderer="raster", image_size=32, render_mode="rgb_array", **config)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for known in ("Box observation space m", "environment not having a spec"):
            warnings.filterwarnings("ignore", message=f".*{known}")
        check_env(env)
    env.close()


def test_spaces():
    env = make_env("reach_duplo", renderer="raster", observations=("image", "proprio", "state"))
    spaces = env.observation_space.spaces
    assert {key: (space.shape, space.dtype) for key, space in spaces.items()} == {
        "image": ((84, 84, 3), np.uint8),
        "proprio": ((24,), np.float32),
        "state": ((55,), np.float32),
    }
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (9,), np.float32)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.close()


def test_the_start_depends_only_on_the_seed(env_without_images):
    first = episode(env_without_images, seed=7)
    env_without_images.reset()
    env_without_images.step(ACTION)
    other = episode(env_without_images, seed=8)
    again = episode(env_without_images, seed=7)
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert not same(first[0], other[0])
    with_image = make_env("reach_duplo", renderer="raster", observations=("image", "state"))
    states = episode(with_image, seed=7)
    assert all(np.array_equal(a["state"], b["state"]) for a, b in zip(first, states, strict=True))
    with_image.close()


def test_episodes_differ_and_repeat_from_a_restored_generator(env_without_images):
    env_without_images.reset(seed=1)
    state = env_without_images.np_random.bit_generator.state
    second, third = episode(env_without_images), episode(env_without_images)
    assert not same(second[0], third[0])
    another = make_env("reach_duplo", renderer="raster", observations=("proprio", "state"))
    another.np_random.bit_generator.state = state
    assert all(same(a, b) for a, b in zip(second, episode(another), strict=True))
    assert all(same(a, b) for a, b in zip(third, episode(another), strict=True))
    another.close()


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_ends_by_truncation_at_250_steps(task):
    env = make_env(task, renderer="raster", observations=("proprio",))
    env.reset(seed=0)
    for step in range(1, 251):
        _, reward, terminated, truncated, info = env.step(ACTION)
        assert isinstance(reward, float)
        assert reward == sum(info["reward_terms"].values())
        assert terminated is False
        assert truncated is (step == 250)
    with pytest.raises(MerlError, match="reset"):
        env.step(ACTION)
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_the_episode_of_a_seed_does_not_depend_on_the_observations(task):
    environments = [
        make_env(
            task, renderer="raster", image_size=16, observations=("image", "proprio", "state")
        ),
        make_env(task, renderer="raster", proprio="full", observations=("proprio", "state")),
    ]
    one, other = (episode(env, seed=5) for env in environments)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a["state"], b["state"])
        np.testing.assert_array_equal(a["proprio"], b["proprio"][:24])
    for env in environments:
        env.close()


def test_info_has_success_distance_and_reward_terms(env_without_images):
    _, info = env_without_images.reset(seed=0)
    assert set(info) == {"success", "distance", "reward_terms"}
    physics, task = env_without_images._physics, env_without_images.task
    for distance in (0.03, 0.07):
        env_without_images.reset(seed=0)
        physics.data.qpos[-7:-4] = task.robot.tool_center_point(physics) - (0.0, 0.0, distance)
        physics.forward()
        _, reward, _, _, info = env_without_images.step(ACTION)
        assert info["success"] == float(info["distance"] <= 0.05)
        assert info["success"] == (distance < 0.05)
        assert reward == sum(info["reward_terms"].values())


def test_actions_are_clipped_joint_velocities(env_without_images):
    env_without_images.reset(seed=0)
    control = env_without_images._physics.data.ctrl
    greatest = env_without_images._physics.model.actuator_ctrlrange[:, 1]
    for action, share in ((ACTION + 1, 1.0), (ACTION - 0.5, -0.5), (ACTION + 1.2, 1.0)):
        env_without_images.step(action)
        np.testing.assert_allclose(control, share * greatest)
    assert greatest[:6] == pytest.approx(np.deg2rad([36, 36, 36, 48, 48, 48]))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(8), r"shape \(8,\)"),
        (np.zeros((1, 9)), r"shape \(1, 9\)"),
        (np.full(9, np.nan), "not finite"),
        (np.array([np.inf] + [0.0] * 8), "not finite"),
        (["a"] * 9, "not an array of numbers"),
        (["0.1"] * 9, "not an array of numbers"),
        (np.zeros(9, complex), "not an array of numbers"),
        ([[0.0], [0.0, 1.0]], "not an array of numbers"),
        (None, "not an array of numbers"),
    ],
)
def test_an_invalid_action_does_not_change_the_simulation(env_without_images, action, message):
    env_without_images.reset(seed=0)
    before = env_without_images._physics.get_state()
    with pytest.raises(MerlError, match=message) as error:
        env_without_images.step(action)
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(env_without_images._physics.get_state(), before)


@pytest.mark.parametrize(
    ("task", "config", "message"),
    [
        ("reach_dupol", {}, "did you mean 'reach_duplo'"),
        ("walk", {}, "choose from reach_duplo, move_box, lift_box"),
        ("reach_duplo", {"occluded": True}, "reach_duplo has no occluded form"),
        (
            "reach_duplo",
            {"renderer": "vulkan"},
            "'vulkan' is unknown: choose from gl, raster",
        ),
        ("reach_duplo", {"renderer": ["gl"]}, "is unknown: choose from gl, raster"),
        ("move_box", {"reward": "steep"}, "reward 'steep' is unknown: choose from paper, staged"),
        ("reach_duplo", {"proprio": "some"}, "proprio 'some' is unknown"),
        ("reach_duplo", {"image_size": 15}, "image-size must be at least 16 .*, not 15"),
        ("reach_duplo", {"image_size": 84.0}, "image-size must be a whole number, not 84.0"),
        ("reach_duplo", {"render_size": 0}, "render-size must be at least 16 .*, not 0"),
        (
            "reach_duplo",
            {"renderer": "raster", "samples": 5},
            "samples must be .* at most 4, not 5",
        ),
        ("reach_duplo", {"renderer": "raster", "samples": 4, "image_size": 600}, "at most 2048"),
        (
            "reach_duplo",
            {"renderer": "gl", "samples": 2},
            "samples is 2, and renderer 'gl' takes one .*: use renderer raster, or samples 1",
        ),
        ("reach_duplo", {"observations": ()}, r"observations is \(\): give a tuple"),
        ("reach_duplo", {"observations": "image"}, "observations is 'image': give a tuple"),
        ("reach_duplo", {"rendrer": "raster"}, "no setting 'rendrer': did you mean 'renderer'"),
        ("reach_duplo", {"image_size": 5000}, "image-size must be .* at most 2,048, not 5000"),
        ("reach_duplo", {"observations": ("sound",)}, "'sound' is unknown"),
        ("reach_duplo", {"renderer": "raster", "render_mode": "human"}, "render_mode 'human'"),
    ],
)
def test_an_invalid_setting_is_rejected_in_one_line(task, config, message):
    with pytest.raises(MerlError, match=message) as error:
        make_env(task, **config)
    assert "\n" not in str(error.value)


def test_keys_that_are_not_requested_are_not_computed(env_without_images, monkeypatch):
    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(env_without_images, "_renderer", refuse)
    observation, _ = env_without_images.reset(seed=0)
    assert list(observation) == ["proprio", "state"]
    env = make_env("reach_duplo", renderer="raster", image_size=16, observations=("image",))
    monkeypatch.setattr(env.task.robot, "proprio", refuse)
    assert list(env.reset(seed=0)[0]) == ["image"]
    env.close()


def test_reset_after_close_opens_the_environment_again():
    env = make_env(
        "move_box", renderer="raster", image_size=16, render_size=16, render_mode="rgb_array"
    )
    expected = [*episode(env, seed=3), env.render()]
    for _ in range(2):
        env.close()
        env.close()
        for call in (env.render, lambda: env.physics, lambda: env.step(ACTION)):
            with pytest.raises(MerlError, match=r"call reset\(\) first"):
                call()
        again = [*episode(env, seed=3), env.render()]
        assert all(same(a, b) for a, b in zip(expected[:-1], again[:-1], strict=True))
        np.testing.assert_array_equal(expected[-1], again[-1])
    env.close()


def test_reset_after_close_continues_the_same_generator():
    starts = []
    for closes in (False, True):
        env = make_env("reach_duplo", renderer="raster", observations=("state",))
        env.reset(seed=0)
        if closes:
            env.close()
        starts.append(env.reset()[0]["state"])
        env.close()
    np.testing.assert_array_equal(*starts)


def test_gymnasium_makes_every_task():
    register()
    register()
    assert set(ENV_IDS) == set(TASKS)
    settings = {"renderer": "raster", "observations": ("state",), "proprio": "full"}
    env = gymnasium.make("merl:merl/ReachDuplo-v0", **settings)
    assert env.unwrapped.config == EnvConfig(**settings)
    assert env.reset(seed=0)[0]["state"].shape == (55,)
    env.close()
    settings["occluded"] = True
    for env_id in ("merl/MoveBox-v0", "merl/LiftBox-v0"):
        env = gymnasium.make(env_id, **settings)
        assert env.unwrapped.config == EnvConfig(**settings)
        assert env.reset(seed=0)[0]["state"].shape == (58,)
        env.close()


def test_defaults_of_the_settings():
    assert {field.name: field.default for field in fields(EnvConfig)} == {
        "renderer": "raster",
        "image_size": 84,
        "samples": 1,
        "proprio": "paper",
        "state": "absolute",
        "observations": ("image", "proprio"),
        "occluded": False,
        "start": ("above",),
        "reward": "paper",
        "render_size": 480,
    }


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("key", ["depth", "wrist_depth"])
@pytest.mark.parametrize("task", TASKS)
def test_both_renderers_see_the_same_distances(task, key):
    config = {"observations": (key,), "image_size": 64}
    with (
        closing(make_env(task, renderer="gl", **config)) as gl,
        closing(make_env(task, renderer="raster", **config)) as raster,
    ):
        rng = np.random.default_rng(0)
        for step in range(30):
            if step % 10 == 0:
                one, two = (env.reset(seed=step)[0][key] for env in (gl, raster))
            else:
                action = rng.uniform(-1, 1, 9)
                one, two = (env.step(action)[0][key] for env in (gl, raster))
            difference = np.abs(one - two)
            assert np.quantile(difference, 0.98) < 0.015  # m; more at silhouettes alone
            nearest = (0.3, 1.0) if key == "depth" else (0.01, 0.2)  # the hand or the arm
            assert nearest[0] < one.min() < nearest[1]
            assert raster.observation_space[key].contains(two)


def test_depth_is_the_distance_along_the_cameras_axis():
    with closing(make_env("reach_duplo", observations=("depth",), image_size=65)) as env:
        observation, _ = env.reset(seed=0)
        physics = env.physics
        camera = physics.model.name2id("front_close", "camera")
        position = physics.data.cam_xpos[camera]
        axis = -physics.data.cam_xmat[camera].reshape(3, 3)[:, 2]
        distance = mujoco.mj_ray(
            physics.model.ptr, physics.data.ptr, position, axis, None, 1, -1, np.zeros(1, np.int32)
        )
        assert observation["depth"][32, 32, 0] == pytest.approx(distance, rel=0.02)


def test_touch_feels_the_grasp_of_a_box():
    config = {"observations": ("touch",), "start": ("holding",)}
    with closing(make_env("lift_box", **config)) as env:
        observation, _ = env.reset(seed=0)
        assert observation["touch"].shape == (7,)
        close = np.zeros(9)
        close[6:] = 1.0
        for _ in range(5):
            observation, *_ = env.step(close)
        forces = np.expm1(observation["touch"])
        palm, fingers = forces[0], forces[1:].reshape(3, 2).sum(axis=1)
        assert palm < 200
        assert (fingers > 1.0).sum() >= 2  # N; two fingers at least hold the box
        total = sum(contact_forces(env.physics))
        assert forces.sum() == pytest.approx(total, rel=0.5)


def contact_forces(physics):
    """Yield the normal force of each contact of the hand."""
    model, data = physics.model.ptr, physics.data.ptr
    for index, contact in enumerate(data.contact):
        bodies = [
            mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, model.geom_bodyid[geom]) or ""
            for geom in (contact.geom1, contact.geom2)
        ]
        if any("jaco_hand" in body for body in bodies):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, force)
            yield force[0]


def test_the_camera_at_the_wrist_moves_with_the_hand_and_sees_the_box():
    config = {"observations": ("wrist", "wrist_depth", "image"), "start": ("around",)}
    with closing(make_env("move_box", **config)) as env:
        first, _ = env.reset(seed=0)
        red = np.array(first["wrist"], int) @ [1, -1, -1] > 60
        assert red.mean() > 0.01
        assert 0.1 < np.median(first["wrist_depth"][red]) < 0.25  # m
        for _ in range(10):
            later, *_ = env.step(np.eye(9, dtype=np.float32)[0])
        difference = np.abs(later["wrist"].astype(int) - first["wrist"]).mean()
        assert difference > 5
        assert np.abs(later["wrist"].astype(int) - later["image"]).mean() > 5


def test_sensors_and_cameras_of_the_hand_do_not_change_the_simulation_or_the_images():
    plain = {"observations": ("image", "state"), "image_size": 32}
    felt = {"observations": ("image", "wrist", "touch", "state"), "image_size": 32}
    with (
        closing(make_env("move_box", **plain)) as one,
        closing(make_env("move_box", **felt)) as two,
    ):
        first, second = one.reset(seed=4)[0], two.reset(seed=4)[0]
        for step in range(20):
            for key in plain["observations"]:
                np.testing.assert_array_equal(first[key], second[key])
            action = np.random.default_rng(step).uniform(-1, 1, 9)
            first, second = one.step(action)[0], two.step(action)[0]
