"""Pictures by a z-buffer with a shadow map: `renderer="raster"`, without OpenGL."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.raster_scene import Scene, build_scene
from merl.envs.ray_tracing import _start_warp

SHADOW_SIZE = 192
"""Texels along an edge of a shadow map."""


class RasterRenderer:
    """Draw a MuJoCo model with triangles.

    Args:
        physics: a `dm_control.mjcf.Physics`; its model stays as it is.
        camera: the name of a camera in the model.
        size: height and width of the pictures, in pixels.
        samples: samples along each edge of a pixel; 2 smooths edges.
    """

    def __init__(self, physics: Any, camera: str, size: int, samples: int = 1) -> None:
        _start_warp()
        import warp as wp

        k = importlib.import_module("merl.envs.raster_kernels")
        self._k, self._wp = k, wp
        model, self._data = physics.model.ptr, physics.data.ptr
        self._model = model
        self._camera = model.camera(camera).id
        scene = build_scene(model)
        device = "cpu"
        self._scene = scene
        self._planes = np.array([scene.drawn[n] for n in scene.planes], int)

        def array(values: NDArray[Any], dtype: Any) -> Any:
            return wp.array(values, dtype=dtype, device=device)

        self._vertices = array(scene.vertices, wp.vec3)
        self._geoms = array(scene.geom_of, int)
        self._triangles = array(scene.triangles, wp.vec3i)
        self._which = array(scene.drawn, int)
        self._positions = wp.zeros(model.ngeom, dtype=wp.vec3, device=device)
        self._rotations = wp.zeros(model.ngeom, dtype=wp.mat33, device=device)
        self._shadows = [n for n in range(len(scene.lights)) if scene.lights[n].casts]
        views = 1 + len(self._shadows)
        drawn = len(scene.drawn)
        self._pose = wp.zeros((views, drawn), dtype=wp.mat33, device=device)
        self._offset = wp.zeros((views, drawn), dtype=wp.vec3, device=device)
        self._projected = wp.zeros(len(scene.vertices), dtype=wp.vec3, device=device)
        self._from_light = wp.zeros(len(scene.vertices), dtype=wp.vec3, device=device)
        side = self._views_size = size * samples
        self._keys = wp.zeros(side * side, dtype=wp.uint64, device=device)
        texels = SHADOW_SIZE * SHADOW_SIZE
        self._maps = wp.zeros((len(self._shadows), SHADOW_SIZE, SHADOW_SIZE), dtype=wp.float32, device=device)
        self._flat_maps = self._maps.reshape(-1)
        self._behind = wp.zeros(side * side, dtype=k.Background, device=device)
        self._shadowed = wp.zeros((len(self._shadows), side * side), dtype=k.Shadowed, device=device)
        self._still: Any = None
        self._colors = wp.zeros((size, size, 3), dtype=wp.uint8, device=device)
        self._views = wp.zeros(views, dtype=k.View, device=device)
        self._lights = wp.zeros(len(scene.lights), dtype=k.Light, device=device)
        surfaces = k.Surfaces()
        surfaces.geoms, surfaces.triangles = self._geoms, self._triangles
        surfaces.normals = array(scene.normals, wp.vec3)
        surfaces.normal_of = array(scene.normal_of, wp.vec3i)
        surfaces.coordinates = array(scene.coordinates, wp.vec2)
        surfaces.coordinate_of = array(scene.coordinate_of, wp.vec3i)
        surfaces.density = array(scene.density, float)
        surfaces.planes = array(scene.planes, int)
        surfaces.plane_sizes = array(scene.plane_sizes, wp.vec2)
        surfaces.texels = array(scene.texels, wp.vec3)
        surfaces.sky = scene.sky
        materials = wp.zeros(drawn, dtype=k.Material, device=device)
        fill = materials.numpy()
        for n, m in enumerate(scene.materials):
            fill[n]["color"] = m.color
            fill[n]["emission"] = m.emission
            fill[n]["specular"] = m.specular
            fill[n]["shininess"] = m.shininess
            fill[n]["dull"] = 1e-3 ** (1 / max(m.shininess, 1e-3))
            fill[n]["texture"] = m.texture
            fill[n]["levels"] = m.levels
            fill[n]["repeat"] = m.repeat
        surfaces.materials = materials
        levels = wp.zeros(max(1, len(scene.levels)), dtype=k.Level, device=device)
        for n, (start, width, height) in enumerate(scene.levels):
            levels.numpy()[n] = (start, width, height)
        surfaces.levels = levels
        self._surfaces = surfaces
        self._fill_lights(scene)
        view = self._views.numpy()[0:1]
        view["focal"] = 0.5 * side / np.tan(np.radians(model.cam_fovy[self._camera]) / 2)
        view["size"], view["near"] = side, model.vis.map.znear * model.stat.extent
        for n, index in enumerate(self._shadows):
            light = self._views.numpy()[1 + n : 2 + n]
            light["size"], light["near"] = SHADOW_SIZE, model.vis.map.znear * model.stat.extent
            directional = scene.lights[index].directional
            light["ortho"] = directional
            if directional:
                light["focal"] = 0.5 * SHADOW_SIZE / (model.vis.map.shadowclip * model.stat.extent)
            else:
                angle = np.radians(model.light_cutoff[scene.lights[index].index]) * model.vis.map.shadowscale
                light["focal"] = 0.5 * SHADOW_SIZE / np.tan(angle)
        self._bias = 0.003 * model.stat.extent
        self._eye = wp.zeros((views, drawn), dtype=wp.vec4, device=device)
        self._facing = array(scene.facing, wp.vec4)
        self._geom_of = array(scene.geom_of[scene.triangles[:, 0]], int)
        self._commands = self._record(samples)
        self._np = {n: getattr(self, n).numpy() for n in ("_positions","_rotations","_views","_lights","_keys","_maps","_colors")}
        self._view_fields = {n: self._np["_views"][n] for n in ("eye","axes")}
        self._light_fields = {n: self._np["_lights"][n] for n in ("position","direction")}

    def _fill_lights(self, scene: Scene) -> None:
        fill = self._lights.numpy()
        shadow = 0
        for n, light in enumerate(scene.lights):
            for name in ("ambient", "diffuse", "specular", "attenuation", "cutoff", "exponent", "directional"):
                fill[n][name] = getattr(light, name)
            fill[n]["shadow"] = -1
            fill[n]["shiny"] = bool(np.any(light.specular > 0))
            if light.casts:
                fill[n]["shadow"] = shadow
                shadow += 1

    def _record(self, samples: int) -> list[Any]:
        wp, k = self._wp, self._k
        count, triangles = len(self._scene.vertices), len(self._scene.triangles)

        def launch(kernel: Any, dim: Any, inputs: list[Any]) -> Any:
            return wp.launch(kernel, dim=dim, inputs=inputs, device="cpu", record_cmd=True)

        views = self._views.shape[0]
        commands = [
            launch(
                k.place_geoms,
                (views, len(self._scene.drawn)),
                [self._views, self._positions, self._rotations, self._which, self._pose, self._offset, self._eye],
            )
        ]
        size = SHADOW_SIZE * SHADOW_SIZE
        for v in range(views):
            projected = self._projected if v == 0 else self._from_light
            keys = self._keys if v == 0 else self._flat_maps[(v - 1) * size : v * size]
            commands.append(
                launch(
                    k.project,
                    count,
                    [self._views, self._pose, self._offset, self._vertices, self._geoms, v, projected],
                )
            )
            commands.append(
                launch(
                    k.cover,
                    triangles,
                    [
                        self._views,
                        self._pose,
                        self._offset,
                        self._vertices,
                        self._geoms,
                        self._triangles,
                        projected,
                        self._facing,
                        self._geom_of,
                        self._eye,
                        v,
                        keys,
                    ],
                )
            )
        commands.append(
            launch(
                k.shade,
                self._colors.shape[:2],
                [
                    self._surfaces,
                    self._views,
                    self._lights,
                    self._maps,
                    self._pose,
                    self._projected,
                    self._keys,
                    self._behind,
                    self._shadowed,
                    samples,
                    self._bias,
                    self._colors,
                ],
            )
        )
        self._paint = launch(
            k.paint_background,
            (self._views_size, self._views_size),
            [
                self._surfaces,
                self._views,
                self._lights,
                self._pose,
                self._offset,
                samples,
                self._behind,
                self._shadowed,
            ],
        )
        return commands

    def _update(self) -> None:
        data = self._data
        planes = self._planes
        still = (
            data.cam_xpos[self._camera].tobytes(),
            data.cam_xmat[self._camera].tobytes(),
            data.light_xpos.tobytes(),
            data.light_xdir.tobytes(),
            data.geom_xpos[planes].tobytes(),
            data.geom_xmat[planes].tobytes(),
        )
        self._moved = still != self._still
        self._still = still
        self._np["_positions"][:] = data.geom_xpos
        self._np["_rotations"][:] = data.geom_xmat.reshape(-1, 3, 3)
        self._np["_keys"].fill(0)
        self._np["_maps"].fill(0)
        if not self._moved:
            return
        views, lights = self._view_fields, self._light_fields
        views["eye"][0] = data.cam_xpos[self._camera]
        views["axes"][0] = data.cam_xmat[self._camera].reshape(3, 3)
        shadow = 1
        for n, light in enumerate(self._scene.lights):
            if light.index < 0:
                lights["position"][n] = data.cam_xpos[self._camera]
                lights["direction"][n] = -data.cam_xmat[self._camera].reshape(3, 3)[:, 2]
            else:
                lights["position"][n] = data.light_xpos[light.index]
                lights["direction"][n] = data.light_xdir[light.index]
            if light.casts:
                views["eye"][shadow] = lights["position"][n]
                views["axes"][shadow] = _axes(lights["direction"][n])
                shadow += 1

    def render(self) -> NDArray[np.uint8]:
        """See `rendering.Renderer`."""
        self._update()
        place, *others = self._commands
        place.launch()
        if self._moved:
            self._paint.launch()
        for command in others:
            command.launch()
        picture: NDArray[np.uint8] = self._np["_colors"].copy()
        return picture

    def close(self) -> None:
        """Nothing to do: the arrays go with the renderer."""


def _axes(direction: NDArray[Any]) -> NDArray[Any]:
    """Axes (columns: right, up, backward) of a view that looks in a direction."""
    back = -direction / np.linalg.norm(direction)
    helper = np.array([0.0, 1.0, 0.0]) if abs(back[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    right = np.cross(helper, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)
