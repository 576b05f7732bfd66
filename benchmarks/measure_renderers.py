"""Measure the renderers: images and steps per second, and the difference of `raster` to `gl`.

    python benchmarks/measure_renderers.py [--states 300] [--rounds 7]

For the speeds, the renderers take turns within each round, and ratios are taken within a round.
`raster` uses one thread, `gl` as many as its OpenGL library. The difference is the mean over all
pixels (of 255) in states that random actions reach, and the fraction of pixels that show the same
geom as MuJoCo's own segmentation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from merl.envs import make_env
from merl.rendering.raster.renderer import RasterRenderer
from merl.rendering.renderer import make_renderer
from merl.tasks import TASKS
from merl.tasks.arm_task import CAMERA

SIZE = 84
SIZES = ((84, 1), (84, 2), (48, 1), (48, 2), (32, 1), (32, 2), (24, 1), (24, 3), (480, 1))
"""(side in pixels, n) of the timed images, which have n x n samples per pixel."""


def per_second(call: Callable[[int], object], count: int) -> float:
    """Return the calls per second; `call` is given the index of the call."""
    start = time.perf_counter()
    for index in range(count):
        call(index)
    return count / (time.perf_counter() - start)


def speeds(rounds: int) -> None:
    """Print images and environment steps per second, with ratios to `gl`."""
    actions = np.random.default_rng(0).uniform(-1, 1, (200, 9)).astype(np.float32)
    scene = make_env("reach_duplo", renderer="gl", observations=("proprio",))
    scene.reset(seed=0)
    sides: dict[str, tuple[Callable[[int], object], int]] = {}
    base: dict[str, str] = {}
    for size in dict.fromkeys(size for size, _ in SIZES):
        gl = make_renderer("gl", scene.physics, CAMERA.name, size)
        sides[f"gl {size}"] = (_drawing(gl), 10)
        base[f"gl {size}"] = f"gl {size}"
    for size, samples in SIZES:
        name = f"raster {size}, {samples}x{samples}"
        raster = make_renderer("raster", scene.physics, CAMERA.name, size, samples)
        sides[name] = (_drawing(raster), 60)
        base[name] = f"gl {size}"
    for renderer in ("gl", "raster"):
        env = make_env("reach_duplo", renderer=renderer)
        env.reset(seed=0)
        count = 20 if renderer == "gl" else 200
        sides[f"step with {renderer}"] = (_stepping(env, actions), count)
        base[f"step with {renderer}"] = "step with gl"
    rates: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, (call, count) in sides.items():
            rates[name].append(per_second(call, count))
    for name, values in rates.items():
        ratio = np.median(np.array(values) / rates[base[name]])
        print(
            f"{name:20} {np.median(values):6.0f}/s ({min(values):.0f} to {max(values):.0f})  "
            f"{ratio:.2f} times gl"
        )


def _drawing(renderer: Any) -> Callable[[int], object]:
    return lambda _: renderer.render()


def _stepping(env: Any, actions: Any) -> Callable[[int], object]:
    def step(i: int) -> None:
        if env.step(actions[i])[3]:
            env.reset()

    return step


def nearness(states: int) -> None:
    """Print the difference of the images to those of `gl`, for each task."""
    for task in TASKS:
        env = make_env(task, renderer="gl", observations=("proprio",))
        physics = env.physics
        gl = make_renderer("gl", physics, CAMERA.name, SIZE)
        raster = RasterRenderer(physics, CAMERA.name, SIZE)
        others = {"raster": raster, "2x2": RasterRenderer(physics, CAMERA.name, SIZE, 2)}
        apart: dict[str, list[float]] = {name: [] for name in others}
        same, rng = [], np.random.default_rng(0)
        for state in range(states):
            if state % 10 == 0:
                env.reset(seed=state)
            action = rng.uniform(-1, 1, 9).astype(np.float32)
            for _ in range(10):
                env.step(action)
            drawn = gl.render().astype(int)
            for name, renderer in others.items():
                apart[name].append(float(np.abs(renderer.render() - drawn).mean()))
            labels = physics.render(SIZE, SIZE, camera_id=CAMERA.name, segmentation=True)
            is_geom = labels[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
            geoms = np.where(is_geom, labels[..., 0], -1)
            same.append(float((raster.render_segmentation() == geoms).mean()))
        text = ", ".join(f"{name} {np.mean(values):.2f}" for name, values in apart.items())
        print(f"{task}: mean difference to gl {text}; same geom {np.mean(same):.3%}", flush=True)
        env.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    if options.rounds:
        speeds(options.rounds)
    if options.states:
        nearness(options.states)
