"""Pictures of the scene: two renderers behind one protocol.

`gl` draws as dm_control does, pixel for pixel. `warp` traces rays on the CPU with mujoco-warp and
needs no OpenGL library; it draws neither sites nor transparency nor reflections, and does not
smooth edges. To an agent the two are different cameras.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.config import RendererName
from merl.tasks import simulator

Image = NDArray[np.uint8]


class Renderer(Protocol):
    """Takes square pictures of one simulation with one camera."""

    def __init__(self, physics: Any, camera: str, size: int) -> None: ...

    def render(self) -> Image:
        """The scene as it stands, uint8 (size, size, 3), a new array each time."""
        ...

    def close(self) -> None:
        """Let go of what was taken; may be called twice."""
        ...


def make_renderer(name: RendererName, physics: Any, camera: str, size: int) -> Renderer:
    """A renderer by its name.

    Args:
        name: `gl` or `warp`.
        physics: a `dm_control.mjcf.Physics`, whose model stays as it is.
        camera: the name of a camera in the model.
        size: height and width of the pictures, in pixels.

    Raises:
        MerlError: `gl`, and no OpenGL library works.
    """
    renderers: dict[RendererName, type[Renderer]] = {"gl": GlRenderer, "warp": WarpRenderer}
    return renderers[name](physics, camera, size)


def check_renderer(name: RendererName) -> None:
    """Make sure that a renderer works here, before anything is built on it.

    Raises:
        MerlError: `gl`, and no OpenGL library works.
    """
    if name == "gl":
        _enable_opengl()


class GlRenderer:
    """OpenGL through dm_control: what its camera observables show.

    The thread that takes the first picture of a physics has to take them all.
    """

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        _enable_opengl()
        engine = importlib.import_module("dm_control.mujoco.engine")
        self._camera = engine.Camera(physics, height=size, width=size, camera_id=camera)

    def render(self) -> Image:
        """See `Renderer`."""
        return np.array(self._camera.render(), dtype=np.uint8)

    def close(self) -> None:
        """Free the scene; the OpenGL context goes with the physics."""
        if self._camera is not None:
            self._camera._scene.free()
        self._camera = None


_OPENGL_LIBRARIES = {
    "egl": ("libEGL.so.1",),
    "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),
}
_opengl_lock = threading.Lock()


def _enable_opengl() -> None:
    """Give dm_control, which was imported without, an OpenGL backend.

    Raises:
        MerlError: there is none, or it does not work.
    """
    render = importlib.import_module("dm_control._render")
    name = _choose_opengl()
    with _opengl_lock:
        if name == render.BACKEND != "off":
            return
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of GLFW, while the reason is told below
                _reload_opengl(name)
                _try_opengl(render)
        except Exception as reason:  # every backend fails in its own way
            _reload_opengl("disabled")
            raise MerlError(
                f"renderer 'gl' finds no OpenGL that works (tried {name}): install the Debian "
                "package libegl1, or libosmesa6 and set MUJOCO_GL=osmesa, or use --renderer warp, "
                "which needs none"
            ) from reason


def _try_opengl(render: Any) -> None:
    """Make a context to draw in: GLFW fails no earlier.

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
    """The backend that `MUJOCO_GL` names, else the first whose library is there.

    One choice and no second try: what a backend has loaded keeps the next one from working.
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


class WarpRenderer:
    """mujoco-warp's ray tracer, on the CPU whatever else the machine has.

    Physics stays with MuJoCo; for each picture its poses are copied into Warp's arrays.
    """

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        self._mjw = _start_warp()
        self._source = physics.data.ptr
        model = physics.model.ptr
        with _warp_on_cpu():
            self._model = self._mjw.put_model(model)
            self._data = self._mjw.put_data(model, self._source)
            self._context = self._mjw.create_render_context(
                model,
                nworld=1,
                cam_active=[camera],
                cam_res=(size, size),
                render_rgb=True,
                render_depth=False,
                render_seg=False,
                # What comes closest to OpenGL's picture:
                use_shadows=True,
                shadow_light_fraction=0.0,
                render_skybox=True,
            )
        # Views, not copies: on the CPU numpy and Warp share the memory.
        self._poses = {name: getattr(self._data, name).numpy()[0] for name in _POSES}
        self._bgra = self._context.rgb_data.numpy().view(np.uint8).reshape(size, size, 4)

    def render(self) -> Image:
        """See `Renderer`."""
        for name, pose in self._poses.items():
            pose[:] = getattr(self._source, name).reshape(pose.shape)
        with _warp_on_cpu():
            self._mjw.refit_bvh(self._model, self._data, self._context)
            self._mjw.render(self._model, self._data, self._context)
            picture: Image = self._bgra[:, :, 2::-1].copy()
        return picture

    def close(self) -> None:
        """Nothing to do: the arrays go with the renderer."""


_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
"""What moves from one picture to the next."""
_warp_lock = threading.RLock()


@contextmanager
def _warp_on_cpu() -> Iterator[None]:
    """Run Warp on the CPU; one thread at a time, for the device is a setting of the process."""
    import warp

    with _warp_lock, warp.ScopedDevice("cpu"):
        yield


def _start_warp() -> Any:
    """The module mujoco_warp, with Warp silenced and a place for its compiled kernels."""
    with _warp_lock:
        if "mujoco_warp" not in sys.modules:
            import warp

            warp.config.log_level = warp.LOG_ERROR
            cache = _kernel_cache()
            warp.config.kernel_cache_dir = str(cache)
            if not any(cache.glob(f"{warp.__version__}/*megakernel*")):
                print("merl: compiling the ray tracer, once, for about 15 s", file=sys.stderr)
            with _silent_stderr():  # without an NVIDIA driver Warp says so, past Python
                warp.init()  # type: ignore[no-untyped-call]
        return importlib.import_module("mujoco_warp")


def _kernel_cache() -> Path:
    """A folder of our own that can be written: in the user's cache, else among temporary files."""
    places = [Path(tempfile.gettempdir()) / f"merl-warp-{os.getuid()}"]
    with suppress(RuntimeError):  # there may be no home
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        places.insert(0, home / "merl" / "warp")
    if "WARP_CACHE_PATH" in os.environ:
        places.insert(0, Path(os.environ["WARP_CACHE_PATH"]))
    for place in places:
        with suppress(OSError):
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place):
                if place.stat().st_uid == os.getuid():  # code is loaded from here
                    return place
    return Path(tempfile.mkdtemp(prefix="merl-warp-"))


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Send what C libraries write to stderr nowhere."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
