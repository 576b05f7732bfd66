"""Pictures by rays: `renderer="warp"`, and how Warp is started."""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from copy import copy
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.resources import MOST_PICTURE_THREADS, picture_threads


class WarpRenderer:
    """mujoco-warp's ray tracer, on the CPU whatever else the machine has.

    Physics stays with MuJoCo; for each picture its poses are copied into Warp's arrays. The rays of
    a picture are shared out among `resources.picture_threads()`; each is traced alike by whichever.
    """

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        self._mjw = _start_warp()
        self._source = physics.data.ptr
        model = physics.model.ptr
        with _warp_on_cpu(), _told_if_it_takes_long():
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
            # Compiled with the first picture, and kept by the context that its parts are copies of.
            self._mjw.render(self._model, self._data, self._context)
        # Views, not copies: on the CPU numpy and Warp share the memory.
        self._poses = {name: getattr(self._data, name).numpy()[0] for name in _POSES}
        self._bgra = self._context.rgb_data.numpy().view(np.uint8).reshape(size, size, 4)
        self._parts: list[Any] = []

    def render(self) -> NDArray[np.uint8]:
        """See `rendering.Renderer`."""
        for name, pose in self._poses.items():
            pose[:] = getattr(self._source, name).reshape(pose.shape)
        threads = min(picture_threads(), len(self._bgra))
        with _warp_on_cpu():
            if len(self._parts) != threads:
                self._parts = _shared_out(self._context, threads)
            self._mjw.refit_bvh(self._model, self._data, self._context)
            first, *others = self._parts
            # Warp lets go of Python's lock while it traces.
            traced = [_helpers().submit(self._trace, part) for part in others]
            self._trace(first)
            for part in traced:
                part.result()
            picture: NDArray[np.uint8] = self._bgra[:, :, 2::-1].copy()
        return picture

    def close(self) -> None:
        """Nothing to do: the arrays go with the renderer."""

    def _trace(self, part: Any) -> None:
        self._mjw.render(self._model, self._data, part)


def _shared_out(context: Any, parts: int) -> list[Any]:
    """Render contexts for so many parts of the picture, which they write into the same memory."""
    import warp

    bounds = [context.total_rays * part // parts for part in range(parts + 1)]
    shared = []
    for begin, end in pairwise(bounds):
        part = copy(context)
        part.total_rays = end - begin
        part.ray = context.ray[begin:end]
        part.rgb_adr = warp.array([begin], dtype=int, device="cpu")
        shared.append(part)
    return shared


@cache
def _helpers() -> ThreadPoolExecutor:
    """The threads that trace beside the one that asks for a picture."""
    return ThreadPoolExecutor(MOST_PICTURE_THREADS, thread_name_prefix="merl-rays")


os.register_at_fork(after_in_child=lambda: _helpers.cache_clear())  # threads are not inherited


_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
"""What moves from one picture to the next."""
_COMPILER_FLAGS = "-menable-no-nans -fno-signed-zeros -Wno-nan-infinity-disabled"
"""A quarter of the time, pixel for pixel the same picture: nothing there is ever NaN."""
_warp_lock = threading.RLock()


@contextmanager
def _warp_on_cpu() -> Iterator[None]:
    """Run Warp on the CPU; one thread at a time, for the device is a setting of the process."""
    import warp

    with _warp_lock, warp.ScopedDevice("cpu"):
        yield


def _start_warp() -> Any:
    """Return the module mujoco_warp, with Warp silenced and a place for its compiled kernels."""
    with _warp_lock:
        _configure_warp()
        return importlib.import_module("mujoco_warp")


@cache
def _configure_warp() -> None:
    """Configure Warp, once in a process, whether or not another module has imported it before."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    if warp.config.kernel_cache_dir is None:  # else a program that uses merl has chosen
        warp.config.kernel_cache_dir = str(_kernel_cache())
    flags = warp.config.cpu_compiler_flags
    own = "-march=native" if flags is None else flags  # None: for this processor, too
    warp.config.cpu_compiler_flags = f"{own} {_COMPILER_FLAGS}"
    with _silent_stderr():  # without an NVIDIA driver Warp says so, past Python
        warp.init()  # type: ignore[no-untyped-call]


@contextmanager
def _told_if_it_takes_long(seconds: float = 2.0) -> Iterator[threading.Thread]:
    """Say that the ray tracer is being compiled, if this takes more than `seconds`.

    They are seconds of processor time: to load what is compiled already takes fewer, also on a busy
    machine.
    """
    begin, is_over = time.process_time(), threading.Event()

    def watch() -> None:
        while not is_over.wait(0.1):
            if time.process_time() - begin > seconds:
                print("merl: compiling the ray tracer, once, for 5 to 20 s", file=sys.stderr)
                return

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield watching
    finally:
        is_over.set()


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
