"""Renderers that work on this machine, and their speed."""

from __future__ import annotations

import time
from typing import get_args

from merl.core import MerlError
from merl.envs import make_env
from merl.rendering.config import RendererName

FRAMES = 20


def renderer_speeds(task: str = "reach_duplo", size: int = 84) -> dict[str, float | str]:
    """Return the frames per second of each renderer, or one line that says why it fails."""
    return {name: _speed(task, size, name) for name in get_args(RendererName)}


def _speed(task: str, size: int, name: RendererName) -> float | str:
    try:
        env = make_env(
            task,
            renderer=name,
            observations=("proprio",),
            render_size=size,
            render_mode="rgb_array",
        )
        try:
            env.reset(seed=0)
            env.render()  # the first call builds what later calls reuse
            start = time.perf_counter()
            for _ in range(FRAMES):
                env.render()
            return FRAMES / (time.perf_counter() - start)
        finally:
            env.close()
    except MerlError as error:
        return str(error)
    except Exception as error:  # a driver may raise anything; report it as the result
        return f"fails with {type(error).__name__}: {error}"
