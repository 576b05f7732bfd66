"""How fast the environment is, against dm_control's own with the same task and picture.

The sides take turns within one run, so that a machine that is busy for a while is busy for all of
them; what counts is the median over the rounds, and the ratio is taken within each round.
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
from merl.envs.rendering import check_renderer

OURS, THEIRS, BLIND = "merl, warp", "dm_control, OpenGL", "merl, no picture"
BAR = 8.0
"""An environment step with `warp` is to be at least this many times as fast as dm_control's."""

Step = Callable[[], object]


def run(repeats: int = 5, steps: int = 60, image_size: int = 84) -> dict[str, Any]:
    """Time steps and resets of `reach_duplo` on every side.

    Args:
        repeats: how many rounds, in each of which every side has its turn.
        steps: environment steps of ours in a turn; dm_control, far slower, takes a sixth.
        image_size: height and width of our picture, in pixels; dm_control's is always 84.

    Returns:
        Plain values: `steps_per_s` and `reset_ms` by side and `ratio` (ours to dm_control's
        steps/s), each as `median`, `low` and `high` over the rounds; `opengl`, which library drew
        dm_control's pictures; or `skipped`, why that side is missing.
    """
    result: dict[str, Any] = {"repeats": repeats, "steps": steps, "image_size": image_size}
    result |= circumstances()
    sides = {
        OURS: _ours(image_size=image_size),
        BLIND: _ours(observations=("proprio",)),
    }
    try:
        sides[THEIRS], result["opengl"] = _theirs()
    except MerlError as reason:
        result["skipped"] = f"{THEIRS}: {reason}"
    rates: dict[str, list[float]] = {side: [] for side in sides}
    resets: dict[str, list[float]] = {side: [] for side in sides}
    for _ in range(repeats):
        for side, (reset, step, _) in sides.items():
            resets[side].append(1e3 * seconds(reset))
            count = max(1, steps // 6) if side == THEIRS else steps
            rates[side].append(count / seconds(step, count))
    for _, _, close in sides.values():
        close()
    result["steps_per_s"] = {side: spread(values) for side, values in rates.items()}
    result["reset_ms"] = {side: spread(values) for side, values in resets.items()}
    if THEIRS in sides:
        pairs = zip(rates[OURS], rates[THEIRS], strict=True)
        result["ratio"] = spread([ours / theirs for ours, theirs in pairs])
    return result


def table(result: dict[str, Any]) -> Table:
    """What `run` returned, for people."""
    size = result["image_size"]
    rows = Table(
        title=f"reach_duplo, picture {size}x{size}, median of {result['repeats']} (least to most)"
    )
    for heading in ("", "steps/s", "reset, ms"):
        rows.add_column(heading, justify="right" if heading else "left")
    for side, rate in result["steps_per_s"].items():
        rows.add_row(side, shown(rate), shown(result["reset_ms"][side]))
    if "ratio" in result:
        rows.caption = (
            f"merl / dm_control: {shown(result['ratio'])}; the bar is {BAR:g}. "
            f"OpenGL: {result['opengl']}"
        )
    else:
        rows.caption = f"left out: {result['skipped']}"
    return rows


def _ours(**config: Any) -> tuple[Step, Step, Step]:
    env = make_env("reach_duplo", renderer="warp", **config)
    noise = np.random.default_rng(0)
    env.reset(seed=0)  # compiles
    return (
        env.reset,
        lambda: env.step(noise.uniform(-1.0, 1.0, 9).astype(np.float32)),
        env.close,
    )


def _theirs() -> tuple[tuple[Step, Step, Step], str]:
    """dm_control's task with its camera, all at its defaults; and which library draws."""
    check_renderer("gl")
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
