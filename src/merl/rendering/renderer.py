"""Images of the scene: two renderers behind one protocol.

`gl` gives exactly the pixels of dm_control. `raster` draws triangles with merl's Warp kernels: it
needs no OpenGL library, draws no sites, transparency or reflections, and smooths edges only if
`samples` is above 1. Their images differ: to an agent they are different cameras.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from merl.rendering.config import RendererName
from merl.rendering.opengl import GlRenderer
from merl.rendering.raster.renderer import RasterRenderer


class Renderer(Protocol):
    """A renderer of square images of one simulation, from one camera."""

    def render(self) -> NDArray[np.uint8]:
        """Return the current scene, uint8 (size, size, 3), as a new array."""
        ...

    def render_depth(self) -> NDArray[np.float32]:
        """Return the distance along the camera's axis, (size, size), m; the sky is far away."""
        ...

    def close(self) -> None:
        """Free the resources; repeated calls have no effect."""
        ...


def make_renderer(
    name: RendererName, physics: Any, camera: str, size: int, samples: int = 1
) -> Renderer:
    """Make a renderer by its name.

    Args:
        name: `gl` or `raster`.
        physics: a `dm_control.mjcf.Physics`; its model is not changed.
        camera: the name of a camera in the model.
        size: height and width of the images, in pixels.
        samples: samples along each edge of a pixel, for `raster`; `EnvConfig` checks the value.

    Raises:
        MerlError: for `gl`, no OpenGL library works; for `raster`, a geom cannot be drawn.
    """
    if name == "raster":
        return RasterRenderer(physics, camera, size, samples)
    return GlRenderer(physics, camera, size)
