"""Warp kernels of the rasteriser: pose, transform, cover, shade; the same source for CPU and CUDA.

`place_geoms` and `project` bring every vertex into the camera's or a light's frame, `cover` writes
for each sample the nearest triangle, `shade` colours each pixel. Planes have no triangles:
`paint_background` meets them with the ray of each sample.

Conventions: a view looks along -z with +x to the right and +y up, as a MuJoCo camera does. The
depth of a point is its distance along the viewing direction, in metres; the buffers compare
1 / depth. Index 0 of what a view has is the camera's.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

SHADOW_OFFSET = wp.constant(1.5)
"""How far a surface is lifted for its look into a shadow map, in texels."""


@wp.struct
class View:
    """A pinhole camera, or a light seen as one.

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
    """A light of the model; angles as cosines."""

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
    shadow: int  # index of its shadow map, -1 without


@wp.struct
class Material:
    """How a surface reflects light; `texture` is the index of its first mipmap level, or -1."""

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
    """One mipmap level: where its texels start, and how many there are."""

    start: int
    width: int
    height: int


@wp.struct
class Surfaces:
    """What can be hit, as `raster_scene.Scene`: triangles, planes, and what they look like."""

    drawn: wp.array(dtype=int)  # the model's geoms that are drawn; all other geoms count in these
    vertices: wp.array(dtype=wp.vec3)
    geom_of_vertex: wp.array(dtype=int)
    triangles: wp.array(dtype=wp.vec3i)
    geom_of: wp.array(dtype=int)
    facing: wp.array(dtype=wp.vec4)  # of a triangle's plane: above 0 for points in front of it
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
    sky: int  # the level with the sky's cube map, -1 without


@wp.kernel
def place_geoms(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    positions: wp.array(dtype=wp.vec3),
    rotations: wp.array(dtype=wp.mat33),
    out_rotations: wp.array2d(dtype=wp.mat33),
    out_offsets: wp.array2d(dtype=wp.vec3),
    out_eyes: wp.array2d(dtype=wp.vec4),
):
    """Each drawn geom's pose in the frame of each view."""
    v, g = wp.tid()
    view = views[v]
    inverse = wp.transpose(view.axes)
    geom = surfaces.drawn[g]
    out_rotations[v, g] = inverse * rotations[geom]
    out_offsets[v, g] = inverse * (positions[geom] - view.eye)
    # Where the view looks from, in the geom's frame: a point, or a direction without a place.
    local = wp.transpose(rotations[geom])
    if view.ortho == 1:
        back = local * wp.vec3(view.axes[0, 2], view.axes[1, 2], view.axes[2, 2])
        out_eyes[v, g] = wp.vec4(back[0], back[1], back[2], 0.0)
    else:
        eye = local * (view.eye - positions[geom])
        out_eyes[v, g] = wp.vec4(eye[0], eye[1], eye[2], 1.0)


@wp.func
def in_line(z: float) -> float:
    """What an orthographic view has for 1 / depth: positive within a kilometre, and linear."""
    return 1.0 + 1.0e-3 * z


@wp.kernel
def project(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    rotations: wp.array2d(dtype=wp.mat33),
    offsets: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.vec3),
):
    """Each vertex as (column, row, 1 / depth); 1 / depth <= 0 marks one before the near plane."""
    v, i = wp.tid()
    view = views[v]
    g = surfaces.geom_of_vertex[i]
    p = rotations[v, g] * surfaces.vertices[i] + offsets[v, g]
    half = 0.5 * float(view.size)
    if view.ortho == 1:
        out[v, i] = wp.vec3(half + view.focal * p[0], half - view.focal * p[1], in_line(p[2]))
    elif -p[2] < view.near:
        out[v, i] = wp.vec3(0.0, 0.0, -1.0)
    else:
        inverse = -1.0 / p[2]
        out[v, i] = wp.vec3(
            half + view.focal * p[0] * inverse, half - view.focal * p[1] * inverse, inverse
        )


@wp.func
def keep_nearest(keys: wp.array(dtype=wp.uint64), i: int, inverse: float, triangle: int):
    """Nearer triangles have larger keys; of equally near ones the later has."""
    bits = wp.cast(inverse, wp.uint32)
    wp.atomic_max(keys, i, (wp.uint64(bits) << wp.uint64(32)) | wp.uint64(triangle + 1))


@wp.func
def keep_nearest(keys: wp.array(dtype=wp.float32), i: int, inverse: float, triangle: int):
    wp.atomic_max(keys, i, inverse)


@wp.func
def draw_triangle(
    a: wp.vec3, b: wp.vec3, c: wp.vec3, triangle: int, size: int, keys: wp.array(dtype=Any)
):
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area < 0.0:
        limit = float(size)
        left = wp.max(wp.min(a[0], wp.min(b[0], c[0])), 0.0)
        right = wp.min(wp.max(a[0], wp.max(b[0], c[0])), limit)
        top = wp.max(wp.min(a[1], wp.min(b[1], c[1])), 0.0)
        bottom = wp.min(wp.max(a[1], wp.max(b[1], c[1])), limit)
        x0 = int(wp.ceil(left - 0.5))
        x1 = int(wp.ceil(right - 0.5))
        y0 = int(wp.ceil(top - 0.5))
        y1 = int(wp.ceil(bottom - 0.5))
        if x0 < x1 and y0 < y1:
            scale = 1.0 / area
            # Barycentric coordinates are linear in the column and the row.
            ux = (b[1] - c[1]) * scale
            uy = (c[0] - b[0]) * scale
            vx = (c[1] - a[1]) * scale
            vy = (a[0] - c[0]) * scale
            px = float(x0) + 0.5
            for y in range(y0, y1):
                py = float(y) + 0.5
                u = (px - c[0]) * ux + (py - c[1]) * uy
                v = (px - c[0]) * vx + (py - c[1]) * vy
                row = y * size
                for x in range(x0, x1):
                    w = 1.0 - u - v
                    if u >= 0.0 and v >= 0.0 and w >= 0.0:
                        inverse = u * a[2] + v * b[2] + w * c[2]
                        keep_nearest(keys, row + x, inverse, triangle)
                    u += ux
                    v += vx


@wp.func
def on_near_plane(p: wp.vec3, q: wp.vec3, view: View) -> wp.vec3:
    """Where the edge from p (behind) to q (in front) meets the near plane, projected."""
    share = (-view.near - p[2]) / (q[2] - p[2])
    hit = p + share * (q - p)
    half = 0.5 * float(view.size)
    inverse = 1.0 / view.near
    return wp.vec3(
        half + view.focal * hit[0] * inverse, half - view.focal * hit[1] * inverse, inverse
    )


@wp.kernel
def cover(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    rotations: wp.array2d(dtype=wp.mat33),
    offsets: wp.array2d(dtype=wp.vec3),
    eyes: wp.array2d(dtype=wp.vec4),
    projected: wp.array2d(dtype=wp.vec3),
    v: int,
    keys: wp.array(dtype=Any),
):
    """Write each triangle where it is the nearest so far; clip what crosses the near plane."""
    t = wp.tid()
    g = surfaces.geom_of[t]
    if wp.dot(surfaces.facing[t], eyes[v, g]) <= 0.0:  # seen from behind
        return
    corners = surfaces.triangles[t]
    a = projected[v, corners[0]]
    b = projected[v, corners[1]]
    c = projected[v, corners[2]]
    size = views[v].size
    if a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0:
        draw_triangle(a, b, c, t, size, keys)
    elif a[2] > 0.0 or b[2] > 0.0 or c[2] > 0.0:
        view = views[v]
        # Turn the triangle until its first corner is in front and its last is behind.
        i, j, k = corners[0], corners[1], corners[2]
        for _ in range(2):
            if not (projected[v, i][2] > 0.0 and projected[v, k][2] <= 0.0):
                first = i
                i = j
                j = k
                k = first
        p = rotations[v, g] * surfaces.vertices[i] + offsets[v, g]
        q = rotations[v, g] * surfaces.vertices[j] + offsets[v, g]
        r = rotations[v, g] * surfaces.vertices[k] + offsets[v, g]
        start = projected[v, i]
        end = on_near_plane(r, p, view)
        if projected[v, j][2] > 0.0:
            corner = on_near_plane(r, q, view)
            draw_triangle(start, projected[v, j], corner, t, size, keys)
            draw_triangle(start, corner, end, t, size, keys)
        else:
            draw_triangle(start, on_near_plane(q, p, view), end, t, size, keys)


@wp.func
def texel(texels: wp.array(dtype=wp.vec3), level: Level, column: int, row: int) -> wp.vec3:
    return texels[level.start + row * level.width + column]


@wp.func
def sample_level(texels: wp.array(dtype=wp.vec3), level: Level, u: float, v: float) -> wp.vec3:
    """Bilinear, repeating; u to the right and v down, both in textures."""
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
    """Trilinear: between the two mipmap levels whose texels are about as large as a pixel."""
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
    """The cube map's colour in a direction of the world; its six faces lie below one another."""
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


@wp.struct
class Background:
    """A sample of what lies behind all triangles: a plane (its geom) or the sky (geom -1).

    `color` is what the lights without a shadow map give.
    """

    color: wp.vec3
    inverse: float
    geom: int


@wp.struct
class Shadowed:
    """What a light with a shadow map adds to a sample, and where its map says whether it does."""

    color: wp.vec3
    where: wp.vec3


@wp.func
def in_shadow_map(view: View, point: wp.vec3, normal: wp.vec3, offset: float) -> wp.vec3:
    """A point of the world as (column, row, 1 / depth) in a light's view.

    It is lifted off its surface by `offset` texels, so that the surface does not shadow itself.
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
    """How much of a light reaches a place in its shadow map, in [0, 1]: four texels, weighted."""
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


@wp.func
def reach_of(light: Light, point: wp.vec3) -> float:
    """How strong a light is at a point: its attenuation and the fall-off of a spot."""
    if light.directional == 1:
        return 1.0
    away = point - light.position
    distance = wp.max(wp.length(away), 1.0e-6)
    along = wp.dot(away, light.direction) / distance
    if along < light.cutoff:
        return 0.0
    a = light.attenuation
    fall = 1.0 / wp.max(a[0] + distance * (a[1] + distance * a[2]), 1.0e-6)
    if light.exponent > 0.0:
        fall *= wp.pow(wp.max(along, 0.0), light.exponent)
    return fall


@wp.func
def reflect_light(
    light: Light,
    fall: float,
    material: Material,
    base: wp.vec3,
    point: wp.vec3,
    normal: wp.vec3,
    viewer: wp.vec3,
) -> wp.vec3:
    """Diffuse and specular light of the world's point (Blinn-Phong, as OpenGL's fixed lighting)."""
    to_light = -light.direction
    if light.directional == 0:
        to_light = wp.normalize(light.position - point)
    facing = wp.dot(normal, to_light)
    if facing <= 0.0 or fall <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    color = (fall * facing) * wp.cw_mul(light.diffuse, base)
    if light.shiny == 1:
        glance = wp.dot(normal, wp.normalize(to_light + viewer))
        if glance > material.dull:
            strength = fall * material.specular * wp.pow(glance, material.shininess)
            color += strength * light.specular
    return color


@wp.func
def plane_inverse(rotation: wp.mat33, offset: wp.vec3, ray: wp.vec3) -> float:
    """1 / depth at which a ray of the camera meets a plane from its front; 0: it does not."""
    normal = wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    height = wp.dot(normal, offset)
    if height >= 0.0:  # the camera is below it
        return 0.0
    return wp.max(wp.dot(normal, ray) / height, 0.0)


@wp.func
def plane_base(
    surfaces: Surfaces,
    rotation: wp.mat33,
    offset: wp.vec3,
    material: Material,
    size: wp.vec2,
    ray: wp.vec3,
    inverse: float,
    pixel: float,
) -> wp.vec3:
    """A plane's colour before it is lit, its texture filtered over the pixel."""
    if material.texture < 0:
        return material.color
    local = wp.transpose(rotation) * (ray / inverse - offset)
    level = surfaces.levels[material.texture]
    # How far the hit moves for one pixel to the right or down, by the plane's own axes.
    normal = wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    slope = wp.dot(normal, ray)
    right = (wp.vec3(pixel, 0.0, 0.0) - ray * (normal[0] * pixel / slope)) / inverse
    down = (wp.vec3(0.0, -pixel, 0.0) + ray * (normal[1] * pixel / slope)) / inverse
    right = wp.transpose(rotation) * right
    down = wp.transpose(rotation) * down
    columns = material.repeat[0] * float(level.width)
    rows = material.repeat[1] * float(level.height)
    across = wp.length(wp.vec2(right[0] * columns, right[1] * rows))
    along = wp.length(wp.vec2(down[0] * columns, down[1] * rows))
    u = (local[0] + wp.max(size[0], 0.0)) * material.repeat[0]
    v = (wp.max(size[1], 0.0) - local[1]) * material.repeat[1]
    texture = sample_texture(
        surfaces.texels, surfaces.levels, material, u, v, wp.max(across, along)
    )
    return wp.cw_mul(material.color, texture)


@wp.kernel
def paint_background(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    lights: wp.array(dtype=Light),
    rotations: wp.array2d(dtype=wp.mat33),
    offsets: wp.array2d(dtype=wp.vec3),
    samples: int,
    behind: wp.array(dtype=Background),
    shadowed: wp.array2d(dtype=Shadowed),
):
    """Planes and sky, once for as long as neither they nor the camera nor a light moves."""
    row, column = wp.tid()
    camera = views[0]
    half = 0.5 * float(camera.size)
    pixel = float(samples) / camera.focal
    x, y = float(column) + 0.5, float(row) + 0.5
    ray = wp.vec3((x - half) / camera.focal, (half - y) / camera.focal, -1.0)
    inverse = float(0.0)
    plane = int(-1)
    for n in range(surfaces.planes.shape[0]):
        g = surfaces.planes[n]
        nearer = plane_inverse(rotations[0, g], offsets[0, g], ray)
        if nearer > inverse:
            inside = int(1)
            size = surfaces.plane_sizes[n]
            local = wp.transpose(rotations[0, g]) * (ray / nearer - offsets[0, g])
            if size[0] > 0.0 and wp.abs(local[0]) > size[0]:
                inside = 0
            if size[1] > 0.0 and wp.abs(local[1]) > size[1]:
                inside = 0
            if inside == 1:
                inverse = nearer
                plane = n
    i = row * camera.size + column
    found = Background()
    found.inverse = inverse
    found.geom = int(-1)
    axes = camera.axes
    if plane < 0:
        if surfaces.sky >= 0:
            found.color = sky(surfaces.texels, surfaces.levels[surfaces.sky], axes * ray)
    else:
        g = surfaces.planes[plane]
        found.geom = g
        rotation, offset = rotations[0, g], offsets[0, g]
        material = surfaces.materials[g]
        size = surfaces.plane_sizes[plane]
        base = plane_base(surfaces, rotation, offset, material, size, ray, inverse, pixel)
        point = camera.eye + axes * (ray / inverse)
        normal = axes * wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
        viewer = -wp.normalize(axes * ray)
        color = material.emission * base
        for n in range(lights.shape[0]):
            light = lights[n]
            fall = reach_of(light, point)
            color += fall * wp.cw_mul(light.ambient, base)
            reflected = reflect_light(light, fall, material, base, point, normal, viewer)
            if light.shadow < 0:
                color += reflected
            else:
                cast = Shadowed()
                cast.color = reflected
                cast.where = in_shadow_map(views[1 + light.shadow], point, normal, 0.0)
                shadowed[light.shadow, i] = cast
        found.color = color
    behind[i] = found


@wp.func
def color_of_triangle(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    lights: wp.array(dtype=Light),
    maps: wp.array3d(dtype=wp.float32),
    projected: wp.array2d(dtype=wp.vec3),
    rotations: wp.array2d(dtype=wp.mat33),
    t: int,
    x: float,
    y: float,
    inverse: float,
    samples: float,
) -> wp.vec3:
    camera = views[0]
    corners = surfaces.triangles[t]
    g = surfaces.geom_of[t]
    material = surfaces.materials[g]
    a = projected[0, corners[0]]
    b = projected[0, corners[1]]
    c = projected[0, corners[2]]
    share = wp.vec3(1.0, 0.0, 0.0)  # of a clipped triangle: its first corner's
    if a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0:
        u = ((b[0] - x) * (c[1] - y) - (c[0] - x) * (b[1] - y)) * a[2]
        v = ((c[0] - x) * (a[1] - y) - (a[0] - x) * (c[1] - y)) * b[2]
        w = ((a[0] - x) * (b[1] - y) - (b[0] - x) * (a[1] - y)) * c[2]
        share = wp.vec3(u, v, w) / (u + v + w)
    indices = surfaces.normal_of[t]
    normal = (
        share[0] * surfaces.normals[indices[0]]
        + share[1] * surfaces.normals[indices[1]]
        + share[2] * surfaces.normals[indices[2]]
    )
    base = material.color
    where = surfaces.coordinate_of[t]
    if material.texture >= 0 and where[0] >= 0:
        uv = (
            share[0] * surfaces.coordinates[where[0]]
            + share[1] * surfaces.coordinates[where[1]]
            + share[2] * surfaces.coordinates[where[2]]
        )
        footprint = surfaces.density[t] * samples / (camera.focal * inverse)
        texture = sample_texture(
            surfaces.texels, surfaces.levels, material, uv[0], uv[1], footprint
        )
        base = wp.cw_mul(base, texture)
    half = 0.5 * float(camera.size)
    ray = wp.vec3((x - half) / camera.focal, (half - y) / camera.focal, -1.0)
    point = camera.eye + camera.axes * (ray / inverse)
    normal = wp.normalize(camera.axes * (rotations[0, g] * normal))
    viewer = wp.normalize(camera.eye - point)
    color = material.emission * base
    for n in range(lights.shape[0]):
        light = lights[n]
        fall = reach_of(light, point)
        reflected = reflect_light(light, fall, material, base, point, normal, viewer)
        if light.shadow >= 0 and reflected[0] + reflected[1] + reflected[2] > 0.0:
            spot = in_shadow_map(views[1 + light.shadow], point, normal, SHADOW_OFFSET)
            reflected = lit_share(maps, light.shadow, spot) * reflected
        color += fall * wp.cw_mul(light.ambient, base) + reflected
    return color


@wp.kernel
def shade(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    lights: wp.array(dtype=Light),
    maps: wp.array3d(dtype=wp.float32),
    rotations: wp.array2d(dtype=wp.mat33),
    projected: wp.array2d(dtype=wp.vec3),
    keys: wp.array(dtype=wp.uint64),
    behind: wp.array(dtype=Background),
    shadowed: wp.array2d(dtype=Shadowed),
    samples: int,
    colors: wp.array3d(dtype=wp.uint8),
):
    """Colour each pixel: the mean of its samples x samples, shading each surface in it once."""
    row, column = wp.tid()
    side = views[0].size
    total = wp.vec3(0.0, 0.0, 0.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    last = int(-3)
    for s in range(samples * samples):
        j = row * samples + s / samples
        k = column * samples + s % samples
        i = j * side + k
        key = keys[i]
        inverse = wp.cast(wp.uint32(key >> wp.uint64(32)), float)
        if key == wp.uint64(0) or behind[i].inverse > inverse:
            color = behind[i].color
            if behind[i].geom >= 0:
                for n in range(maps.shape[0]):
                    color += lit_share(maps, n, shadowed[n, i].where) * shadowed[n, i].color
            last = int(-3)
        else:
            triangle = int(key & wp.uint64(0xFFFFFFFF)) - 1
            surface = surfaces.geom_of[triangle]
            if surface != last:
                color = color_of_triangle(
                    surfaces,
                    views,
                    lights,
                    maps,
                    projected,
                    rotations,
                    triangle,
                    float(k) + 0.5,
                    float(j) + 0.5,
                    inverse,
                    float(samples),
                )
                last = surface
        for n in range(3):
            total[n] += wp.clamp(color[n], 0.0, 1.0)
    scale = 255.0 / float(samples * samples)
    for n in range(3):
        colors[row, column, n] = wp.uint8(total[n] * scale + 0.5)


@wp.kernel
def measure(
    surfaces: Surfaces,
    keys: wp.array(dtype=wp.uint64),
    behind: wp.array(dtype=Background),
    samples: int,
    depth: wp.array2d(dtype=float),
    geom: wp.array2d(dtype=int),
):
    """Depth and geom of each pixel's first sample."""
    row, column = wp.tid()
    i = (row * depth.shape[1] * samples + column) * samples
    key = keys[i]
    inverse = wp.cast(wp.uint32(key >> wp.uint64(32)), float)
    found = int(-1)
    if key == wp.uint64(0) or behind[i].inverse > inverse:
        inverse = behind[i].inverse
        found = behind[i].geom
    else:
        found = surfaces.geom_of[int(key & wp.uint64(0xFFFFFFFF)) - 1]
    depth[row, column] = wp.where(inverse > 0.0, 1.0 / inverse, wp.inf)
    geom[row, column] = wp.where(found >= 0, surfaces.drawn[wp.max(found, 0)], -1)
