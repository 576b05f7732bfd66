"""The rasteriser beside OpenGL and MuJoCo's own rays, on the tasks and on every geom type."""

import itertools
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
from dm_control import mujoco as dm_mujoco

from merl.core import MerlError
from merl.envs import make_env
from merl.envs.raster.renderer import RasterRenderer
from merl.envs.rendering import check_renderer
from merl.tasks import TASKS
from merl.tasks.jaco import CAMERA

EVERY_GEOM = """
<mujoco>
  <visual><map znear="0.05"/></visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.3 0.5 0.7" rgb2="0 0 0" width="64"
      height="64"/>
    <texture name="checks" type="2d" builtin="checker" rgb1="0.2 0.3 0.4" rgb2="0.6 0.7 0.8"
      width="64" height="64"/>
    <material name="checks" texture="checks" texrepeat="2 2" texuniform="true" specular="0"/>
    <material name="shiny" rgba="0.2 0.6 0.3 1" specular="1" shininess="0.8"/>
    <material name="glowing" rgba="0.8 0.2 0.2 1" emission="0.4"/>
    <mesh name="pyramid" vertex="-0.2 -0.2 0  0.2 -0.2 0  0.2 0.2 0  -0.2 0.2 0  0 0 0.4"/>
  </asset>
  <worldbody>
    <light pos="0.5 -0.5 2.5" dir="-0.2 0.2 -1" directional="true" diffuse="0.4 0.4 0.4"/>
    <light pos="-1 -1 2" dir="0.4 0.4 -0.8" cutoff="50" diffuse="0.5 0.5 0.4"/>
    <camera name="view" pos="0 -2.6 1.3" xyaxes="1 0 0 0 0.42 0.9"/>
    <camera name="inside" pos="0 -0.9 0.15" xyaxes="1 0 0 0 0.2 1"/>
    <geom type="plane" size="2 2 0.1" material="checks"/>
    <geom type="box" pos="-0.9 0 0.2" size="0.2 0.15 0.2" euler="0 0 30" rgba="0.7 0.2 0.1 1"/>
    <geom type="sphere" pos="-0.45 0 0.2" size="0.2" material="shiny"/>
    <geom type="capsule" pos="0 0 0.35" size="0.1 0.2" euler="20 0 0" rgba="0.2 0.2 0.7 1"/>
    <geom type="cylinder" pos="0.4 0 0.2" size="0.15 0.2" euler="0 20 0" rgba="0.7 0.7 0.1 1"/>
    <geom type="ellipsoid" pos="0.8 0 0.2" size="0.2 0.1 0.2" material="glowing"/>
    <geom type="mesh" mesh="pyramid" pos="0 0.6 0" rgba="0.5 0.1 0.6 1"/>
    <geom type="box" pos="0 -0.7 0.02" size="1 0.4 0.02" rgba="0.4 0.5 0.4 1"/>
    <geom type="box" pos="0 1 0.5" size="0.3 0.1 0.5" rgba="1 1 1 0"/>
    <geom type="sphere" pos="0 -1 0.5" size="0.3" group="3"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def opengl():
    try:
        check_renderer("gl")
    except MerlError:
        pytest.skip("no OpenGL library works on this machine")


@pytest.fixture(scope="module")
def every_geom():
    physics = dm_mujoco.Physics.from_xml_string(EVERY_GEOM)
    physics.forward()
    yield physics
    physics.free()


@pytest.fixture(params=TASKS)
def task(request):
    """A physics of each task after some random steps."""
    env = make_env(request.param, renderer="raster", observations=("proprio",))
    env.reset(seed=3)
    action = np.random.default_rng(2).uniform(-1, 1, 9).astype(np.float32)
    for _ in range(20):
        env.step(action)
    yield env.physics
    env.close()


def rays(physics, camera, size, visible=(1, 1, 1, 0, 0, 0)):
    """Depth (m) and geom of each pixel's centre, by MuJoCo's own ray casting; inf and -1: none."""
    model, data = physics.model.ptr, physics.data.ptr
    number = model.camera(camera).id
    eye, axes = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
    focal = 0.5 * size / np.tan(np.radians(model.cam_fovy[number]) / 2)
    centre = (np.arange(size) + 0.5 - size / 2) / focal
    depth, geom = np.full((size, size), np.inf), np.full((size, size), -1)
    found = np.zeros((1, 1), np.int32)
    for row, y in enumerate(-centre):
        for column, x in enumerate(centre):
            ray = axes @ (x, y, -1.0)
            norm = np.linalg.norm(ray)
            groups = np.array(visible, np.uint8)
            distance = mujoco.mj_ray(model, data, eye, ray / norm, groups, 1, -1, found)
            if distance >= 0:
                depth[row, column], geom[row, column] = distance / norm, found[0, 0]
    return depth, geom


def test_depth_and_geoms_are_those_of_mujocos_rays(every_geom):
    renderer = RasterRenderer(every_geom, "view", 48)
    depth, geom = rays(every_geom, "view", 48)
    mine = renderer.render_segmentation()
    assert set(np.unique(mine)) == {-1, *range(8)}  # every geom is seen but the two hidden ones
    same = mine == geom
    assert same.mean() > 0.985  # curved geoms are drawn with flat triangles
    seen = same & (geom >= 0)
    np.testing.assert_allclose(renderer.render_depth()[seen], depth[seen], rtol=0.01)
    assert np.isinf(renderer.render_depth()[mine < 0]).all()


def test_triangles_are_clipped_at_the_near_plane(every_geom):
    """The camera stands over a box that reaches behind it: its far part is still drawn."""
    renderer = RasterRenderer(every_geom, "inside", 48)
    depth, geom = rays(every_geom, "inside", 48)
    mine = renderer.render_segmentation()
    under = 7
    assert (geom == under).sum() > 100
    assert ((mine == under) == (geom == under)).mean() > 0.99
    near = (mine == under) & (geom == under)
    np.testing.assert_allclose(renderer.render_depth()[near], depth[near], rtol=1e-3)


def opengls(physics, camera, size):
    """Depth (m) and geom of each pixel, as OpenGL draws them; -1: no geom."""
    labels = physics.render(size, size, camera_id=camera, segmentation=True)
    geoms = np.where(labels[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, labels[..., 0], -1)
    return physics.render(size, size, camera_id=camera, depth=True), geoms


def assert_close(depth, theirs, seen):
    """Nearly everywhere: OpenGL's samples lie elsewhere in a pixel, which counts at edges."""
    assert (np.abs(depth - theirs)[seen] < 0.05 * theirs[seen]).mean() > 0.95


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("camera", ["view", "inside"])
def test_every_geom_has_opengls_silhouette_and_depth(every_geom, camera):
    renderer = RasterRenderer(every_geom, camera, 84)
    depth, geoms = opengls(every_geom, camera, 84)
    mine = renderer.render_segmentation()
    assert (mine == geoms).mean() > 0.98
    seen = (mine == geoms) & (geoms >= 0)
    assert seen.mean() > 0.3
    assert_close(renderer.render_depth(), depth, seen)


GEOMS = {
    "box": 'type="box" size="0.3 0.3 0.3"',
    "sphere": 'type="sphere" size="0.3"',
    "capsule": 'type="capsule" size="0.29 0.01"',
    "cylinder": 'type="cylinder" size="0.3 0.3"',
    "ellipsoid": 'type="ellipsoid" size="0.4 0.3 0.3"',
    "mesh": 'type="mesh" mesh="pyramid"',
    "plane": 'type="plane" size="1 1 1" pos="0 0 0.3"',
}


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("geom", GEOMS)
def test_the_near_plane_cuts_every_geom_as_in_opengl(geom):
    """The camera grazes the geom, nearer to it than the near plane."""
    physics = dm_mujoco.Physics.from_xml_string(
        f"""<mujoco><statistic extent="1"/><visual><map znear="0.2"/></visual>
        <asset><mesh name="pyramid" vertex="-1 -1 0  1 -1 0  1 1 0  -1 1 0  0 0 0.3"/></asset>
        <worldbody><camera name="view" pos="0.05 -0.3 0.4" xyaxes="1 0 0 0 0.5 0.9"/>
        <geom {GEOMS[geom]}/></worldbody></mujoco>"""
    )
    physics.forward()
    renderer = RasterRenderer(physics, "view", 64)
    depth, geoms = opengls(physics, "view", 64)
    mine = renderer.render_segmentation()
    assert 0.03 < (geoms >= 0).mean() < 0.97
    assert depth[geoms >= 0].min() < 0.21  # the near plane lies at 0.2 m
    assert (mine == geoms).mean() > 0.98
    seen = (mine == geoms) & (geoms >= 0)
    assert_close(renderer.render_depth(), depth, seen)
    physics.free()


@pytest.mark.usefixtures("opengl")
def test_every_geom_has_opengls_colours(every_geom):
    for samples, bar in ((1, 5.0), (2, 4.0)):
        mine = RasterRenderer(every_geom, "view", 84, samples).render().astype(int)
        theirs = every_geom.render(84, 84, camera_id="view").astype(int)
        assert np.abs(mine - theirs).mean() < bar


@pytest.mark.usefixtures("opengl")
def test_tasks_look_as_opengl_draws_them(task):
    drawn = task.render(84, 84, camera_id=CAMERA.name).astype(int)
    depth, geoms = opengls(task, CAMERA.name, 84)
    for samples in (1, 2):
        renderer = RasterRenderer(task, CAMERA.name, 84, samples)
        assert np.abs(renderer.render().astype(int) - drawn).mean() < 4.0
        if samples == 1:
            same = renderer.render_segmentation() == geoms
            assert same.mean() > 0.995
            seen = same & (geoms >= 0)
            assert_close(renderer.render_depth(), depth, seen)


def box_average(image, samples):
    size = len(image) // samples
    return image.reshape(size, samples, size, samples, 3).mean(axis=(1, 3))


@pytest.mark.parametrize(("size", "samples"), [(24, 3), (32, 2), (32, 4), (17, 1)])
def test_samples_are_the_box_average_of_a_larger_image(every_geom, size, samples):
    image = RasterRenderer(every_geom, "view", size, samples).render()
    larger = RasterRenderer(every_geom, "view", size * samples).render()
    np.testing.assert_allclose(image, box_average(larger, samples), atol=1)
    if samples > 1:  # and not one of the samples
        assert np.abs(image - larger[::samples, ::samples].astype(int)).mean() > 3


@pytest.mark.parametrize(("size", "samples"), [(24, 3), (32, 2), (32, 4)])
def test_samples_of_an_environment_average_its_larger_image(size, samples):
    """And so at every step; the picture for people is not averaged."""
    settings = {"renderer": "raster", "render_size": 64, "render_mode": "rgb_array"}
    small = make_env("move_box", image_size=size, samples=samples, **settings)
    larger = make_env("move_box", image_size=size * samples, **settings)
    assert small.observation_space["image"].shape == (size, size, 3)
    seen = [[env.reset(seed=0)[0]["image"]] for env in (small, larger)]
    for images, env in zip(seen, (small, larger), strict=True):
        images.append(env.step(np.full(9, 0.5, np.float32))[0]["image"])
    for image, whole in zip(*seen, strict=True):
        np.testing.assert_allclose(image, box_average(whole, samples), atol=1)
    np.testing.assert_array_equal(small.render(), larger.render())
    for env in (small, larger):
        env.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples": 0}, "samples is 0: give a whole number, at least 1 and at most 4"),
        ({"samples": 5}, "samples is 5: .* at most 4"),
        ({"samples": 2.0}, "samples is 2.0: give a whole number"),
        ({"samples": True}, "samples is True: give a whole number"),
        ({"samples": 2, "size": 1025}, "samples is 2 at 1025 pixels, .* at most 2048"),
        ({"size": 0}, "size is 0: .* at least 1"),
        ({"size": 2049}, "size is 2049: .* at most 2048"),
        ({"size": 8.5}, "size is 8.5: give a whole number"),
    ],
)
def test_sizes_and_samples_out_of_range_are_refused(every_geom, settings, message):
    with pytest.raises(MerlError, match=message) as error:
        RasterRenderer(every_geom, "view", **{"size": 32, **settings})
    assert "\n" not in str(error.value)


def test_depth_of_a_task_is_exact(task):
    renderer = RasterRenderer(task, CAMERA.name, 32)
    depth, geom = rays(task, CAMERA.name, 32)
    same = (renderer.render_segmentation() == geom) & (geom >= 0)
    assert same.mean() > 0.7  # the rest is the sky
    np.testing.assert_allclose(renderer.render_depth()[same], depth[same], rtol=5e-3)


def test_shadows_fall_and_move(every_geom):
    """The ball's shadow on the floor is darker than the floor beside it."""
    renderer = RasterRenderer(every_geom, "view", 84)
    lit = renderer.render()
    model = every_geom.model.ptr
    model.light_castshadow[:] = False
    bright = RasterRenderer(every_geom, "view", 84).render()
    model.light_castshadow[:] = True
    darker = (bright.astype(int) - lit).sum(-1) > 30
    assert 0.02 < darker.mean() < 0.4
    assert (bright >= lit).all()


def test_a_moved_camera_and_light_are_seen(every_geom):
    renderer = RasterRenderer(every_geom, "view", 48)
    before = renderer.render()
    np.testing.assert_array_equal(renderer.render(), before)
    data = every_geom.data.ptr
    kept = data.cam_xpos.copy(), data.light_xdir.copy()
    data.cam_xpos[0, 0] += 0.3
    moved = renderer.render()
    fresh = RasterRenderer(every_geom, "view", 48).render()
    np.testing.assert_array_equal(moved, fresh)
    data.cam_xpos[:] = kept[0]
    data.light_xdir[1] = (0.0, 0.0, -1.0)
    relit = renderer.render()
    assert np.abs(relit.astype(int) - before).max() > 10
    np.testing.assert_array_equal(relit, RasterRenderer(every_geom, "view", 48).render())
    data.light_xdir[:] = kept[1]
    np.testing.assert_array_equal(renderer.render(), before)


def in_two_threads(work):
    """What `work(0)` and `work(1)` return, called in two threads at the same time."""
    together = threading.Barrier(2)

    def begin(index):
        together.wait()
        return work(index)

    with ThreadPoolExecutor(2) as threads:
        return list(threads.map(begin, range(2)))


def test_two_threads_with_a_renderer_each_draw_what_one_draws(every_geom):
    expected = RasterRenderer(every_geom, "view", 48).render()

    def draw(_):
        renderer = RasterRenderer(every_geom, "view", 48)
        return [renderer.render() for _ in range(100)]

    for image in itertools.chain(*in_two_threads(draw)):
        np.testing.assert_array_equal(image, expected)


def test_two_threads_with_one_renderer_draw_what_one_draws(every_geom):
    renderer = RasterRenderer(every_geom, "view", 48)
    image, depth = renderer.render(), renderer.render_depth()
    for images in in_two_threads(lambda _: [renderer.render() for _ in range(300)]):
        for other in images:
            np.testing.assert_array_equal(other, image)
    with ThreadPoolExecutor(1) as another:
        np.testing.assert_array_equal(another.submit(renderer.render_depth).result(), depth)


def test_one_thread_at_a_time_compiles(every_geom, monkeypatch):
    """Warp crashes where several threads compile its kernels at the same time."""
    alone, record = threading.Lock(), RasterRenderer._record

    def record_alone(renderer):
        assert alone.acquire(blocking=False), "two threads compile"
        time.sleep(0.05)  # enough for the other thread to arrive
        alone.release()
        return record(renderer)

    monkeypatch.setattr(RasterRenderer, "_record", record_alone)
    in_two_threads(lambda _: RasterRenderer(every_geom, "view", 16))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            """<asset><hfield name="hills" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 1 0"/>
            </asset><worldbody><camera name="view"/>
            <geom name="ground" type="hfield" hfield="hills"/></worldbody>""",
            "cannot draw geom 'ground' of type hfield: use renderer 'gl'",
        ),
        (
            """<extension><plugin plugin="mujoco.sdf.torus"><instance name="ring"/></plugin>
            </extension><asset><mesh name="ring"><plugin instance="ring"/></mesh></asset>
            <worldbody><camera name="view"/>
            <geom type="sdf" mesh="ring"><plugin instance="ring"/></geom></worldbody>""",
            "cannot draw geom 'number 0' of type sdf: use renderer 'gl'",
        ),
        (
            """<worldbody><camera name="view"/><flexcomp name="cloth" type="grid" count="3 3 1"
            spacing="0.1 0.1 0.1" dim="2" radius="0.01"/></worldbody>""",
            "cannot draw the model's 1 flexes and 0 skins: use renderer 'gl'",
        ),
        (
            '<worldbody><camera name="front"/><camera name="side"/></worldbody>',
            "has no camera 'view': choose from front, side",
        ),
        (
            '<worldbody><camera name="view" projection="orthographic"/></worldbody>',
            "cannot draw camera 'view', which is orthographic",
        ),
    ],
    ids=["hfield", "sdf", "flex", "no such camera", "orthographic"],
)
def test_what_cannot_be_drawn_is_named_in_one_line(model, message):
    physics = dm_mujoco.Physics.from_xml_string(f"<mujoco>{model}</mujoco>")
    with pytest.raises(MerlError, match=message) as error:
        RasterRenderer(physics, "view", 32)
    assert "\n" not in str(error.value)
    physics.free()


@pytest.mark.parametrize(
    "body",
    [
        "",
        '<geom type="plane" size="1 1 1"/>',
        '<geom type="box" size="1 1 1"/><light pos="0 0 3" type="point"/>',
    ],
    ids=["nothing", "a plane alone", "no plane"],
)
def test_scenes_that_lack_planes_triangles_or_lights_are_drawn(body):
    physics = dm_mujoco.Physics.from_xml_string(
        f"""<mujoco><visual><headlight active="0"/></visual><worldbody>
        <camera name="view" pos="0 0 4"/>{body}</worldbody></mujoco>"""
    )
    renderer = RasterRenderer(physics, "view", 16)
    assert renderer.render().shape == (16, 16, 3)
    assert (renderer.render_segmentation() >= 0).any() == bool(body)
    physics.free()
