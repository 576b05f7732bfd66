"""Convert geoms to triangles, in the frame of the geom, in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError

Array = NDArray[Any]


@dataclass
class Shape:
    """T triangles: their corners, with the normal and texture coordinates of each corner.

    Attributes:
        vertices: (V, 3), m.
        triangles: indices of vertices, (T, 3), counterclockwise from outside.
        normals: unit vectors, (N, 3).
        normal_of: indices of normals, (T, 3).
        coordinates: texture coordinates, (C, 2), or None.
        coordinate_of: indices of coordinates, (T, 3), or None.
    """

    vertices: Array
    triangles: Array
    normals: Array
    normal_of: Array
    coordinates: Array | None = None
    coordinate_of: Array | None = None

    def texels_per_metre(self, width: int, height: int) -> Array:
        """Return the texels per metre of a texture of this size, (T,); needs coordinates."""
        assert self.coordinates is not None
        assert self.coordinate_of is not None
        a, b, c = (self.vertices[self.triangles[:, n]] for n in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        u, v, w = (self.coordinates[self.coordinate_of[:, n]] * (width, height) for n in range(3))
        (x, y), (p, q) = (v - u).T, (w - u).T
        density: Array = np.sqrt(np.abs(x * q - y * p) / np.maximum(area, 1e-12))
        return density


def shape_of(model: Any, geom: int) -> Shape:
    """Return the triangles of a geom that is not a plane.

    The resolution of curved geoms is set in the model (`vis.quality`).

    Raises:
        MerlError: the type of the geom is not supported (height field, signed distance field).
    """
    kinds, size = mujoco.mjtGeom, np.array(model.geom_size[geom])
    kind = kinds(model.geom_type[geom])
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
        return _ellipsoid(np.full(3, size[0]), slices, stacks, half_length=size[1])
    if kind == kinds.mjGEOM_CYLINDER:
        return _cylinder(size[0], size[1], slices)
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
    raise MerlError(
        f"renderer 'raster' cannot draw geom {name!r} of type {kind.name[7:].lower()}: use "
        "renderer 'gl', or put the geom into group 3 or above, which is not drawn"
    )


def _mesh(model: Any, mesh: int) -> Shape:
    def rows(name: str, start: str, count: str) -> Array:
        first = int(getattr(model, start)[mesh])
        return np.array(getattr(model, name)[first : first + int(getattr(model, count)[mesh])])

    shape = Shape(
        rows("mesh_vert", "mesh_vertadr", "mesh_vertnum"),
        rows("mesh_face", "mesh_faceadr", "mesh_facenum"),
        rows("mesh_normal", "mesh_normaladr", "mesh_normalnum"),
        rows("mesh_facenormal", "mesh_faceadr", "mesh_facenum"),
    )
    if model.mesh_texcoordadr[mesh] >= 0:
        shape.coordinates = rows("mesh_texcoord", "mesh_texcoordadr", "mesh_texcoordnum")
        shape.coordinate_of = rows("mesh_facetexcoord", "mesh_faceadr", "mesh_facenum")
    return shape


def _box(half: Array) -> Shape:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    normals = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])
    return Shape(corners, triangles, normals, np.arange(12)[:, None].repeat(3, axis=1) // 2)


def _ellipsoid(radii: Array, slices: int, stacks: int, half_length: float = 0.0) -> Shape:
    """Build rings from the upper to the lower pole; a capsule's halves are shifted along z."""
    polar = np.linspace(0, np.pi, stacks + stacks % 2 + 1)
    if half_length:  # one middle ring for each half
        polar = np.insert(polar, len(polar) // 2, np.pi / 2)
    rings, around = len(polar), np.linspace(0, 2 * np.pi, slices, endpoint=False)
    unit = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones(slices)),
        ],
        axis=-1,
    )
    points, normals = unit * radii, unit / radii
    points[: rings // 2, :, 2] += half_length
    points[rings - rings // 2 :, :, 2] -= half_length
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    ring, slot = np.mgrid[: rings - 1, :slices].reshape(2, -1)
    a, b = ring * slices + slot, ring * slices + (slot + 1) % slices
    below = np.stack([[a, a + slices, b + slices], [a, b + slices, b]])
    triangles = below.transpose(2, 0, 1).reshape(-1, 3)
    return Shape(points.reshape(-1, 3), triangles, normals.reshape(-1, 3), triangles)


def _cylinder(radius: float, half: float, slices: int) -> Shape:
    around = np.linspace(0, 2 * np.pi, slices, endpoint=False)
    circle = np.stack([np.cos(around), np.sin(around), np.zeros(slices)], axis=1)
    up = np.array([[0.0, 0.0, 1.0]])
    rim, top, bottom = radius * circle, 2 * slices, 2 * slices + 1
    vertices = np.concatenate([rim + half * up, rim - half * up, half * up, -half * up])
    s, n = np.arange(slices), (np.arange(slices) + 1) % slices
    one = np.ones_like(s)
    triangles = [
        (s, slices + s, slices + n),
        (s, slices + n, n),
        (top * one, s, n),
        (bottom * one, slices + n, slices + s),
    ]
    normal_of = [(s, s, n), (s, n, n), (slices * one,) * 3, ((slices + 1) * one,) * 3]
    return Shape(
        vertices,
        np.concatenate([np.stack(t, axis=1) for t in triangles]),
        np.concatenate([circle, up, -up]),
        np.concatenate([np.stack(t, axis=1) for t in normal_of]),
    )
