"""Measure the renderers: images and steps per second on one thread, and how near they are to `gl`.

python docs/measure_renderers.py [--states 300] [--rounds 7]

The speeds take turns within each round; the ratios are taken within a round. Nearness is the mean
difference of all pixels (of 255) over states that random actions lead to, and the share of pixels
that show the same geom as in MuJoCo's own segmentation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from merl.envs import make_env
from merl.envs.raster.renderer import RasterRenderer
from merl.envs.rendering import make_renderer
from merl.resources import allow_picture_threads
from merl.tasks import TASKS
from merl.tasks.jaco import CAMERA

SIZE = 84


def per_second(call: Callable[[int], object], count: int) -> float:
    """How often a call is made in a second."""
    start = time.perf_counter()
    for index in range(count):
        call(index)
    return count / (time.perf_counter() - start)


def speeds(rounds: int) -> None:
    """Print images and environment steps per second, with ratios to `warp`."""
    allow_picture_threads(1)
    actions = np.random.default_rng(0).uniform(-1, 1, (200, 9)).astype(np.float32)
    scene = make_env("reach_duplo", observations=("proprio",))
    scene.reset(seed=0)
    sides: dict[str, tuple[Callable[[int], object], int]] = {}
    for size in (SIZE, 48):
        warp = make_renderer("warp", scene.physics, CAMERA.name, size)
        sides[f"warp {size}"] = (lambda _, warp=warp: warp.render(), 60)
        for samples in (1, 2):
            raster = RasterRenderer(scene.physics, CAMERA.name, size, samples)
            sides[f"raster {size}, {samples}x{samples}"] = (lambda _, r=raster: r.render(), 60)
    for name in ("warp", "raster"):
        env = make_env("reach_duplo", renderer=name)
        env.reset(seed=0)
        sides[f"step with {name}"] = (lambda i, env=env: _step(env, actions[i]), 200)
    rates: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, (call, count) in sides.items():
            rates[name].append(per_second(call, count))
    for name, values in rates.items():
        base = {"raster 84": "warp 84", "raster 48": "warp 48", "step with": "step with warp"}
        beside = rates[next(v for k, v in base.items() if name.startswith((k, v)))]
        ratio = np.median(np.array(values) / beside)
        print(
            f"{name:20} {np.median(values):6.0f}/s ({min(values):.0f} to {max(values):.0f})  "
            f"{ratio:.2f} times warp"
        )


def _step(env: Any, action: Any) -> None:
    if env.step(action)[3]:
        env.reset()


def nearness(states: int) -> None:
    """Print how near the images are to `gl`'s, for each task."""
    for task in TASKS:
        env = make_env(task, renderer="gl", observations=("proprio",))
        physics = env.physics
        gl = make_renderer("gl", physics, CAMERA.name, SIZE)
        others = {
            "warp": make_renderer("warp", physics, CAMERA.name, SIZE),
            "raster": RasterRenderer(physics, CAMERA.name, SIZE),
            "raster 2x2": RasterRenderer(physics, CAMERA.name, SIZE, 2),
        }
        apart: dict[str, list[float]] = {name: [] for name in others}
        same, draw = [], np.random.default_rng(0)
        for state in range(states):
            if state % 10 == 0:
                env.reset(seed=state)
            action = draw.uniform(-1, 1, 9).astype(np.float32)
            for _ in range(10):
                env.step(action)
            drawn = gl.render().astype(int)
            for name, renderer in others.items():
                apart[name].append(float(np.abs(renderer.render() - drawn).mean()))
            labels = physics.render(SIZE, SIZE, camera_id=CAMERA.name, segmentation=True)
            is_geom = labels[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
            geoms = np.where(is_geom, labels[..., 0], -1)
            raster = others["raster"]
            assert isinstance(raster, RasterRenderer)
            same.append(float((raster.render_segmentation() == geoms).mean()))
        told = ", ".join(f"{name} {np.mean(values):.2f}" for name, values in apart.items())
        print(f"{task}: mean difference to gl {told}; same geom {np.mean(same):.3%}", flush=True)
        env.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    speeds(options.rounds)
    nearness(options.states)
