"""Renderer with OpenGL (`renderer="gl"`), and the choice of the OpenGL library."""

from __future__ import annotations

import ctypes
import importlib
import os
import threading
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.tasks import simulator


class GlRenderer:
    """A renderer that uses OpenGL through dm_control, with the images of its camera observables.

    The thread that draws the first image of a physics must draw all of them.
    """

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        enable_opengl()
        engine = importlib.import_module("dm_control.mujoco.engine")
        self._camera = engine.Camera(physics, height=size, width=size, camera_id=camera)

    def render(self) -> NDArray[np.uint8]:
        """See `rendering.Renderer`."""
        return np.array(self._camera.render(), dtype=np.uint8)

    def render_depth(self) -> NDArray[np.float32]:
        """See `rendering.Renderer`."""
        return np.array(self._camera.render(depth=True), dtype=np.float32)

    def close(self) -> None:
        """Free the scene; the OpenGL context is freed with the physics."""
        if self._camera is not None:
            self._camera._scene.free()
        self._camera = None


_OPENGL_LIBRARIES = {
    "egl": ("libEGL.so.1",),
    "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),
}
_opengl_lock = threading.Lock()


def enable_opengl() -> None:
    """Enable an OpenGL backend in dm_control, which was imported without one.

    Raises:
        MerlError: no backend is found, or it does not work.
    """
    render = importlib.import_module("dm_control._render")
    name = _choose_opengl()
    with _opengl_lock:
        if name == render.BACKEND != "off":
            return
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the error below gives the reason
                _reload_opengl(name)
                _try_opengl(render)
        except Exception as reason:  # every backend raises other exceptions
            _reload_opengl("disabled")
            raise MerlError(
                f"renderer 'gl' found no OpenGL library that works (tried {name}): install the "
                "Debian package libegl1, or libosmesa6 and set MUJOCO_GL=osmesa, or use --renderer "
                "raster, which needs no OpenGL"
            ) from reason


def _try_opengl(render: Any) -> None:
    """Create an OpenGL context, because GLFW does not fail earlier.

    Raises:
        Exception: OpenGL does not work.
    """
    mujoco = importlib.import_module("mujoco")
    renderer = render.Renderer(1, 1)
    try:
        empty = mujoco.MjModel.from_xml_string("<mujoco/>")
        with renderer.make_current() as current:
            current.call(mujoco.MjrContext, empty, mujoco.mjtFontScale.mjFONTSCALE_100)
    finally:
        renderer.free()


def _choose_opengl() -> str:
    """Return the backend in `MUJOCO_GL`, else the first one whose library is installed.

    There is no second attempt: the libraries of one backend prevent the next one from working.
    """
    if os.environ.get("MUJOCO_GL"):
        return os.environ["MUJOCO_GL"]
    for name, libraries in _OPENGL_LIBRARIES.items():
        if any(_loads(library) for library in libraries):
            return name
    return "glfw" if os.environ.get("DISPLAY") else "egl"


def _reload_opengl(name: str) -> None:
    with simulator.environment(MUJOCO_GL=name):
        importlib.reload(importlib.import_module("dm_control._render"))


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
