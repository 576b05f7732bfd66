"""Convert a MuJoCo model for the rasteriser: triangles, materials, textures, lights."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.rendering.raster.shapes import Shape, shape_of
from merl.rendering.raster.textures import Textures, pixels

DRAWN_GROUPS = 3
"""Geoms in groups below this are drawn, as in MuJoCo by default."""
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
"""A geom with this colour takes the colour of its material, if it has one."""

PART = 64
"""Maximum number of vertices or triangles per thread."""

Array = NDArray[Any]


@dataclass
class Light:
    """A light, in OpenGL's terms; `index` is its index in the model, -1 for the headlight.

    `cutoff` is the cosine of a spot's half angle (-1 for other lights). `attenuation` holds the
    constant, linear and quadratic coefficients.
    """

    index: int
    ambient: Array
    diffuse: Array
    specular: Array
    attenuation: Array
    cutoff: float = -1.0
    exponent: float = 0.0
    directional: bool = True
    casts_shadow: bool = False


@dataclass
class Material:
    """Surface properties of a geom; `texture` is its first mipmap level, -1 if none."""

    color: Array
    emission: float = 0.0
    specular: float = 0.5
    shininess: float = 64.0
    texture: int = -1
    levels: int = 0
    repeat: tuple[float, float] = (1.0, 1.0)  # textures per metre, for planes


@dataclass
class Scene:
    """All data that is the same for every image: T triangles with V vertices of G geoms.

    Attributes:
        drawn: the model's geoms that are drawn, (G,); all geom indices below refer to these.
        materials: the material of each drawn geom.
        planes: the drawn geoms that are planes, (P,); they have no triangles.
        plane_sizes: half of their edge lengths, (P, 2), m; 0 means infinite.
        lights: the headlight, and the model's active lights.
        vertices: (V, 3), m, in their geom's frame.
        triangles: vertices of each triangle, (T, 3), counterclockwise from outside.
        geom_of: geom of each triangle, (T,).
        vertex_parts, triangle_parts: vertices or triangles of one geom that one thread processes:
            (geom, first, last + 1).
        facing: (T, 4); its product with (x, y, z, 1) is above 0 in front of the triangle.
        normals, normal_of: unit vectors (N, 3), and their indices for the corners, (T, 3).
        coordinates, coordinate_of: texture coordinates (C, 2), and their indices for the corners,
            (T, 3), -1 if none.
        density: texels per metre, (T,).
        texels, levels: texels of all textures, (X, 3) in [0, 1], and (start, width, height) of each
            level.
        sky: the level with the cube map of the sky, -1 if none.
    """

    drawn: Array
    materials: list[Material]
    planes: Array
    plane_sizes: Array
    lights: list[Light]
    vertices: Array
    vertex_parts: Array
    triangle_parts: Array
    triangles: Array
    geom_of: Array
    facing: Array
    normals: Array
    normal_of: Array
    coordinates: Array
    coordinate_of: Array
    density: Array
    texels: Array
    levels: list[tuple[int, int, int]]
    sky: int


def build_scene(model: Any) -> Scene:
    """Collect the visible parts of a MuJoCo model.

    Raises:
        MerlError: a geom has a type that cannot be drawn, or the model has soft bodies.
    """
    if model.nflex or model.nskin:
        raise MerlError(
            f"renderer 'raster' cannot draw the model's {model.nflex} flexes and {model.nskin} "
            "skins: use renderer 'gl'"
        )
    textures, solids = Textures(), _Solids()
    drawn, planes, sizes = list[int](), list[int](), list[Array]()
    materials: list[Material] = []
    for geom in range(model.ngeom):
        rgba = _color(model, geom)
        if model.geom_group[geom] >= DRAWN_GROUPS or rgba[3] == 0:
            continue
        material = _material(model, geom, rgba)
        texture = _texture_of(model, geom)
        if texture >= 0:
            material.texture, material.levels = textures.add(model, texture)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            planes.append(len(drawn))
            sizes.append(model.geom_size[geom][:2])
            material.repeat = _repeats_per_metre(model, geom)
        else:
            shape = shape_of(model, geom)
            if texture >= 0 and shape.coordinates is None:  # use the mean colour of the texture
                material.texture = -1
                material.color = material.color * pixels(model, texture).mean(axis=(0, 1))
            level = textures.levels[material.texture] if material.texture >= 0 else None
            solids.add(shape, len(drawn), level)
        drawn.append(geom)
        materials.append(material)
    sky = -1
    for texture in range(model.ntex):
        if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            sky = textures.add_sky(model, texture)
    return Scene(
        drawn=np.array(drawn, np.int32),
        materials=materials,
        planes=np.array(planes, np.int32),
        plane_sizes=np.array(sizes, np.float32).reshape(-1, 2),
        lights=_lights(model),
        texels=textures.texels(),
        levels=textures.levels,
        sky=sky,
        **solids.arrays(),
    )


class _Solids:
    """The triangles of all geoms, concatenated."""

    def __init__(self) -> None:
        self._parts: dict[str, list[Array]] = {
            "vertices": [np.zeros((0, 3))],
            "geom_of_vertex": [np.zeros(0)],
            "triangles": [np.zeros((0, 3))],
            "normals": [np.zeros((0, 3))],
            "normal_of": [np.zeros((0, 3))],
            "coordinates": [np.zeros((1, 2))],
            "coordinate_of": [np.zeros((0, 3))],
            "density": [np.zeros(0)],
        }

    def add(self, shape: Shape, geom: int, level: tuple[int, int, int] | None) -> None:
        """Append a geom's triangles; `level` is the first level of its texture, None if none."""
        triangles = len(shape.triangles)
        added = {
            "vertices": shape.vertices,
            "geom_of_vertex": np.full(len(shape.vertices), geom),
            "triangles": shape.triangles + self._count("vertices"),
            "normals": shape.normals,
            "normal_of": shape.normal_of + self._count("normals"),
        }
        if level is None or shape.coordinates is None or shape.coordinate_of is None:
            added |= {"coordinate_of": np.full((triangles, 3), -1), "density": np.zeros(triangles)}
        else:
            added |= {
                "coordinates": shape.coordinates,
                "coordinate_of": shape.coordinate_of + self._count("coordinates"),
                "density": shape.texels_per_metre(level[1], level[2]),
            }
        for name, array in added.items():
            self._parts[name].append(array)

    def _count(self, name: str) -> int:
        return sum(len(part) for part in self._parts[name])

    def arrays(self) -> dict[str, Array]:
        """Return the arrays for `Scene`."""
        whole = {name: np.concatenate(parts) for name, parts in self._parts.items()}
        reals = ("vertices", "normals", "coordinates", "density")
        arrays = {
            name: array.astype(np.float32 if name in reals else np.int32)
            for name, array in whole.items()
        }
        a, b, c = (whole["vertices"][arrays["triangles"][:, n]] for n in range(3))
        normal = np.cross(b - a, c - a)
        distance = (normal * a).sum(axis=1, keepdims=True)
        arrays["facing"] = np.concatenate([normal, -distance], axis=1).astype(np.float32)
        geoms = arrays.pop("geom_of_vertex")
        arrays["geom_of"] = geoms[arrays["triangles"][:, 0]]
        arrays["vertex_parts"] = _parts(geoms)
        arrays["triangle_parts"] = _parts(arrays["geom_of"])
        return arrays


def _parts(geoms: Array) -> Array:
    """Split rows, given their geoms, into parts of one geom each: (geom, first, last + 1)."""
    cuts = {0, len(geoms), *(np.flatnonzero(np.diff(geoms)) + 1).tolist()}
    parts = []
    for first, last in pairwise(sorted(cuts)):
        for start in range(first, last, PART):
            parts.append((geoms[first], start, min(start + PART, last)))
    return np.array(parts, np.int32).reshape(-1, 3)


def _color(model: Any, geom: int) -> Array:
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    of_material = material >= 0 and np.allclose(own, DEFAULT_RGBA)
    return np.array(model.mat_rgba[material] if of_material else own)


def _material(model: Any, geom: int, rgba: Array) -> Material:
    material = model.geom_matid[geom]
    if material < 0:
        return Material(rgba[:3])
    return Material(
        color=rgba[:3],
        emission=float(model.mat_emission[material]),
        specular=float(model.mat_specular[material]),
        shininess=128 * float(model.mat_shininess[material]),
    )


def _texture_of(model: Any, geom: int) -> int:
    """Return the geom's texture; -1 if it has none, or one that is not a plain image."""
    material = model.geom_matid[geom]
    if material < 0:
        return -1
    texture = int(model.mat_texid[material][mujoco.mjtTextureRole.mjTEXROLE_RGB])
    plain = texture >= 0 and model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    return texture if plain else -1


def _repeats_per_metre(model: Any, geom: int) -> tuple[float, float]:
    """Return the textures per metre along a plane's two axes."""
    material, size = model.geom_matid[geom], model.geom_size[geom]
    if material < 0:
        return 1.0, 1.0
    uniform = bool(model.mat_texuniform[material])
    x, y = (
        float(count) / (2 if uniform or half <= 0 else 2 * float(half))
        for count, half in zip(model.mat_texrepeat[material], size[:2], strict=True)
    )
    return x, y


def _lights(model: Any) -> list[Light]:
    kinds, head = mujoco.mjtLightType, model.vis.headlight
    steady = np.array([1.0, 0.0, 0.0])
    lights = []
    if head.active:  # a directional light along the camera's axis
        lights.append(Light(-1, head.ambient, head.diffuse, head.specular, steady))
    for n in np.flatnonzero(model.light_active):
        kind = kinds(int(model.light_type[n]))
        light = Light(
            int(n),
            model.light_ambient[n],
            model.light_diffuse[n],
            model.light_specular[n],
            model.light_attenuation[n],
            directional=kind == kinds.mjLIGHT_DIRECTIONAL,
            casts_shadow=bool(model.light_castshadow[n]) and kind != kinds.mjLIGHT_POINT,
        )
        if kind == kinds.mjLIGHT_SPOT:
            light.cutoff = float(np.cos(np.radians(model.light_cutoff[n])))
            light.exponent = float(model.light_exponent[n])
        lights.append(light)
    return lights
