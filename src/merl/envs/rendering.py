"""Images of the scene: two renderers behind one protocol.

`gl` draws as dm_control does, pixel for pixel. `raster` draws triangles with Warp kernels of merl's
own; it needs no OpenGL library, draws neither sites nor transparency nor reflections, and smooths
edges only where `samples` is above 1. To an agent they are different cameras.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from merl.envs.config import RendererChoice
from merl.envs.opengl import GlRenderer, enable_opengl
from merl.envs.raster.renderer import RasterRenderer


class Renderer(Protocol):
    """Takes square pictures of one simulation with one camera."""

    def __init__(self, physics: Any, camera: str, size: int) -> None: ...

    def render(self) -> NDArray[np.uint8]:
        """The scene as it stands, uint8 (size, size, 3), a new array each time."""
        ...

    def close(self) -> None:
        """Let go of what was taken; may be called twice."""
        ...


def make_renderer(
    name: RendererChoice, physics: Any, camera: str, size: int, samples: int = 1
) -> Renderer:
    """Make a renderer by its name.

    Args:
        name: `gl` or `raster`; `EnvConfig` has replaced `auto`.
        physics: a `dm_control.mjcf.Physics`, whose model stays as it is.
        camera: the name of a camera in the model.
        size: height and width of the pictures, in pixels.
        samples: along each edge of a pixel, for `raster`; `EnvConfig` checks it.

    Raises:
        MerlError: `gl`, and no OpenGL library works; `raster`, and a geom cannot be drawn.
    """
    if name == "raster":
        return RasterRenderer(physics, camera, size, samples)
    return GlRenderer(physics, camera, size)


def check_renderer(name: RendererChoice) -> None:
    """Make sure that a renderer works here, before anything is built on it.

    Raises:
        MerlError: `gl`, and no OpenGL library works.
    """
    if name == "gl":
        enable_opengl()
