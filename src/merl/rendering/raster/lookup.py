"""Warp functions: sample textures and the sky, and look up shadow maps."""

import warp as wp

from merl.rendering.raster.cover import in_line
from merl.rendering.raster.structs import Level, Material, View

wp.set_module_options({"enable_backward": False})


@wp.func
def texel(texels: wp.array(dtype=wp.vec3), level: Level, column: int, row: int) -> wp.vec3:
    return texels[level.start + row * level.width + column]


@wp.func
def sample_level(texels: wp.array(dtype=wp.vec3), level: Level, u: float, v: float) -> wp.vec3:
    """Sample bilinearly, with repetition; u points right and v down, in units of textures."""
    x = (u - wp.floor(u)) * float(level.width) - 0.5
    y = (v - wp.floor(v)) * float(level.height) - 0.5
    left = wp.floor(x)
    top = wp.floor(y)
    i0, j0 = int(left), int(top)
    i1, j1 = i0 + 1, j0 + 1
    if i0 < 0:
        i0 += level.width
    if j0 < 0:
        j0 += level.height
    if i1 >= level.width:
        i1 -= level.width
    if j1 >= level.height:
        j1 -= level.height
    across, down = x - left, y - top
    a = texel(texels, level, i0, j0)
    b = texel(texels, level, i0, j1)
    a += across * (texel(texels, level, i1, j0) - a)
    b += across * (texel(texels, level, i1, j1) - b)
    return a + down * (b - a)


@wp.func
def sample_texture(
    texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=Level),
    material: Material,
    u: float,
    v: float,
    texels_per_pixel: float,
) -> wp.vec3:
    """Sample trilinearly, between the two mipmap levels with texels about as large as a pixel."""
    detail = wp.clamp(wp.log2(wp.max(texels_per_pixel, 1.0e-6)), 0.0, float(material.levels - 1))
    lower = int(detail)
    color = sample_level(texels, levels[material.texture + lower], u, v)
    share = detail - float(lower)
    if share > 0.0:
        upper = sample_level(texels, levels[material.texture + lower + 1], u, v)
        color = wp.lerp(color, upper, share)
    return color


@wp.func
def sky(texels: wp.array(dtype=wp.vec3), level: Level, direction: wp.vec3) -> wp.vec3:
    """Return the cube map's colour in a world direction; its six faces are stacked vertically."""
    # OpenGL's cube map axes: x, z and -y of the world (OpenGL 2.1 specification, table 3.19).
    r = wp.vec3(direction[0], direction[2], -direction[1])
    m = wp.abs(r)
    face = int(0)
    s = float(0.0)
    t = float(0.0)
    if m[0] >= m[1] and m[0] >= m[2]:
        face = wp.where(r[0] > 0.0, 0, 1)
        s = wp.where(r[0] > 0.0, -r[2], r[2]) / m[0]
        t = -r[1] / m[0]
    elif m[1] >= m[2]:
        face = wp.where(r[1] > 0.0, 2, 3)
        s = r[0] / m[1]
        t = wp.where(r[1] > 0.0, r[2], -r[2]) / m[1]
    else:
        face = wp.where(r[2] > 0.0, 4, 5)
        s = wp.where(r[2] > 0.0, r[0], -r[0]) / m[2]
        t = -r[1] / m[2]
    side = level.width
    last = float(side) - 1.0
    x = wp.clamp(0.5 * (s + 1.0) * float(side) - 0.5, 0.0, last)
    y = wp.clamp(0.5 * (t + 1.0) * float(side) - 0.5, 0.0, last)
    i = wp.min(int(x), side - 2)
    j = wp.min(int(y), side - 2)
    row = face * side + j
    a = wp.lerp(texel(texels, level, i, row), texel(texels, level, i + 1, row), x - float(i))
    b = wp.lerp(
        texel(texels, level, i, row + 1), texel(texels, level, i + 1, row + 1), x - float(i)
    )
    return wp.lerp(a, b, y - float(j))


@wp.func
def in_shadow_map(view: View, point: wp.vec3, normal: wp.vec3, offset: float) -> wp.vec3:
    """Return a world point as (column, row, 1 / depth) in the view of a light.

    The point is moved off its surface by `offset` texels, so that the surface does not shadow
    itself.
    """
    inverse = wp.transpose(view.axes)
    p = inverse * (point - view.eye)
    half = 0.5 * float(view.size)
    if view.ortho == 1:
        p += (offset / view.focal) * (inverse * normal)
        return wp.vec3(half + view.focal * p[0], half - view.focal * p[1], in_line(p[2]))
    p -= (p[2] * offset / view.focal) * (inverse * normal)
    if -p[2] <= view.near:
        return wp.vec3(-1.0, -1.0, 1.0)  # outside of the map: lit
    scale = -1.0 / p[2]
    return wp.vec3(half + view.focal * p[0] * scale, half - view.focal * p[1] * scale, scale)


@wp.func
def lit_share(maps: wp.array3d(dtype=wp.float32), n: int, where: wp.vec3) -> float:
    """Return the fraction of a light at a point of its shadow map, in [0, 1], from four texels."""
    x, y = where[0] - 0.5, where[1] - 0.5
    left, top = wp.floor(x), wp.floor(y)
    i, j = int(left), int(top)
    if i < 0 or j < 0 or i + 1 >= maps.shape[2] or j + 1 >= maps.shape[1]:
        return 1.0
    inverse = where[2]
    across, down = x - left, y - top
    lit = float(0.0)
    if inverse >= maps[n, j, i]:
        lit += (1.0 - across) * (1.0 - down)
    if inverse >= maps[n, j, i + 1]:
        lit += across * (1.0 - down)
    if inverse >= maps[n, j + 1, i]:
        lit += (1.0 - across) * down
    if inverse >= maps[n, j + 1, i + 1]:
        lit += across * down
    return lit
