"""Structures that the rasteriser's Warp kernels share.

Conventions: a view looks along -z with +x to the right and +y up, like a MuJoCo camera. The depth
of a point is its distance along the viewing direction, in metres; the buffers compare 1 / depth. In
arrays with one entry per view, the camera is first.
"""

import warp as wp


@wp.struct
class View:
    """A pinhole camera, or a light that is treated as a camera.

    `eye` and `axes` (columns: right, up, backward) are in the world's frame; `focal` is in pixels,
    `size` is the number of samples along an edge; orthographic views have `ortho` = 1 and `focal`
    samples per metre.
    """

    eye: wp.vec3
    axes: wp.mat33
    focal: float
    size: int
    near: float
    ortho: int


@wp.struct
class Light:
    """A light of the model; angles are stored as cosines."""

    position: wp.vec3
    direction: wp.vec3
    ambient: wp.vec3
    diffuse: wp.vec3
    specular: wp.vec3
    attenuation: wp.vec3
    cutoff: float
    exponent: float
    directional: int
    shiny: int  # has a specular colour
    shadow: int  # index of its shadow map, -1 if none


@wp.struct
class Material:
    """Properties of a surface; `texture` is the index of its first mipmap level, -1 if none."""

    color: wp.vec3
    emission: float
    specular: float
    shininess: float
    dull: float  # below this cosine the highlight is invisible
    texture: int
    levels: int
    repeat: wp.vec2


@wp.struct
class Level:
    """One mipmap level: the index of its first texel, its width and its height."""

    start: int
    width: int
    height: int


@wp.struct
class Surfaces:
    """Visible surfaces, as in `scene.Scene`: triangles, planes, materials and textures."""

    drawn: wp.array(dtype=int)  # the model's drawn geoms; all other geom indices refer to these
    vertices: wp.array(dtype=wp.vec3)
    vertex_parts: wp.array(dtype=wp.vec3i)  # geom, first, last + 1
    triangles: wp.array(dtype=wp.vec3i)
    geom_of: wp.array(dtype=int)
    triangle_parts: wp.array(dtype=wp.vec3i)
    facing: wp.array(dtype=wp.vec4)  # plane of a triangle: above 0 for points in front of it
    normals: wp.array(dtype=wp.vec3)
    normal_of: wp.array(dtype=wp.vec3i)
    coordinates: wp.array(dtype=wp.vec2)
    coordinate_of: wp.array(dtype=wp.vec3i)
    density: wp.array(dtype=float)  # texels per metre
    planes: wp.array(dtype=int)
    plane_sizes: wp.array(dtype=wp.vec2)  # half of each edge, m; infinite if not above 0
    materials: wp.array(dtype=Material)
    texels: wp.array(dtype=wp.vec3)
    levels: wp.array(dtype=Level)
    sky: int  # the level with the sky's cube map, -1 if none


@wp.struct
class Background:
    """The background of a sample, behind all triangles: a plane (its geom) or the sky (geom -1).

    `color` contains only the light of the lights without a shadow map.
    """

    color: wp.vec3
    inverse: float
    geom: int


@wp.struct
class Shadowed:
    """Colour that a light with a shadow map adds to a sample, and the point in its map to test."""

    color: wp.vec3
    where: wp.vec3
