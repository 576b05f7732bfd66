"""Warp kernels: find the nearest triangle at each sample, for the camera and for each light.

`place_geoms` and `project` transform every vertex into the frame of each view. `cover` draws the
triangles into the z-buffer of a view.
"""

from typing import Any

import warp as wp

from merl.rendering.raster.structs import Surfaces, View

wp.set_module_options({"enable_backward": False})


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
    """Compute the pose of each drawn geom in the frame of each view."""
    v, g = wp.tid()
    view = views[v]
    inverse = wp.transpose(view.axes)
    geom = surfaces.drawn[g]
    out_rotations[v, g] = inverse * rotations[geom]
    out_offsets[v, g] = inverse * (positions[geom] - view.eye)
    # Position of the viewer in the geom's frame: a point (w = 1), or only a direction (w = 0).
    local = wp.transpose(rotations[geom])
    if view.ortho == 1:
        back = local * wp.vec3(view.axes[0, 2], view.axes[1, 2], view.axes[2, 2])
        out_eyes[v, g] = wp.vec4(back[0], back[1], back[2], 0.0)
    else:
        eye = local * (view.eye - positions[geom])
        out_eyes[v, g] = wp.vec4(eye[0], eye[1], eye[2], 1.0)


@wp.func
def in_line(z: float) -> float:
    """Return 1 / depth as orthographic views define it: linear, and positive within 1 km."""
    return 1.0 + 1.0e-3 * z


@wp.kernel
def project(
    surfaces: Surfaces,
    views: wp.array(dtype=View),
    rotations: wp.array2d(dtype=wp.mat33),
    offsets: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.vec3),
):
    """Compute each vertex as (column, row, 1 / depth); <= 0 means before the near plane."""
    v, n = wp.tid()
    view, part = views[v], surfaces.vertex_parts[n]
    rotation, offset = rotations[v, part[0]], offsets[v, part[0]]
    half = 0.5 * float(view.size)
    for i in range(part[1], part[2]):
        p = rotation * surfaces.vertices[i] + offset
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
    """Keep the nearest triangle: it has the largest key; of equally near ones the later has."""
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
    """Return the projected point where the edge from p (hidden) to q (visible) is clipped."""
    share = (-view.near - p[2]) / (q[2] - p[2])
    hit = p + share * (q - p)
    half = 0.5 * float(view.size)
    inverse = 1.0 / view.near
    return wp.vec3(
        half + view.focal * hit[0] * inverse, half - view.focal * hit[1] * inverse, inverse
    )


@wp.func
def draw_clipped(
    surfaces: Surfaces,
    view: View,
    rotation: wp.mat33,
    offset: wp.vec3,
    projected: wp.array2d(dtype=wp.vec3),
    v: int,
    t: int,
    keys: wp.array(dtype=Any),
):
    """Draw the visible part of a triangle that crosses the near plane."""
    corners = surfaces.triangles[t]
    # Rotate the corners until the first one is visible and the last one is hidden.
    i, j, k = corners[0], corners[1], corners[2]
    for _ in range(2):
        if not (projected[v, i][2] > 0.0 and projected[v, k][2] <= 0.0):
            first = i
            i = j
            j = k
            k = first
    p = rotation * surfaces.vertices[i] + offset
    q = rotation * surfaces.vertices[j] + offset
    r = rotation * surfaces.vertices[k] + offset
    start = projected[v, i]
    end = on_near_plane(r, p, view)
    if projected[v, j][2] > 0.0:
        corner = on_near_plane(r, q, view)
        draw_triangle(start, projected[v, j], corner, t, view.size, keys)
        draw_triangle(start, corner, end, t, view.size, keys)
    else:
        draw_triangle(start, on_near_plane(q, p, view), end, t, view.size, keys)


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
    """Draw each triangle where it is the nearest so far; clip triangles at the near plane."""
    part = surfaces.triangle_parts[wp.tid()]
    g = part[0]
    eye, size = eyes[v, g], views[v].size
    for t in range(part[1], part[2]):
        if wp.dot(surfaces.facing[t], eye) > 0.0:  # else only its back is visible
            corners = surfaces.triangles[t]
            a = projected[v, corners[0]]
            b = projected[v, corners[1]]
            c = projected[v, corners[2]]
            if a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0:
                draw_triangle(a, b, c, t, size, keys)
            elif a[2] > 0.0 or b[2] > 0.0 or c[2] > 0.0:
                draw_clipped(
                    surfaces, views[v], rotations[v, g], offsets[v, g], projected, v, t, keys
                )
