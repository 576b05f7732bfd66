"""The rasteriser in several threads, and with invalid arguments and models."""

import itertools
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from dm_control import mujoco as dm_mujoco

from merl.core import MerlError
from merl.rendering.raster.renderer import RasterRenderer


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples": 0}, "samples must be at least 1 and at most 4, not 0"),
        ({"samples": 5}, "samples must be .* at most 4, not 5"),
        ({"samples": 2.0}, "samples must be a whole number, not 2.0"),
        ({"samples": True}, "samples must be a whole number, not True"),
        ({"samples": 2, "size": 1025}, "samples is 2 at 1025 pixels, .* at most 2048"),
        ({"size": 0}, "size must be at least 1 .*, not 0"),
        ({"size": 2049}, "size must be .* at most 2,048, not 2049"),
        ({"size": 8.5}, "size must be a whole number, not 8.5"),
    ],
)
def test_sizes_and_samples_out_of_range_are_rejected(every_geom, settings, message):
    with pytest.raises(MerlError, match=message) as error:
        RasterRenderer(every_geom, "view", **{"size": 32, **settings})
    assert "\n" not in str(error.value)


def in_two_threads(work):
    """Return the results of `work(0)` and `work(1)`, called in two threads at the same time."""
    together = threading.Barrier(2)

    def start(index):
        together.wait()
        return work(index)

    with ThreadPoolExecutor(2) as threads:
        return list(threads.map(start, range(2)))


def test_two_threads_with_a_renderer_each_draw_the_same_as_one(every_geom):
    expected = RasterRenderer(every_geom, "view", 48).render()

    def draw(_):
        renderer = RasterRenderer(every_geom, "view", 48)
        return [renderer.render() for _ in range(100)]

    for image in itertools.chain(*in_two_threads(draw)):
        np.testing.assert_array_equal(image, expected)


def test_two_threads_with_one_renderer_draw_the_same_as_one(every_geom):
    renderer = RasterRenderer(every_geom, "view", 48)
    image, depth = renderer.render(), renderer.render_depth()
    for images in in_two_threads(lambda _: [renderer.render() for _ in range(300)]):
        for other in images:
            np.testing.assert_array_equal(other, image)
    with ThreadPoolExecutor(1) as another:
        np.testing.assert_array_equal(another.submit(renderer.render_depth).result(), depth)


def test_only_one_thread_at_a_time_compiles(every_geom, monkeypatch):
    """Warp crashes if several threads compile its kernels at the same time."""
    compiling, record = threading.Lock(), RasterRenderer._record

    def record_alone(renderer):
        assert compiling.acquire(blocking=False), "two threads compile"
        time.sleep(0.05)  # enough for the other thread to arrive
        compiling.release()
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
def test_unsupported_models_are_rejected_in_one_line(model, message):
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
