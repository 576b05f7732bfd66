"""Speed of the environment compared with dm_control's own, with the same task and image.

The variants take turns within one run, so that other load on the machine affects all of them.
Results are medians over the rounds; ratios are taken within each round.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from rich.table import Table

from merl.bench.measuring import circumstances, seconds, shown, spread
from merl.core import MerlError
from merl.envs import make_env
from merl.envs.arm_env import ArmEnv
from merl.rendering.opengl import enable_opengl
from merl.rendering.renderer import make_renderer
from merl.tasks.arm_task import CAMERA

OURS, BARE, BLIND, THEIRS = (
    "merl, raster",
    "physics and image alone",
    "merl, no image",
    "dm_control, OpenGL",
)
BAR, GOAL = 15.0, 25.0
"""Speed of a step with `raster` in multiples of dm_control's: required, and preferred."""
LEAST_RATE, MOST_OVERHEAD = 150.0, 0.1
"""Required steps per second on one core; largest overhead of merl's code over physics and image."""

Step = Callable[[], object]


def run(repeats: int = 5, steps: int = 60, image_size: int = 84) -> dict[str, Any]:
    """Time steps and resets of `reach_duplo` in every variant.

    Args:
        repeats: number of rounds; in each round every variant has one turn.
        steps: environment steps of merl in a turn; dm_control, far slower, takes a sixth of them.
        image_size: height and width of merl's image, in pixels; dm_control's is always 84.

    Returns:
        Plain values: `steps_per_s` and `reset_ms` by variant, `overhead` (time that merl's code
        adds to physics and image, as a fraction of their time) and `ratio` (merl's to dm_control's
        steps/s), each as `median`, `low` and `high` over the rounds; `opengl`, the library that
        drew dm_control's images, or `skipped`, the reason why dm_control is missing.
    """
    result: dict[str, Any] = {"repeats": repeats, "steps": steps, "image_size": image_size}
    result |= circumstances()
    sides = {
        OURS: _ours(image_size=image_size),
        BARE: _bare(image_size),
        BLIND: _ours(observations=("proprio",)),
    }
    try:
        sides[THEIRS], result["opengl"] = _theirs()
    except MerlError as reason:
        result["skipped"] = f"{THEIRS}: {reason}"
    rates: dict[str, list[float]] = {side: [] for side in sides}
    resets: dict[str, list[float]] = {side: [] for side in sides}
    try:
        for _ in range(repeats):
            for side, (reset, step, _) in sides.items():
                resets[side].append(1e3 * seconds(reset))
                count = max(1, steps // 6) if side == THEIRS else steps
                rates[side].append(count / seconds(step, count))
    finally:
        for _, _, close in sides.values():
            close()
    result["steps_per_s"] = {side: spread(values) for side, values in rates.items()}
    result["reset_ms"] = {side: spread(values) for side, values in resets.items()}
    pairs = zip(rates[BARE], rates[OURS], strict=True)
    result["overhead"] = spread([bare / ours - 1 for bare, ours in pairs])
    if THEIRS in sides:
        pairs = zip(rates[OURS], rates[THEIRS], strict=True)
        result["ratio"] = spread([ours / theirs for ours, theirs in pairs])
    return result


def table(result: dict[str, Any]) -> Table:
    """Return the result of `run` as a table."""
    size = result["image_size"]
    rows = Table(
        title=f"reach_duplo, image {size}x{size}, median of {result['repeats']} (min to max)"
    )
    for heading in ("", "steps/s", "reset, ms"):
        rows.add_column(heading, justify="right" if heading else "left")
    for side, rate in result["steps_per_s"].items():
        rows.add_row(side, shown(rate), shown(result["reset_ms"][side]))
    notes = [
        f"target: {LEAST_RATE:g} steps/s",
        f"overhead of merl's code over physics and image: {shown(result['overhead'])}, target: at "
        f"most {MOST_OVERHEAD:g}",
    ]
    if "ratio" in result:
        notes.append(
            f"merl / dm_control: {shown(result['ratio'])}, target: {BAR:g}, preferably {GOAL:g}; "
            f"OpenGL: {result['opengl']}"
        )
    else:
        notes.append(f"skipped: {result['skipped']}")
    rows.caption = "; ".join(notes)
    return rows


def _ours(**config: Any) -> tuple[Step, Step, Step]:
    """Return reset, step and close of merl's environment."""
    env = make_env("reach_duplo", renderer="raster", **config)
    noise = np.random.default_rng(0)
    env.reset(seed=0)  # compiles the renderer
    return (
        env.reset,
        lambda: env.step(noise.uniform(-1.0, 1.0, 9).astype(np.float32)),
        env.close,
    )


def _bare(size: int) -> tuple[Step, Step, Step]:
    """Return reset, step and close of physics and image alone, without the rest of a step."""
    env = make_env("reach_duplo", observations=("proprio",))
    assert isinstance(env, ArmEnv)
    env.reset(seed=0)
    physics, noise = env.physics, np.random.default_rng(0)
    renderer = make_renderer("raster", physics, CAMERA.name, size)
    mj_step = import_module("mujoco").mj_step
    model, data = physics.model.ptr, physics.data.ptr
    count = env.task.physics_steps_per_control_step

    def step() -> None:
        data.ctrl[:] = noise.uniform(-0.5, 0.5, data.ctrl.shape)
        mj_step(model, data, nstep=count)
        renderer.render()

    return env.reset, step, env.close


def _theirs() -> tuple[tuple[Step, Step, Step], str]:
    """Return reset, step and close of dm_control's task by its defaults, and its OpenGL library."""
    enable_opengl()
    from dm_control import manipulation

    gl = import_module("OpenGL.GL")
    env = manipulation.load("reach_duplo_vision", seed=0)
    env.reset()
    spec, noise = env.action_spec(), np.random.default_rng(0)
    with env.physics.contexts.gl.make_current() as context:
        opengl = context.call(gl.glGetString, gl.GL_RENDERER).decode()
    return (
        env.reset,
        lambda: env.step(noise.uniform(spec.minimum, spec.maximum)),
        env.close,
    ), opengl
