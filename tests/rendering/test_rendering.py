"""Both renderers: compared with each other, and each one where the other cannot work."""

import os
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from dm_control import manipulation

from merl.envs import make_env
from merl.rendering import warp_runtime


@pytest.fixture(scope="module")
def raster_env():
    env = make_env("reach_duplo", renderer="raster", render_mode="rgb_array")
    env.reset()  # compiles, so that later interpreters print nothing
    yield env
    env.close()


@pytest.fixture(scope="module")
def gl_env(opengl):
    env = make_env("reach_duplo", renderer="gl", render_mode="rgb_array")
    yield env
    env.close()


def run(code, **environment):
    """Run code in a new interpreter, without environment variables that select an OpenGL."""
    inherited = {name: value for name, value in os.environ.items() if "GL" not in name}
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )


STEP = """
from merl.envs import make_env
env = make_env("reach_duplo", renderer="{renderer}", render_mode="rgb_array")
observation, _ = env.reset(seed=0)
observation, *_ = env.step(env.action_space.sample())
assert observation["image"].std() > 20
assert env.render().shape == (480, 480, 3)
"""


def test_gl_equals_dm_controls_camera_bit_for_bit(gl_env):
    reference = manipulation.load("reach_duplo_vision")
    spec = reference.action_spec()
    noise = np.random.RandomState(0)
    for seed in range(2):
        observation, _ = gl_env.reset(seed=seed)
        # Our reset draws the seed of dm_control's episode.
        start = np.random.default_rng(seed).integers(2**32, dtype=np.uint32)
        reference._random_state = np.random.RandomState(start)
        timestep = reference.reset()
        np.testing.assert_array_equal(observation["image"], timestep.observation["front_close"][0])
        action = noise.uniform(-1, 1, 9)
        timestep = reference.step(spec.minimum + (action + 1) / 2 * (spec.maximum - spec.minimum))
        observation = gl_env.step(action)[0]
        np.testing.assert_array_equal(observation["image"], timestep.observation["front_close"][0])
    reference.close()


def test_raster_is_close_to_gl(gl_env, raster_env):
    for seed in range(3):
        drawn = gl_env.reset(seed=seed)[0]["image"].astype(int)
        rasterized = raster_env.reset(seed=seed)[0]["image"].astype(int)
        assert np.abs(drawn - rasterized).mean() < 8.0


def red(image):
    """Return a mask of the pixels with the brick's colour, (H, W) bool."""
    r, g, b = np.moveaxis(image.astype(int), -1, 0)
    return (r > 120) & (g < 60) & (b < 60)


def black(image):
    """Return a mask of the pixels with the arm's colour, (H, W) bool."""
    return (image < 40).all(axis=-1)


@pytest.mark.parametrize("renderer", ["raster", "gl"])
def test_brick_and_arm_are_visible(renderer, request):
    env = request.getfixturevalue(f"{renderer}_env")
    for seed in range(5):
        small = env.reset(seed=seed)[0]["image"]
        large = env.render()
        assert small.shape == (84, 84, 3)
        assert large.shape == (480, 480, 3)
        for image in (small, large):
            assert red(image).sum() >= image.shape[0] ** 2 * 3e-4  # the hand may cover some
            assert black(image).mean() > 0.02
        # The camera looks along +y: a larger x of the brick is further to the right in the image.
        column = np.nonzero(red(large))[1].mean() / 480 - 0.5
        across = env.task.prop_position(env._physics)[0]
        assert abs(column - across) < 0.15


@pytest.mark.parametrize("renderer", ["raster", "gl"])
def test_the_mark_of_move_box_is_visible(renderer, request):
    if renderer == "gl":
        request.getfixturevalue("opengl")
    env = make_env("move_box", renderer=renderer)

    def green_pixels(box):
        env._physics.data.qpos[-7:-4] = box
        env._physics.forward()
        red, green, blue = np.moveaxis(env._read("image").astype(int), 2, 0)
        return int(((green > 2 * red) & (green > 2 * blue) & (green > 60)).sum())

    env.reset(seed=0)
    away, near = green_pixels((0.1, 0.1, 0.025)), green_pixels((0.01, -0.2, 0.025))
    env.close()
    assert 110 < away < 190  # about 140 of 84 x 84
    assert 0.25 * away < near < 0.75 * away


def test_images_are_new_arrays_and_show_the_motion_of_the_arm(raster_env):
    first = raster_env.reset(seed=0)[0]["image"]
    kept = first.copy()
    for _ in range(10):
        later = raster_env.step(np.ones(9, np.float32))[0]["image"]
    np.testing.assert_array_equal(first, kept)
    assert (first != later).mean() > 0.02
    np.testing.assert_array_equal(raster_env.reset(seed=0)[0]["image"], kept)


def test_two_threads_get_the_same_images_as_one():
    def images(seed):
        env = make_env("reach_duplo", renderer="raster", image_size=32)
        seen = [env.reset(seed=seed)[0]["image"]]
        seen += [env.step(np.ones(9, np.float32))[0]["image"] for _ in range(10)]
        env.close()
        return np.stack(seen)

    with ThreadPoolExecutor(2) as threads:
        together = list(threads.map(images, [0, 1]))
    for seed, seen in enumerate(together):
        np.testing.assert_array_equal(seen, images(seed))


def test_a_forked_process_can_render(raster_env):
    done = run(
        """
        import multiprocessing
        from merl.envs import make_env

        env = make_env("reach_duplo", renderer="raster", image_size=16)

        here = env.reset(seed=0)[0]["image"]
        fork = multiprocessing.get_context("fork")
        results = fork.Queue()
        child = fork.Process(target=lambda: results.put(env.reset(seed=0)[0]["image"]))
        child.start()
        there = results.get(timeout=600)
        child.join()
        print((there == here).all())
        """
    )
    assert (done.stdout.split(), done.returncode) == (["True"], 0), done.stderr


@pytest.mark.parametrize("size", [16, 700])
@pytest.mark.parametrize("renderer", ["raster", "gl"])
def test_small_and_large_images(renderer, size, request):
    if renderer == "gl":
        request.getfixturevalue("opengl")
    env = make_env("reach_duplo", renderer=renderer, image_size=16, render_size=size,
                   render_mode="rgb_array")  # fmt: skip
    assert env.reset(seed=0)[0]["image"].shape == (16, 16, 3)
    assert env.render().shape == (size, size, 3)
    env.close()


def test_raster_needs_no_opengl_and_prints_nothing_at_exit(raster_env):
    done = run(STEP.format(renderer="raster"), MUJOCO_GL="disabled")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_default_environment_works_without_the_requested_opengl(raster_env):
    code = """
    import gymnasium, merl
    for env in (gymnasium.make("merl:merl/ReachDuplo-v0"), merl.make_env("reach_duplo")):
        assert env.reset(seed=0)[0]["image"].std() > 20
        print(env.unwrapped.config.renderer)
        env.close()
    """
    done = run(HIDE_OPENGL + textwrap.dedent(code), MUJOCO_GL="egl")
    assert (done.returncode, done.stdout, done.stderr) == (0, "raster\nraster\n", "")


HIDE_OPENGL = """
import ctypes, ctypes.util
load, find = ctypes.CDLL.__init__, ctypes.util.find_library
def hidden(name):
    return any(part in str(name) for part in ("EGL", "OSMesa", "GL", "glfw"))
def load_others(self, name=None, *args, **kwargs):
    if name and hidden(name):
        raise OSError(f"{name}: hidden")
    load(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = load_others
ctypes.util.find_library = lambda name: None if hidden(name) else find(name)
"""


def test_gl_without_opengl_names_the_solutions():
    code = """
    from merl.core import MerlError
    from merl.envs import make_env
    try:
        make_env("reach_duplo", renderer="gl")
    except MerlError as error:
        print(error)
    make_env("reach_duplo", renderer="gl", observations=("state",)).reset(seed=0)
    """
    done = run(HIDE_OPENGL + textwrap.dedent(code))
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) == 1
    for word in ("libegl1", "libosmesa6", "--renderer raster"):
        assert word in done.stdout


def test_gl_prints_nothing_at_exit_without_close(opengl):
    done = run(STEP.format(renderer="gl"))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_gl_after_raster_in_one_process(opengl, raster_env):
    done = run(STEP.format(renderer="raster") + STEP.format(renderer="gl"))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_slow_compiling_prints_a_notice(capsys):
    with warp_runtime.compiling(0.1) as watching:
        while watching.is_alive():  # like compiling, this loop takes processor time
            pass
    assert capsys.readouterr().err == "merl: compiling the renderer (only once, 5 to 20 s)\n"


def test_waiting_for_a_busy_processor_prints_no_notice(capsys):
    with warp_runtime.compiling(0.2) as watch:
        time.sleep(0.5)  # as if another process had the processor
    watch.join()
    assert capsys.readouterr().err == ""


def test_raster_works_without_a_home(tmp_path):
    code = "from merl.rendering import warp_runtime; warp_runtime.start_warp(); import warp;"
    code += "print(warp.config.kernel_cache_dir)"
    home = tmp_path / "a file, so that no folder can be made in it"
    home.touch()
    settings = {"HOME": str(home), "XDG_CACHE_HOME": "", "TMPDIR": str(tmp_path)}
    done = run(code, **settings)
    assert done.returncode == 0
    assert done.stdout.startswith(str(tmp_path))
    assert done.stderr == ""


def test_importing_merl_envs_loads_no_simulator():
    done = run(
        """
        import sys
        import merl.envs, merl.envs.registration
        print({"torch", "mujoco", "dm_control", "warp"} & set(sys.modules))
        """
    )
    assert (done.stdout.strip(), done.stderr) == ("set()", "")
