"""Warp kernels: compute the colour of each pixel, with OpenGL's fixed lighting (Blinn-Phong).

`paint_background` colours planes and sky, which have no triangles, with a ray for each sample.
`shade` colours each pixel from its nearest surfaces. `measure` writes depth and geoms instead.
"""

import warp as wp

from merl.rendering.raster.lookup import in_shadow_map, lit_share, sample_texture, sky
from merl.rendering.raster.structs import Background, Light, Material, Shadowed, Surfaces, View

wp.set_module_options({"enable_backward": False})

SHADOW_OFFSET = wp.constant(1.5)
"""Distance by which a point is moved off its surface for the shadow test, in texels."""


@wp.func
def reach_of(light: Light, point: wp.vec3) -> float:
    """Return the strength of a light at a point: its attenuation and the fall-off of a spot."""
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
    """Return diffuse and specular light from a world point (Blinn-Phong, as in OpenGL)."""
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
    """Return 1 / depth where a camera ray hits the front of a plane; 0 if it does not hit it."""
    normal = wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    height = wp.dot(normal, offset)
    if height >= 0.0:  # the camera is below the plane
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
    """Return the unlit colour of a plane, with its texture filtered over the pixel."""
    if material.texture < 0:
        return material.color
    local = wp.transpose(rotation) * (ray / inverse - offset)
    level = surfaces.levels[material.texture]
    # Motion of the hit point for one pixel to the right or down, in the plane's axes.
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
    behind: wp.array(dtype=Background),
    shadowed: wp.array2d(dtype=Shadowed),
):
    """Colour planes and sky; to be repeated only after they, the camera or a light have moved."""
    row, column = wp.tid()
    camera = views[0]
    half = 0.5 * float(camera.size)
    pixel = 1.0 / camera.focal
    x, y = float(column) + 0.5, float(row) + 0.5
    ray = wp.vec3((x - half) / camera.focal, (half - y) / camera.focal, -1.0)
    inverse = float(0.0)
    plane = int(-1)
    for n in range(surfaces.planes.shape[0]):
        g = surfaces.planes[n]
        nearer = plane_inverse(rotations[0, g], offsets[0, g], ray)
        if nearer > inverse and nearer * camera.near < 1.0:
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
) -> wp.vec3:
    camera = views[0]
    corners = surfaces.triangles[t]
    g = surfaces.geom_of[t]
    material = surfaces.materials[g]
    a = projected[0, corners[0]]
    b = projected[0, corners[1]]
    c = projected[0, corners[2]]
    share = wp.vec3(1.0, 0.0, 0.0)  # a clipped triangle uses its first corner
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
        footprint = surfaces.density[t] / (camera.focal * inverse)
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
    """Colour a row of pixels; each pixel is the mean of its samples."""
    row = wp.tid()
    side = views[0].size
    for column in range(colors.shape[1]):
        total = wp.vec3(0.0, 0.0, 0.0)
        color = wp.vec3(0.0, 0.0, 0.0)
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
            else:
                color = color_of_triangle(
                    surfaces,
                    views,
                    lights,
                    maps,
                    projected,
                    rotations,
                    int(key & wp.uint64(0xFFFFFFFF)) - 1,
                    float(k) + 0.5,
                    float(j) + 0.5,
                    inverse,
                )
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
    """Write the depth and the geom of each pixel's first sample."""
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
