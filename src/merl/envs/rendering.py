"""Pictures of the scene: two renderers behind one protocol.

`gl` draws as dm_control does, pixel for pixel. `warp` traces rays on the CPU with mujoco-warp and
needs no OpenGL library; it draws neither sites nor transparency nor reflections, and its edges are
not smoothed, so to an agent the two are different cameras.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.config import RendererName
from merl.tasks import simulator

logger = logging.getLogger(__name__)

Image = NDArray[np.uint8]


class Renderer(Protocol):
    """Takes pictures of one simulation with one camera."""

    def render(self) -> Image:
        """The scene as it stands, uint8 (H, W, 3), a new array each time."""
        ...

    def close(self) -> None:
        """Let go of what was taken; may be called twice."""
        ...


def make_renderer(name: RendererName, physics: Any, camera: str, size: int) -> Renderer:
    """A renderer for square pictures of `physics`.

    Args:
        name: `gl` or `warp`.
        physics: a `dm_control.mjcf.Physics`.
        camera: a camera of the model.
        size: height and width of the pictures, in pixels.

    Raises:
        MerlError: `gl` where no OpenGL library can be used.
    """
    return {"gl": GlRenderer, "warp": WarpRenderer}[name](physics, camera, size)


class GlRenderer:
    """OpenGL through dm_control: what its camera observables show."""

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        _enable_opengl()
        from dm_control.mujoco import engine

        self._camera = engine.Camera(physics, height=size, width=size, camera_id=camera)

    def render(self) -> Image:
        """See `Renderer`."""
        return np.array(self._camera.render())

    def close(self) -> None:
        """Free the scene; the OpenGL context belongs to the physics."""
        if self._camera is not None:
            self._camera._scene.free()
            self._camera = None


_opengl_lock = threading.Lock()
_OPENGL_LIBRARIES = {
    "egl": ("libEGL.so.1", "libEGL.so"),
    "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),
    "glfw": (),  # brings its own library
}


def _enable_opengl() -> None:
    """Give dm_control an OpenGL backend, which it was imported without.

    Raises:
        MerlError: there is none.
    """
    wanted = os.environ.get("MUJOCO_GL")
    names = (wanted,) if wanted else ("egl", "osmesa")
    if not wanted and os.environ.get("DISPLAY"):
        names = ("glfw", *names)
    with _opengl_lock:
        if not any(_opengl_works(name) for name in names):
            raise MerlError(
                f"renderer 'gl' finds no OpenGL (tried {', '.join(names)}): install the Debian "
                "package libegl1 or libosmesa6, or use --renderer warp, which needs none"
            )


def _opengl_works(name: str) -> bool:
    """Switch dm_control to a backend, if that can open a context."""
    render = importlib.import_module("dm_control._render")
    libraries = _OPENGL_LIBRARIES.get(name, ())
    if libraries and not any(_loadable(library) for library in libraries):
        return False
    try:
        if name != render.BACKEND:
            with simulator.opengl_backend(name):
                importlib.reload(render)
            render.Renderer(1, 1).free()
    except Exception as reason:  # each backend fails in its own way
        logger.info("OpenGL through %s does not work: %s", name, reason)
        with simulator.opengl_backend("disabled"):
            importlib.reload(render)
        return False
    return True


def _loadable(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


class WarpRenderer:
    """mujoco-warp's ray tracer, on the CPU whatever else the machine has."""

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        wp, mjw = _start_warp()
        self._warp, self._mjw, self._size = wp, mjw, size
        self._source = physics.data.ptr
        model = physics.model.ptr
        with wp.ScopedDevice("cpu"):
            self._model = mjw.put_model(model)
            self._data = mjw.put_data(model, self._source)
            self._context = mjw.create_render_context(
                model,
                nworld=1,
                cam_res=(size, size),
                cam_active=[camera],
                render_rgb=True,
                render_depth=False,
                render_seg=False,
                use_shadows=True,
                shadow_light_fraction=0.0,  # this and the sky: what comes closest to OpenGL
                render_skybox=True,
            )
        self._poses = [(name, getattr(self._data, name).numpy()[0]) for name in _POSES]
        self._pixels = self._context.rgb_data.numpy()[0].view(np.uint8).reshape(size, size, 4)

    def render(self) -> Image:
        """See `Renderer`."""
        for name, target in self._poses:
            target[:] = getattr(self._source, name).reshape(target.shape)
        with self._warp.ScopedDevice("cpu"):
            self._mjw.refit_bvh(self._model, self._data, self._context)
            self._mjw.render(self._model, self._data, self._context)
        return self._pixels[:, :, 2::-1].copy()

    def close(self) -> None:
        """Nothing to free: the arrays go with the object."""


_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
"""What moves between two pictures."""
_warp_lock = threading.Lock()


def _start_warp() -> tuple[Any, Any]:
    """Warp and mujoco-warp, silenced and with a kernel cache that can be written."""
    with _warp_lock:
        import warp as wp

        if "mujoco_warp" not in sys.modules:
            wp.config.log_level = wp.LOG_ERROR
            wp.config.kernel_cache_dir = str(_kernel_cache())
        import mujoco_warp as mjw

        return wp, mjw


def _kernel_cache() -> Path:
    """The first of Warp's own cache folder and a temporary one that can be written."""
    named = os.environ.get("WARP_CACHE_PATH")
    home = Path(named) if named else Path("~/.cache/merl/warp").expanduser()
    for folder in (home, Path(tempfile.gettempdir()) / f"merl-warp-{os.getuid()}"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="merl-warp-"))
