"""A MuJoCo model as the rasteriser draws it: triangles, materials, textures, lights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError

DRAWN_GROUPS = 3
"""Geoms of the groups below this are drawn, as MuJoCo does by default."""
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
"""A geom's own colour counts where it is another than this, else its material's."""


@dataclass
class Light:
    """A light; `index` is the model's, -1 for the headlight."""

    index: int
    ambient: NDArray[Any]
    diffuse: NDArray[Any]
    specular: NDArray[Any]
    attenuation: NDArray[Any]
    cutoff: float
    exponent: float
    directional: bool
    casts_shadow: bool


@dataclass
class Material:
    """What a geom's surface is like; see `raster_kernels.Material`."""

    color: NDArray[Any]
    emission: float = 0.0
    specular: float = 0.5
    shininess: float = 64.0
    texture: int = -1
    levels: int = 0
    repeat: tuple[float, float] = (1.0, 1.0)


@dataclass
class Scene:
    """Everything that does not change from picture to picture; arrays as in `Surfaces`."""

    drawn: list[int] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    planes: Any = field(default_factory=list)
    plane_sizes: Any = field(default_factory=list)
    vertices: Any = field(default_factory=list)
    geom_of_vertex: Any = field(default_factory=list)
    geom_of: Any = None
    triangles: Any = field(default_factory=list)
    normals: Any = field(default_factory=list)
    normal_of: Any = field(default_factory=list)
    coordinates: Any = field(default_factory=list)
    coordinate_of: Any = field(default_factory=list)
    density: Any = field(default_factory=list)
    texels: Any = field(default_factory=list)
    facing: Any = None
    levels: list[tuple[int, int, int]] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    sky: int = -1


@dataclass
class Shape:
    """Triangles of one geom in its own frame: corners, and each corner's normal and coordinates."""

    vertices: NDArray[Any]
    triangles: NDArray[Any]
    normals: NDArray[Any]
    normal_of: NDArray[Any]
    coordinates: NDArray[Any] | None = None
    coordinate_of: NDArray[Any] | None = None


def build_scene(model: Any) -> Scene:
    """Collect what is to be drawn.

    Raises:
        MerlError: a geom is of a kind that has no triangles here.
    """
    scene, textures = Scene(), dict[int, tuple[int, int]]()
    texels: list[NDArray[Any]] = []
    counts = {"vertices": 0, "normals": 0, "coordinates": 0}
    parts: dict[str, list[NDArray[Any]]] = {
        name: []
        for name in ("vertices", "geom_of_vertex", "triangles", "normals", "normal_of", "coordinates", "coordinate_of", "density")
    }
    for geom in range(model.ngeom):
        rgba = _color(model, geom)
        if model.geom_group[geom] >= DRAWN_GROUPS or rgba[3] == 0:
            continue
        kind = mujoco.mjtGeom(model.geom_type[geom])
        number = len(scene.drawn)
        scene.drawn.append(geom)
        material = _material(model, geom, rgba)
        scene.materials.append(material)
        texture = _texture_of(model, geom)
        if texture >= 0:
            if texture not in textures:
                textures[texture] = _add_texture(model, texture, scene, texels)
            material.texture, material.levels = textures[texture]
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            scene.planes.append(number)
            size = model.geom_size[geom][:2]
            scene.plane_sizes.append(size)
            material.repeat = _plane_repeat(model, geom, size)
            continue
        shape = _shape(model, geom, kind)
        if texture >= 0 and shape.coordinates is None:  # a colour of its own, without its pattern
            material.texture = -1
            material.color = material.color * model_mean(model, texture)
        parts["vertices"].append(shape.vertices)
        parts["geom_of_vertex"].append(np.full(len(shape.vertices), number))
        parts["triangles"].append(shape.triangles + counts["vertices"])
        parts["normals"].append(shape.normals)
        parts["normal_of"].append(shape.normal_of + counts["normals"])
        counts["vertices"] += len(shape.vertices)
        counts["normals"] += len(shape.normals)
        none = np.full((len(shape.triangles), 3), -1)
        if shape.coordinates is None or texture < 0 or shape.coordinate_of is None:
            parts["coordinate_of"].append(none)
            parts["density"].append(np.zeros(len(none)))
        else:
            parts["coordinates"].append(shape.coordinates)
            parts["coordinate_of"].append(shape.coordinate_of + counts["coordinates"])
            counts["coordinates"] += len(shape.coordinates)
            level = scene.levels[material.texture]
            parts["density"].append(_density(shape, level[1], level[2]))
    _add_sky(model, scene, texels)
    for name, arrays in parts.items():
        kind_ = np.float32 if name in ("vertices", "normals", "coordinates", "density") else np.int32
        width = {"vertices": 3, "triangles": 3, "normals": 3, "normal_of": 3, "coordinates": 2, "coordinate_of": 3}
        empty = np.zeros((0, width[name]) if name in width else (0,))
        setattr(scene, name, np.concatenate([empty, *arrays]).astype(kind_))
    scene.geom_of = scene.geom_of_vertex[scene.triangles[:, 0]]
    a, b, c = (scene.vertices[scene.triangles[:, n]] for n in range(3))
    normal = np.cross(b - a, c - a)
    scene.facing = np.concatenate([normal, -(normal * a).sum(1, keepdims=True)], 1).astype(np.float32)
    if not len(scene.coordinates):
        scene.coordinates = np.zeros((1, 2), np.float32)
    scene.planes = np.array(scene.planes, np.int32)
    scene.plane_sizes = np.array(scene.plane_sizes, np.float32).reshape(-1, 2)
    scene.texels = np.concatenate([np.zeros((1, 3)), *texels]).astype(np.float32)
    scene.lights = _lights(model)
    return scene


def _color(model: Any, geom: int) -> NDArray[Any]:
    own = model.geom_rgba[geom]
    material = model.geom_matid[geom]
    if material >= 0 and np.allclose(own, DEFAULT_RGBA):
        return np.array(model.mat_rgba[material])
    return np.array(own)


def _material(model: Any, geom: int, rgba: NDArray[Any]) -> Material:
    material = model.geom_matid[geom]
    if material < 0:
        return Material(rgba[:3])
    return Material(
        rgba[:3],
        float(model.mat_emission[material]),
        float(model.mat_specular[material]),
        128.0 * float(model.mat_shininess[material]),
    )


def _texture_of(model: Any, geom: int) -> int:
    material = model.geom_matid[geom]
    if material < 0:
        return -1
    texture = int(model.mat_texid[material][mujoco.mjtTextureRole.mjTEXROLE_RGB])
    return texture if texture >= 0 and model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D else -1


def model_mean(model: Any, texture: int) -> NDArray[Any]:
    """The mean colour of a texture, (3,), in [0, 1]."""
    return _pixels(model, texture).mean(axis=(0, 1))


def _pixels(model: Any, texture: int) -> NDArray[Any]:
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    data = model.tex_data[start : start + height * width * channels]
    image = data.reshape(height, width, channels)[:, :, :3].astype(np.float32) / 255
    return image if image.shape[2] == 3 else np.repeat(image[:, :, :1], 3, axis=2)


def _add_texture(
    model: Any, texture: int, scene: Scene, texels: list[NDArray[Any]]
) -> tuple[int, int]:
    """Append a texture's mipmap levels; returns the first's index and how many."""
    image, first = _pixels(model, texture), len(scene.levels)
    while True:
        _add_level(image, scene, texels)
        if image.shape[0] == image.shape[1] == 1:
            return first, len(scene.levels) - first
        image = _halved(image)


def _add_level(image: NDArray[Any], scene: Scene, texels: list[NDArray[Any]]) -> None:
    start = 1 + sum(len(t) for t in texels)
    scene.levels.append((start, image.shape[1], image.shape[0]))
    texels.append(image.reshape(-1, 3))


def _halved(image: NDArray[Any]) -> NDArray[Any]:
    """Half as high and wide (rounded down, at least 1), each texel the mean of what it covers."""
    for axis in (0, 1):
        count = image.shape[axis]
        half = max(1, count // 2)
        edges = np.linspace(0, count, half + 1)
        cumulated = np.concatenate([np.zeros_like(np.take(image, [0], axis)), np.cumsum(image, axis, np.float64)], axis)
        whole = np.floor(edges).astype(int)
        share = (edges - whole).reshape([-1 if a == axis else 1 for a in range(3)])
        upper = np.minimum(whole + 1, count)
        at = np.take(cumulated, whole, axis) * (1 - share) + np.take(cumulated, upper, axis) * share
        image = np.diff(at, axis=axis) * (half / count)
    return image


def _plane_repeat(model: Any, geom: int, size: NDArray[Any]) -> tuple[float, float]:
    """Textures per metre along the plane's axes."""
    material = model.geom_matid[geom]
    if material < 0:
        return 1.0, 1.0
    repeat, uniform = model.mat_texrepeat[material], model.mat_texuniform[material]
    per_metre = []
    for count, half in zip(repeat, size, strict=True):
        if half <= 0 or uniform:
            per_metre.append(float(count) / 2)
        else:
            per_metre.append(float(count) / (2 * float(half)))
    return per_metre[0], per_metre[1]


def _add_sky(model: Any, scene: Scene, texels: list[NDArray[Any]]) -> None:
    for texture in range(model.ntex):
        if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            image = _pixels(model, texture)
            if image.shape[0] == image.shape[1]:  # one face serves all six
                image = np.concatenate([image] * 6)
            scene.sky = len(scene.levels)
            _add_level(image, scene, texels)
            return


def _lights(model: Any) -> list[Light]:
    head, none = model.vis.headlight, np.array([1.0, 0.0, 0.0])
    lights = []
    if head.active:
        lights.append(
            Light(-1, head.ambient, head.diffuse, head.specular, none, -1.0, 0.0, True, False)
        )
    for n in range(model.nlight):
        if not model.light_active[n]:
            continue
        spot = model.light_type[n] == mujoco.mjtLightType.mjLIGHT_SPOT
        lights.append(
            Light(
                n,
                model.light_ambient[n],
                model.light_diffuse[n],
                model.light_specular[n],
                model.light_attenuation[n],
                float(np.cos(np.radians(model.light_cutoff[n]))) if spot else -1.0,
                float(model.light_exponent[n]) if spot else 0.0,
                bool(model.light_type[n] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
                bool(model.light_castshadow[n]) and model.light_type[n] != mujoco.mjtLightType.mjLIGHT_POINT,
            )
        )
    return lights


def _shape(model: Any, geom: int, kind: Any) -> Shape:
    size = np.array(model.geom_size[geom])
    kinds = mujoco.mjtGeom
    slices, stacks = int(model.vis.quality.numslices), int(model.vis.quality.numstacks)
    if kind == kinds.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind == kinds.mjGEOM_BOX:
        return _box(size)
    if kind == kinds.mjGEOM_SPHERE:
        return _ellipsoid(np.full(3, size[0]), slices, stacks)
    if kind == kinds.mjGEOM_ELLIPSOID:
        return _ellipsoid(size, slices, stacks)
    if kind == kinds.mjGEOM_CAPSULE:
        return _ellipsoid(np.full(3, size[0]), slices, stacks, size[1])
    if kind == kinds.mjGEOM_CYLINDER:
        return _cylinder(size[0], size[1], slices)
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
    raise MerlError(
        f"renderer 'raster' cannot draw geom {name!r} of type {kind.name[7:].lower()}: use renderer "
        "'gl', or put the geom into group 3 or above, which is not drawn"
    )


def _mesh(model: Any, mesh: int) -> Shape:
    def rows(name: str, start: str, count: str) -> NDArray[Any]:
        first = int(getattr(model, start)[mesh])
        return np.array(getattr(model, name)[first : first + int(getattr(model, count)[mesh])])

    triangles = rows("mesh_face", "mesh_faceadr", "mesh_facenum")
    normal_of = rows("mesh_facenormal", "mesh_faceadr", "mesh_facenum")
    shape = Shape(
        rows("mesh_vert", "mesh_vertadr", "mesh_vertnum"),
        triangles,
        rows("mesh_normal", "mesh_normaladr", "mesh_normalnum"),
        normal_of,
    )
    if model.mesh_texcoordadr[mesh] >= 0:
        shape.coordinates = rows("mesh_texcoord", "mesh_texcoordadr", "mesh_texcoordnum")
        shape.coordinate_of = rows("mesh_facetexcoord", "mesh_faceadr", "mesh_facenum")
    return shape


def _box(half: NDArray[Any]) -> Shape:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    normals = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])
    return Shape(corners, np.array(triangles), normals, np.repeat(np.arange(6), 2)[:, None].repeat(3, 1))


def _ellipsoid(radii: NDArray[Any], slices: int, stacks: int, half_length: float = 0.0) -> Shape:
    """Rings from the north to the south pole; a capsule's halves are pulled apart along z."""
    stacks += stacks % 2
    polar = np.linspace(0, np.pi, stacks + 1)
    if half_length:
        polar = np.insert(polar, stacks // 2, np.pi / 2)
    around = np.linspace(0, 2 * np.pi, slices, endpoint=False)
    unit = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones(slices)),
        ],
        axis=-1,
    )
    points = unit * radii
    rings = len(polar)
    points[: rings // 2, :, 2] += half_length
    points[rings - rings // 2 :, :, 2] -= half_length
    normals = unit / radii
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    triangles = _grid(rings, slices)
    return Shape(points.reshape(-1, 3), triangles, normals.reshape(-1, 3), triangles)


def _grid(rings: int, slices: int) -> NDArray[Any]:
    triangles = []
    for ring in range(rings - 1):
        for s in range(slices):
            a, b = ring * slices + s, ring * slices + (s + 1) % slices
            triangles += [(a, a + slices, b + slices), (a, b + slices, b)]
    return np.array(triangles)


def _cylinder(radius: float, half: float, slices: int) -> Shape:
    around = np.linspace(0, 2 * np.pi, slices, endpoint=False)
    circle = np.stack([np.cos(around), np.sin(around), np.zeros(slices)], axis=1)
    rim = circle * (radius, radius, 0)
    vertices = np.concatenate([rim + (0, 0, half), rim - (0, 0, half), [(0, 0, half), (0, 0, -half)]])
    normals = np.concatenate([circle, [(0, 0, 1), (0, 0, -1)]])
    triangles, normal_of = [], []
    for s in range(slices):
        n = (s + 1) % slices
        triangles += [(s, slices + s, slices + n), (s, slices + n, n)]
        normal_of += [(s, s, n), (s, n, n)]
        triangles += [(2 * slices, s, n), (2 * slices + 1, slices + n, slices + s)]
        normal_of += [(slices,) * 3, (slices + 1,) * 3]
    return Shape(vertices, np.array(triangles), normals, np.array(normal_of))


def _density(shape: Shape, width: int, height: int) -> NDArray[Any]:
    """Texels per metre in each triangle."""
    assert shape.coordinates is not None
    assert shape.coordinate_of is not None
    a, b, c = (shape.vertices[shape.triangles[:, n]] for n in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    u, v, w = (shape.coordinates[shape.coordinate_of[:, n]] * (width, height) for n in range(3))
    first, second = v - u, w - u
    covered = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    density: NDArray[Any] = np.sqrt(covered / np.maximum(area, 1e-12))
    return density
