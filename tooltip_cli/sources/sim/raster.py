"""Compiled kernels: a depth-buffered triangle rasteriser, its shading, and the sensor.

No system graphics library takes part. The kernels release the interpreter lock, so that frames
render in threads, and each pixel depends on its own frame alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

NEAR_M = 0.05
SHADOW_BIAS_M = 0.004  # the shadow map's own resolution must not shadow a surface


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile with the result kept on disk, or in memory where no folder may be written."""
    options = {"nogil": True, "error_model": "numpy"}
    try:
        kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no writable place for its cache
        kernel = numba.njit(**options)(function)
    return kernel  # type: ignore[no-any-return]


@compiled
def project(points: Array, view: Array, screen: Array) -> None:
    """Write pixel coordinates and inverse depth of (V, 3) camera-frame points to (V, 3).

    ``view`` is (fx, fy, cx, cy) in px; inverse depth 0 marks a point that is too near.
    """
    for i in range(points.shape[0]):
        z = points[i, 2]
        if z < NEAR_M:
            screen[i, 2] = 0.0
        else:
            screen[i, 0] = view[0] * points[i, 0] / z + view[2]
            screen[i, 1] = view[1] * points[i, 1] / z + view[3]
            screen[i, 2] = 1.0 / z


@compiled
def draw(
    screen: Array, faces: Array, first: int, last: int, left: int, top: int, depth: Array,
    ids: Array,
) -> None:  # fmt: skip
    """Draw faces first..last into (h, w) buffers whose corner pixel is (left, top).

    ``depth`` holds values that grow towards the viewer and are linear on the screen (inverse
    depth; 0 is infinitely far), ``ids`` the nearest face.
    """
    height, width = depth.shape
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        wa, wb, wc = screen[a, 2], screen[b, 2], screen[c, 2]
        if wa == 0.0 or wb == 0.0 or wc == 0.0:
            continue
        ax, ay = screen[a, 0] - left, screen[a, 1] - top
        bx, by = screen[b, 0] - left, screen[b, 1] - top
        cx, cy = screen[c, 0] - left, screen[c, 1] - top
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area >= -1e-12:  # v points down: a face seen from outside has a negative area
            continue
        x0 = max(0, math.ceil(min(ax, bx, cx)))
        x1 = min(width - 1, math.floor(max(ax, bx, cx)))
        y0 = max(0, math.ceil(min(ay, by, cy)))
        y1 = min(height - 1, math.floor(max(ay, by, cy)))
        # Barycentric weights are linear in x and y.
        ua, va = (by - cy) / area, (cx - bx) / area
        ub, vb = (cy - ay) / area, (ax - cx) / area
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                la = ua * (x - cx) + va * (y - cy)
                lb = ub * (x - cx) + vb * (y - cy)
                lc = 1.0 - la - lb
                if la >= -1e-9 and lb >= -1e-9 and lc >= -1e-9:
                    w = np.float32(la * wa + lb * wb + lc * wc)
                    if w > depth[y, x]:
                        depth[y, x] = w
                        ids[y, x] = f


@compiled
def _weights(screen: Array, a: int, b: int, c: int, x: float, y: float) -> Any:
    """Return the perspective-correct barycentric weights of a pixel in a face."""
    ax, ay, bx, by = screen[a, 0] - x, screen[a, 1] - y, screen[b, 0] - x, screen[b, 1] - y
    cx, cy = screen[c, 0] - x, screen[c, 1] - y
    la = (bx * cy - by * cx) * screen[a, 2]
    lb = (cx * ay - cy * ax) * screen[b, 2]
    lc = (ax * by - ay * bx) * screen[c, 2]
    total = la + lb + lc
    return la / total, lb / total, lc / total


@compiled
def _texel(texels: Array, row: Array, u: float, v: float) -> Any:
    """Return red, green, blue and gloss of a repeating texture, bilinear; u, v in periods."""
    start, rows, columns = row[0], row[1], row[2]
    x, y = (u - math.floor(u)) * columns, (v - math.floor(v)) * rows
    j0, i0 = min(int(x), columns - 1), min(int(y), rows - 1)
    dx, dy = x - j0, y - i0
    j1, i1 = j0 + 1 if j0 + 1 < columns else 0, i0 + 1 if i0 + 1 < rows else 0
    p, q = texels[start + i0 * columns + j0], texels[start + i0 * columns + j1]
    r, s = texels[start + i1 * columns + j0], texels[start + i1 * columns + j1]
    wp, wq, wr, ws = (1 - dy) * (1 - dx), (1 - dy) * dx, dy * (1 - dx), dy * dx
    return (
        wp * p[0] + wq * q[0] + wr * r[0] + ws * s[0],
        wp * p[1] + wq * q[1] + wr * r[1] + ws * s[1],
        wp * p[2] + wq * q[2] + wr * r[2] + ws * s[2],
        wp * p[3] + wq * q[3] + wr * r[3] + ws * s[3],
    )


@compiled
def lit(shadow: Array, x: float, y: float, w: float) -> float:
    """Return the share (0..1) of the four nearest shadow map samples that let the light pass.

    ``w`` is the point's height towards the light, m.
    """
    i, j = math.floor(y), math.floor(x)
    if i < 0 or j < 0 or i + 1 >= shadow.shape[0] or j + 1 >= shadow.shape[1]:
        return 1.0
    dy, dx = y - i, x - j
    raised = w + SHADOW_BIAS_M
    share = 0.0
    if raised >= shadow[i, j]:
        share += (1.0 - dy) * (1.0 - dx)
    if raised >= shadow[i, j + 1]:
        share += (1.0 - dy) * dx
    if raised >= shadow[i + 1, j]:
        share += dy * (1.0 - dx)
    if raised >= shadow[i + 1, j + 1]:
        share += dy * dx
    return share


@compiled
def _mirrored(room: Array, normal: Any, eye: Any, facing: float) -> Any:
    """Return the row and column of the sphere maps at which a mirror shows the room.

    The map's circle holds all directions; straight ahead is its rim.
    """
    qx, qy = 2 * facing * normal[0] - eye[0], 2 * facing * normal[1] - eye[1]
    qz = 2 * facing * normal[2] - eye[2]
    scale = 0.5 / math.sqrt(max(2.0 * (1.0 - qz), 1e-6))
    last = room.shape[1] - 1
    i = min(max(int((0.5 + scale * qy) * last + 0.5), 0), last)
    j = min(max(int((0.5 + scale * qx) * last + 0.5), 0), last)
    return i, j


@compiled
def _add_radiance(
    base: Any, normal: Any, eye: Any, material: Array, lights: Array, room: Array, open_sky: float,
    seen: float, out: Array,
) -> None:  # fmt: skip
    """Add the light that a surface point sends to the eye to ``out`` (4,), and its coverage.

    Lambert and Blinn-Phong under one key light, a first-order ambient term and a mirrored room;
    ``seen`` and ``open_sky`` are the shares of key light and surroundings that reach the point.
    """
    nx, ny, nz = normal
    ex, ey, ez = eye
    kx, ky, kz = lights[0, 0], lights[0, 1], lights[0, 2]
    specular, exponent, metal, mirror = material[1], material[2], material[3], material[4]
    facing = max(nx * ex + ny * ey + nz * ez, 0.02)
    cosine = max(nx * kx + ny * ky + nz * kz, 0.0) * seen
    glint = 0.0
    if cosine > 0.0:
        hx, hy, hz = kx + ex, ky + ey, kz + ez
        half = (nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz)
        if half > 0.7:  # below, the highlight is dark for every exponent in use
            glint = (exponent + 8.0) / 25.0 * math.exp(exponent * math.log(half)) * cosine
    matt = 1.0 - metal
    grazing = 1.0 - facing
    grazing = 0.6 * grazing * grazing * grazing * grazing * grazing
    gloss = base[3]
    i, j = _mirrored(room, normal, eye, facing)
    for c in range(3):
        sky = lights[2, c] + lights[3, c] * nx + lights[4, c] * ny + lights[5, c] * nz
        light = max(sky, 0.02) * open_sky + lights[1, c] * cosine
        tint = gloss * specular * (matt + 2.0 * metal * base[c])
        fresnel = tint + gloss * (1.0 - min(tint, 1.0)) * grazing
        reflected = (1.0 - mirror) * room[0, i, j, c] + mirror * room[1, i, j, c]
        out[c] += base[c] * matt * light + fresnel * (reflected * open_sky + lights[1, c] * glint)
    out[3] += 1.0


@compiled
def shade(
    ids: Array, left: int, top: int, screen: Array, view: Array, faces: Array, corners: Array,
    vertex_light: Array, face_index: Array, rotations: Array, materials: Array,
    texture_rows: Array, texels: Array, lights: Array, room: Array, shadow: Array, out: Array,
) -> None:  # fmt: skip
    """Add the linear radiance of every drawn pixel to ``out`` (h, w, 4), its coverage last.

    Args:
        ids: (h, w) face drawn at each pixel, -1 for none; its corner pixel is (left, top).
        screen: (V, 3) from ``project``; view: (fx, fy, cx, cy).
        faces: (F, 3); corners: (F, 3, 5) normal in the link's frame, and surface coordinates.
        vertex_light: (V, 4) share of the surroundings seen; pixel and height in the shadow map.
        face_index: (F, 2) material and link; rotations: (L, 3, 3) camera_from_link.
        materials: (M, 5) 1/period, specular, exponent, metal, mirror.
        texture_rows: (M, 3) start, height and width in ``texels`` (T, 4).
        lights: (6, 3) direction to the key light (camera frame), its colour, and the ambient
            light's constant, x, y and z terms.
        room: (2, n, n, 3) sphere maps of the surroundings, blurred and clear.
        shadow: (s, s) height map seen from the key light, m.
    """
    for y in range(ids.shape[0]):
        for x in range(ids.shape[1]):
            f = ids[y, x]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            la, lb, lc = _weights(screen, a, b, c, x + left, y + top)
            r, p, q, s = rotations[face_index[f, 1]], corners[f, 0], corners[f, 1], corners[f, 2]
            mx = la * p[0] + lb * q[0] + lc * s[0]
            my = la * p[1] + lb * q[1] + lc * s[1]
            mz = la * p[2] + lb * q[2] + lc * s[2]
            nx = r[0, 0] * mx + r[0, 1] * my + r[0, 2] * mz
            ny = r[1, 0] * mx + r[1, 1] * my + r[1, 2] * mz
            nz = r[2, 0] * mx + r[2, 1] * my + r[2, 2] * mz
            norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-18)
            normal = (nx * norm, ny * norm, nz * norm)
            ex, ey = (view[2] - x - left) / view[0], (view[3] - y - top) / view[1]
            norm = 1.0 / math.sqrt(ex * ex + ey * ey + 1.0)
            eye = (ex * norm, ey * norm, -norm)
            m = face_index[f, 0]
            u = (la * p[3] + lb * q[3] + lc * s[3]) * materials[m, 0]
            base = _texel(texels, texture_rows[m], u, la * p[4] + lb * q[4] + lc * s[4])
            p, q, s = vertex_light[a], vertex_light[b], vertex_light[c]
            open_sky = la * p[0] + lb * q[0] + lc * s[0]
            seen = lit(
                shadow,
                la * p[1] + lb * q[1] + lc * s[1],
                la * p[2] + lb * q[2] + lc * s[2],
                la * p[3] + lb * q[3] + lc * s[3],
            )
            _add_radiance(base, normal, eye, materials[m], lights, room, open_sky, seen, out[y, x])


@compiled
def underlay(ids: Array, layer: Array, out: Array) -> None:
    """Add what does not move, (h, w, 4), wherever nothing moving was drawn."""
    for y in range(ids.shape[0]):
        for x in range(ids.shape[1]):
            if ids[y, x] < 0 and layer[y, x, 3] > 0.0:
                for i in range(4):
                    out[y, x, i] += layer[y, x, i]


@compiled
def develop(
    radiance: Array, background: Array, curve: Array, noise: Array, sigma: float, out: Array
) -> None:
    """Turn linear light into the camera's 8-bit image (h, w, 3), red first in, blue first out.

    Args:
        radiance: (h, w, 4) premultiplied foreground and its coverage.
        background: (h, w, 3) linear.
        curve: (n, 2) for linear light from 0 to 1: encoded grey level (0..255), and the noise's
            deviation there as a multiple of ``sigma``.
        noise: (h, w, 3) standard normal.
        sigma: deviation of the noise at mid grey, grey levels.
    """
    height, width = out.shape[:2]
    last = curve.shape[0] - 1
    for y in range(height):
        dy = 2.0 * y / height - 1.0
        for x in range(width):
            dx = 2.0 * x / width - 1.0
            clear = 1.0 - radiance[y, x, 3]
            scale = last * (1.0 - 0.09 * (dx * dx + dy * dy))  # darker towards the corners
            for i in range(3):
                light = (radiance[y, x, i] + clear * background[y, x, i]) * scale
                step = int(min(max(light, 0.0), float(last)) + 0.5)
                level = curve[step, 0] + sigma * curve[step, 1] * noise[y, x, i]
                out[y, x, 2 - i] = np.uint8(min(max(level + 0.5, 0.0), 255.0))
