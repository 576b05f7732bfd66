"""The rasteriser compared with OpenGL and MuJoCo's rays, on the tasks and on every geom type."""

import mujoco
import numpy as np
import pytest
from dm_control import mujoco as dm_mujoco

from merl.envs import make_env
from merl.rendering.raster.renderer import RasterRenderer
from merl.tasks import TASKS
from merl.tasks.arm_task import CAMERA


@pytest.fixture(params=TASKS)
def task(request):
    """The physics of each task after some random steps."""
    env = make_env(request.param, renderer="raster", observations=("proprio",))
    env.reset(seed=3)
    action = np.random.default_rng(2).uniform(-1, 1, 9).astype(np.float32)
    for _ in range(20):
        env.step(action)
    yield env.physics
    env.close()


def rays(physics, camera, size, visible=(1, 1, 1, 0, 0, 0)):
    """Return depth (m) and geom at each pixel's centre from MuJoCo's rays; inf and -1 if none."""
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


def test_depth_and_geoms_equal_those_of_mujocos_rays(every_geom):
    renderer = RasterRenderer(every_geom, "view", 48)
    depth, geom = rays(every_geom, "view", 48)
    drawn_geoms = renderer.render_segmentation()
    assert set(np.unique(drawn_geoms)) == {-1, *range(8)}  # all geoms but the two hidden ones
    same = drawn_geoms == geom
    assert same.mean() > 0.985  # curved geoms are drawn with flat triangles
    seen = same & (geom >= 0)
    np.testing.assert_allclose(renderer.render_depth()[seen], depth[seen], rtol=0.01)
    assert np.isinf(renderer.render_depth()[drawn_geoms < 0]).all()


def test_triangles_are_clipped_at_the_near_plane(every_geom):
    """The camera is above a box that extends behind it; the part in front is still drawn."""
    renderer = RasterRenderer(every_geom, "inside", 48)
    depth, geom = rays(every_geom, "inside", 48)
    drawn_geoms = renderer.render_segmentation()
    box_geom = 7
    assert (geom == box_geom).sum() > 100
    assert ((drawn_geoms == box_geom) == (geom == box_geom)).mean() > 0.99
    near = (drawn_geoms == box_geom) & (geom == box_geom)
    np.testing.assert_allclose(renderer.render_depth()[near], depth[near], rtol=1e-3)


def opengl_depth_and_geoms(physics, camera, size):
    """Return depth (m) and geom of each pixel from OpenGL; -1 if there is no geom."""
    labels = physics.render(size, size, camera_id=camera, segmentation=True)
    geoms = np.where(labels[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, labels[..., 0], -1)
    return physics.render(size, size, camera_id=camera, depth=True), geoms


def assert_close(depth, expected, seen):
    """Check depths nearly everywhere; edges differ, as OpenGL samples pixels at other points."""
    assert (np.abs(depth - expected)[seen] < 0.05 * expected[seen]).mean() > 0.95


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("camera", ["view", "inside"])
def test_every_geom_has_the_silhouette_and_depth_of_opengl(every_geom, camera):
    renderer = RasterRenderer(every_geom, camera, 84)
    depth, geoms = opengl_depth_and_geoms(every_geom, camera, 84)
    drawn_geoms = renderer.render_segmentation()
    assert (drawn_geoms == geoms).mean() > 0.98
    seen = (drawn_geoms == geoms) & (geoms >= 0)
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
def test_the_near_plane_clips_every_geom_as_in_opengl(geom):
    """The camera is closer to the geom than the near plane."""
    physics = dm_mujoco.Physics.from_xml_string(
        f"""<mujoco><statistic extent="1"/><visual><map znear="0.2"/></visual>
        <asset><mesh name="pyramid" vertex="-1 -1 0  1 -1 0  1 1 0  -1 1 0  0 0 0.3"/></asset>
        <worldbody><camera name="view" pos="0.05 -0.3 0.4" xyaxes="1 0 0 0 0.5 0.9"/>
        <geom {GEOMS[geom]}/></worldbody></mujoco>"""
    )
    physics.forward()
    renderer = RasterRenderer(physics, "view", 64)
    depth, geoms = opengl_depth_and_geoms(physics, "view", 64)
    drawn_geoms = renderer.render_segmentation()
    assert 0.03 < (geoms >= 0).mean() < 0.97
    assert depth[geoms >= 0].min() < 0.21  # the near plane lies at 0.2 m
    assert (drawn_geoms == geoms).mean() > 0.98
    seen = (drawn_geoms == geoms) & (geoms >= 0)
    assert_close(renderer.render_depth(), depth, seen)
    physics.free()


@pytest.mark.usefixtures("opengl")
def test_every_geom_has_the_colours_of_opengl(every_geom):
    for samples, bar in ((1, 5.0), (2, 4.0)):
        image = RasterRenderer(every_geom, "view", 84, samples).render().astype(int)
        expected = every_geom.render(84, 84, camera_id="view").astype(int)
        assert np.abs(image - expected).mean() < bar


@pytest.mark.usefixtures("opengl")
def test_images_of_tasks_are_close_to_opengl(task):
    drawn = task.render(84, 84, camera_id=CAMERA.name).astype(int)
    depth, geoms = opengl_depth_and_geoms(task, CAMERA.name, 84)
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
    if samples > 1:  # the image is not simply one of the samples
        assert np.abs(image - larger[::samples, ::samples].astype(int)).mean() > 3


@pytest.mark.parametrize(("size", "samples"), [(24, 3), (32, 2), (32, 4)])
def test_samples_of_an_environment_average_its_larger_image(size, samples):
    """The images of every step are averages; the image from `render()` is not averaged."""
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


def test_depth_of_a_task_is_exact(task):
    renderer = RasterRenderer(task, CAMERA.name, 32)
    depth, geom = rays(task, CAMERA.name, 32)
    same = (renderer.render_segmentation() == geom) & (geom >= 0)
    assert same.mean() > 0.7  # the rest is the sky
    np.testing.assert_allclose(renderer.render_depth()[same], depth[same], rtol=5e-3)


def test_shadows_darken_the_image(every_geom):
    """With shadows, a part of the image is darker, and no pixel is brighter."""
    renderer = RasterRenderer(every_geom, "view", 84)
    lit = renderer.render()
    model = every_geom.model.ptr
    model.light_castshadow[:] = False
    bright = RasterRenderer(every_geom, "view", 84).render()
    model.light_castshadow[:] = True
    darker = (bright.astype(int) - lit).sum(-1) > 30
    assert 0.02 < darker.mean() < 0.4
    assert (bright >= lit).all()


def test_a_moved_camera_or_light_changes_the_image(every_geom):
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
