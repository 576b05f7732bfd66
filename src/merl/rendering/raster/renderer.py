"""Renderer with a z-buffer and shadow maps (`renderer="raster"`), which needs no OpenGL."""

from __future__ import annotations

import threading
from dataclasses import asdict
from importlib import import_module
from types import SimpleNamespace
from typing import Annotated, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError, suggest
from merl.core.fields import Range, check_value
from merl.rendering.config import LARGEST_IMAGE, Samples, check_samples
from merl.rendering.raster.scene import Scene, build_scene
from merl.rendering.warp_runtime import compiling, load_kernels, start_warp

SHADOW_TEXELS = 1.5
"""Texels along an edge of a shadow map, per sample along an edge of the image."""
INVISIBLE = 1e-3
"""A highlight is not computed if its relative strength is below this."""


class RasterRenderer:
    """A renderer that draws a MuJoCo model as triangles, on one thread of the CPU.

    Triangles, materials and textures are collected once. Planes and sky are painted again only if
    they, the camera or a light have moved.

    Args:
        physics: a `dm_control.mjcf.Physics`; its model is not changed.
        camera: the name of a camera in the model.
        size: height and width of the images, in pixels.
        samples: samples along each edge of a pixel, 1 to 4; a pixel is the mean of its samples, as
            if a larger image were averaged over boxes.
        device: Warp's name of the device.

    Raises:
        MerlError: the model has a geom that cannot be drawn, or it has no such camera, or size or
            samples are out of range.
    """

    def __init__(
        self, physics: Any, camera: str, size: int, samples: int = 1, device: str = "cpu"
    ) -> None:
        check_value("size", size, Annotated[int, Range(1, LARGEST_IMAGE)])
        check_value("samples", samples, Samples)
        check_samples(samples, size)
        self._wp, self._structs = start_warp(), import_module("merl.rendering.raster.structs")
        self._model, self._data = physics.model.ptr, physics.data.ptr
        self._camera = _camera_of(self._model, camera)
        self._lock = threading.Lock()
        self._samples, self._side, self._device = samples, size * samples, device
        self._shadow_side = round(SHADOW_TEXELS * self._side)
        self._scene = build_scene(self._model)
        self._planes = np.array([self._scene.drawn[n] for n in self._scene.planes], int)
        self._shadows = [n for n, light in enumerate(self._scene.lights) if light.casts_shadow]
        self._last_poses: tuple[bytes, ...] = ()
        self._allocate(size)
        self._describe_views()
        with compiling():
            self._commands = load_kernels(self._record)
            self.render()

    def render(self) -> NDArray[np.uint8]:
        """See `rendering.Renderer`."""
        image: NDArray[np.uint8] = self._render_array("shade", "colors")
        return image

    def render_depth(self) -> NDArray[np.float32]:
        """Return the distance along the camera's axis, (size, size), m; infinite without a hit."""
        depth: NDArray[np.float32] = self._render_array("measure", "depth")
        return depth

    def render_segmentation(self) -> NDArray[np.int32]:
        """Return the geom that each pixel shows, (size, size); -1 for the sky."""
        geoms: NDArray[np.int32] = self._render_array("measure", "geom")
        return geoms

    def close(self) -> None:
        """Do nothing: the arrays are freed with the renderer."""

    def _allocate(self, size: int) -> None:
        k, scene = self._structs, self._scene
        views, pixels, shadows = 1 + len(self._shadows), self._side**2, len(self._shadows)
        wp = self._wp
        shapes: dict[str, tuple[Any, Any]] = {
            "positions": (self._model.ngeom, wp.vec3),
            "rotations": (self._model.ngeom, wp.mat33),
            "views": (views, k.View),
            "lights": (len(scene.lights), k.Light),
            "pose": ((views, len(scene.drawn)), wp.mat33),
            "offset": ((views, len(scene.drawn)), wp.vec3),
            "eyes": ((views, len(scene.drawn)), wp.vec4),
            "projected": ((views, len(scene.vertices)), wp.vec3),
            "keys": (pixels, wp.uint64),
            "maps": ((shadows, self._shadow_side, self._shadow_side), float),
            "behind": (pixels, k.Background),
            "shadowed": ((shadows, pixels), k.Shadowed),
            "colors": ((size, size, 3), wp.uint8),
            "depth": ((size, size), float),
            "geom": ((size, size), int),
        }
        made = {
            name: wp.zeros(shape, dtype=dtype, device=self._device)
            for name, (shape, dtype) in shapes.items()
        }
        self._arrays: Any = SimpleNamespace(**made)
        self._surfaces = self._fill_surfaces(scene)

    def _array(self, values: NDArray[Any], dtype: Any) -> Any:
        return self._wp.array(values, dtype=dtype, device=self._device)

    def _fill_surfaces(self, scene: Scene) -> Any:
        wp, k = self._wp, self._structs
        surfaces = k.Surfaces()
        vec3, vec3i = wp.vec3, wp.vec3i
        for name, dtype in {
            "drawn": int,
            "vertices": vec3,
            "vertex_parts": vec3i,
            "triangle_parts": vec3i,
            "triangles": vec3i,
            "geom_of": int,
            "facing": wp.vec4,
            "normals": vec3,
            "normal_of": vec3i,
            "coordinates": wp.vec2,
            "coordinate_of": vec3i,
            "density": float,
            "planes": int,
            "plane_sizes": wp.vec2,
            "texels": vec3,
        }.items():
            setattr(surfaces, name, self._array(getattr(scene, name), dtype))
        surfaces.sky = scene.sky
        materials = np.zeros(len(scene.materials), k.Material.numpy_dtype())
        for row, material in zip(materials, scene.materials, strict=True):
            for name, value in asdict(material).items():
                row[name] = value
            row["dull"] = INVISIBLE ** (1 / max(material.shininess, INVISIBLE))
        surfaces.materials = self._array(materials, k.Material)
        levels = np.array(scene.levels or [(0, 1, 1)], np.int32)
        surfaces.levels = self._array(levels.view(k.Level.numpy_dtype()).reshape(-1), k.Level)
        return surfaces

    def _describe_views(self) -> None:
        """Set the constant properties of the camera and the lights; `_aim` sets the others."""
        model, k = self._model, self._structs
        near = model.vis.map.znear * model.stat.extent
        self._view_rows = np.zeros(1 + len(self._shadows), k.View.numpy_dtype())
        self._light_rows = np.zeros(len(self._scene.lights), k.Light.numpy_dtype())
        views = self._view_rows
        views["near"], views["size"] = near, self._shadow_side
        views["size"][0] = self._side
        half = np.tan(np.radians(model.cam_fovy[self._camera]) / 2)
        views["focal"][0] = 0.5 * self._side / half
        for n, light in enumerate(self._scene.lights):
            row = self._light_rows[n : n + 1]
            for name in ("ambient", "diffuse", "specular", "attenuation", "cutoff", "exponent"):
                row[name] = getattr(light, name)
            row["directional"], row["shiny"] = light.directional, np.any(light.specular > 0)
            row["shadow"] = self._shadows.index(n) if light.casts_shadow else -1
            if light.casts_shadow:
                view = views[1 + self._shadows.index(n) :][:1]
                view["ortho"] = light.directional
                reach = model.vis.map.shadowclip * model.stat.extent
                if not light.directional:
                    angle = model.light_cutoff[light.index] * model.vis.map.shadowscale
                    reach = np.tan(np.radians(angle))
                view["focal"] = 0.5 * self._shadow_side / reach

    def _record(self) -> dict[str, Any]:
        """Record every launch once; replaying a launch takes microseconds."""
        wp, a = self._wp, self._arrays
        covering, shading = (
            import_module(f"merl.rendering.raster.{name}") for name in ("cover", "shade")
        )
        scene, surfaces, samples = self._scene, self._surfaces, self._samples

        def launch(kernel: Any, dim: Any, inputs: list[Any]) -> Any:
            return wp.launch(kernel, dim=dim, inputs=inputs, device=self._device, record_cmd=True)

        commands = {
            "place": launch(
                covering.place_geoms,
                (1 + len(self._shadows), len(scene.drawn)),
                [surfaces, a.views, a.positions, a.rotations, a.pose, a.offset, a.eyes],
            ),
            "paint": launch(
                shading.paint_background,
                (self._side, self._side),
                [surfaces, a.views, a.lights, a.pose, a.offset, a.behind, a.shadowed],
            ),
            "project": launch(
                covering.project,
                (1 + len(self._shadows), len(scene.vertex_parts)),
                [surfaces, a.views, a.pose, a.offset, a.projected],
            ),
            "shade": launch(
                shading.shade,
                a.colors.shape[0],
                [
                    *(surfaces, a.views, a.lights, a.maps, a.pose, a.projected),
                    *(a.keys, a.behind, a.shadowed, samples, a.colors),
                ],
            ),
            "measure": launch(
                shading.measure,
                a.depth.shape,
                [surfaces, a.keys, a.behind, samples, a.depth, a.geom],
            ),
        }
        maps = [a.maps[n].reshape(-1) for n in range(len(self._shadows))]
        for view, keys in enumerate([a.keys, *maps]):
            commands[f"cover {view}"] = launch(
                covering.cover,
                len(scene.triangle_parts),
                [surfaces, a.views, a.pose, a.offset, a.eyes, a.projected, view, keys],
            )
        return commands

    def _render_array(self, launch: str, name: str) -> NDArray[Any]:
        """Draw the current scene; return a copy of the array `name`, which `launch` fills."""
        with self._lock:  # another thread would draw into the same arrays
            self._draw()
            self._launch(launch)
            array: NDArray[Any] = getattr(self._arrays, name).numpy().copy()
            return array

    def _draw(self) -> None:
        """Compute everything except the colours: poses, background, z-buffer, shadow maps."""
        data = self._data
        self._arrays.positions.assign(data.geom_xpos)
        self._arrays.rotations.assign(data.geom_xmat.reshape(-1, 3, 3))
        poses = (
            data.cam_xpos[self._camera].tobytes(),
            data.cam_xmat[self._camera].tobytes(),
            data.light_xpos.tobytes(),
            data.light_xdir.tobytes(),
            data.geom_xpos[self._planes].tobytes(),
            data.geom_xmat[self._planes].tobytes(),
        )
        moved = poses != self._last_poses
        if moved:
            self._aim()
        self._launch("place")
        if moved:
            self._launch("paint")
            self._last_poses = poses
        self._arrays.keys.zero_()
        self._arrays.maps.zero_()
        self._launch("project")
        for view in range(1 + len(self._shadows)):
            self._launch(f"cover {view}")

    def _launch(self, name: str) -> None:
        command = self._commands[name]
        if command is not None:  # an empty launch records no command
            command.launch()

    def _aim(self) -> None:
        """Set the positions and the directions of the camera and the lights."""
        data, views, lights = self._data, self._view_rows, self._light_rows
        views["eye"][0] = data.cam_xpos[self._camera]
        views["axes"][0] = data.cam_xmat[self._camera].reshape(3, 3)
        for n, light in enumerate(self._scene.lights):
            head = light.index < 0
            lights["position"][n] = views["eye"][0] if head else data.light_xpos[light.index]
            lights["direction"][n] = (
                -views["axes"][0][:, 2] if head else data.light_xdir[light.index]
            )
        for n, index in enumerate(self._shadows):
            views["eye"][1 + n] = lights["position"][index]
            views["axes"][1 + n] = _axes(lights["direction"][index])
        self._arrays.views.assign(views)
        self._arrays.lights.assign(lights)


def _camera_of(model: Any, name: str) -> int:
    """Return the index of a camera of the model.

    Raises:
        MerlError: there is no such camera, or it is orthographic or has a sensor size.
    """
    index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name))
    if index < 0:
        known = [model.camera(n).name for n in range(model.ncam)]
        raise MerlError(f"the model has no camera {name!r}: {suggest(name, known)}")
    is_perspective = model.cam_projection[index] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    if not is_perspective or model.cam_sensorsize[index].any():
        raise MerlError(
            f"renderer 'raster' cannot draw camera {name!r}, which is orthographic or has a sensor "
            "size: give it a field of view (fovy) alone, or use renderer 'gl'"
        )
    return index


def _axes(direction: NDArray[Any]) -> NDArray[Any]:
    """Return the axes (columns: right, up, backward) of a view that looks in a direction."""
    back = -direction / np.linalg.norm(direction)
    helper = (0.0, 1.0, 0.0) if abs(back[2]) > 0.9 else (0.0, 0.0, 1.0)
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)
