"""Pictures by rays: `renderer="warp"`."""

from __future__ import annotations

import importlib
import os
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.envs.warp_runtime import start_warp, told_if_it_takes_long, warp_on_cpu
from merl.resources import MOST_PICTURE_THREADS, picture_threads


class WarpRenderer:
    """mujoco-warp's ray tracer, on the CPU whatever else the machine has.

    Physics stays with MuJoCo; for each picture its poses are copied into Warp's arrays. The rays of
    a picture are shared out among `resources.picture_threads()`; each is traced alike by whichever.
    """

    def __init__(self, physics: Any, camera: str, size: int) -> None:
        start_warp()
        self._mjw = importlib.import_module("mujoco_warp")
        self._source = physics.data.ptr
        model = physics.model.ptr
        with warp_on_cpu(), told_if_it_takes_long():
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
        with warp_on_cpu():
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
