"""Closed triangle meshes made by sweeping a cross-section along a path; metres throughout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]

_CREASE_COS = np.cos(np.radians(42.0))  # sharper edges than this stay edges when shaded


@dataclass(frozen=True)
class Mesh:
    """One or more closed surfaces, outward normals by the right-hand rule.

    Surface coordinates are metres along the sweep and turns round it, so that a texture keeps
    its scale whatever the shape.
    """

    vertices: Floats  # (V, 3) m
    faces: Ints  # (F, 3) rows of vertex indices
    uv: Floats  # (F, 3, 2) surface coordinates at each corner
    material: Ints  # (F,) index into the scene's materials


def circle(sides: int) -> Floats:
    """Return the unit circle as a (sides, 2) polygon."""
    return superellipse(sides, 2.0)


def superellipse(sides: int, exponent: float) -> Floats:
    """Return |x|^e + |y|^e = 1 as a (sides, 2) polygon: 2 is a circle, 8 nearly a square."""
    angle = (np.arange(sides) + 0.5) * (2.0 * np.pi / sides)
    point = np.column_stack([np.cos(angle), np.sin(angle)])
    radius = (np.abs(point) ** exponent).sum(axis=1) ** (-1.0 / exponent)
    return np.asarray(point * radius[:, None])


def bevelled(bevel: float) -> Floats:
    """Return the unit square (half width 1) with cut corners as an (8, 2) polygon."""
    c = 1.0 - bevel
    corners = [(1, -c), (1, c), (c, 1), (-c, 1), (-1, c), (-1, -c), (-c, -1), (c, -1)]
    return np.array(corners, dtype=np.float64)


def loft(
    path: ArrayLike,
    widths: ArrayLike,
    section: Floats,
    *,
    material: int,
    up: ArrayLike = (0.0, 0.0, 1.0),
    bulge: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """Sweep a cross-section along a path and close both ends.

    Args:
        path: (n, 3) centres of the rings, m.
        widths: (n, 2) or (n,) half widths of each ring, along the side and the up axis, m.
        section: (m, 2) unit polygon, counter-clockwise seen against the direction of travel.
        material: index of the material.
        up: direction that the section's second axis follows as nearly as the path allows.
        bulge: how far the centre of the first and of the last face stands out, m; the width of
            the ring makes a cone of it, 0 leaves it flat.

    Returns:
        A closed mesh of n rings and two end centres.
    """
    centre = np.asarray(path, dtype=np.float64)
    half = np.asarray(widths, dtype=np.float64)
    if half.ndim == 1:
        half = np.column_stack([half, half])
    tangent, side, upward = _frames(centre, np.asarray(up, dtype=np.float64))
    rings = (
        centre[:, None, :]
        + (section[None, :, 0] * half[:, 0:1])[..., None] * side[:, None, :]
        + (section[None, :, 1] * half[:, 1:2])[..., None] * upward[:, None, :]
    )
    n, m = rings.shape[:2]
    first = centre[0] - tangent[0] * bulge[0]
    last = centre[-1] + tangent[-1] * bulge[1]
    vertices = np.vstack([rings.reshape(-1, 3), first, last])

    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))])
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij"))
    k = (j + 1) % m
    a, b, c, d = i * m + j, i * m + k, (i + 1) * m + k, (i + 1) * m + j
    u0, u1, v0, v1 = along[i], along[i + 1], j / m, (j + 1) / m
    wall = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    wall_uv = np.vstack([_corners(u0, v0, u0, v1, u1, v1), _corners(u0, v0, u1, v1, u1, v0)])

    rim = np.arange(m)
    after = (rim + 1) % m
    start = np.column_stack([after, rim, np.full(m, n * m)])
    last_ring = (n - 1) * m
    end = np.column_stack([last_ring + rim, last_ring + after, np.full(m, n * m + 1)])
    flat = section * half[0] + 0.5  # end faces are textured in metres, away from the origin
    flat_end = section * half[-1] + 0.5
    middle = np.full(m, 0.5)
    start_uv = _corners(*flat[after].T, *flat[rim].T, middle, middle)
    end_uv = _corners(*flat_end[rim].T, *flat_end[after].T, middle, middle)

    faces = np.vstack([wall, start, end]).astype(np.int64)
    return Mesh(
        vertices,
        faces,
        np.vstack([wall_uv, start_uv, end_uv]),
        np.full(len(faces), material, dtype=np.int64),
    )


def revolve(profile: ArrayLike, *, material: int, sides: int = 24, tip: float = 0.0) -> Mesh:
    """Turn a (n, 2) profile of (x, radius) about the x axis; ``tip`` is the end's bulge, m."""
    points = np.asarray(profile, dtype=np.float64)
    path = np.column_stack([points[:, 0], np.zeros((len(points), 2))])
    return loft(path, points[:, 1], circle(sides), material=material, bulge=(0.0, tip))


def box(
    centre: Sequence[float], half: Sequence[float], *, material: int, bevel: float = 0.15
) -> Mesh:
    """Return a box along the axes with cut edges; ``bevel`` is a fraction of its half width."""
    x, y, z = centre
    a, b, c = half
    path = [(x + s * a, y, z) for s in (-1.0, -1.0 / 3.0, 1.0 / 3.0, 1.0)]
    return loft(path, np.full((4, 2), (b, c)), bevelled(bevel), material=material)


def capsule(
    path: ArrayLike, radius: float, *, material: int, sides: int = 14, up: ArrayLike = (1, 0, 0)
) -> Mesh:
    """Return a tube along a (n, 3) path with rounded ends."""
    points = np.asarray(path, dtype=np.float64)
    steps = np.array([0.0, 0.12, 0.45])
    grow = np.sqrt(1.0 - (1.0 - steps) ** 2)
    first = points[0] + (steps[:, None] - 1.0) * radius * _unit(points[1] - points[0])
    last = points[-1] + (1.0 - steps[::-1, None]) * radius * _unit(points[-1] - points[-2])
    widths = np.concatenate(
        [np.maximum(grow, 0.25), np.ones(len(points)), np.maximum(grow[::-1], 0.25)]
    )
    return loft(
        np.vstack([first, points, last]),
        widths * radius,
        circle(sides),
        material=material,
        up=up,
        bulge=(0.03 * radius, 0.03 * radius),
    )


def spline(points: ArrayLike, count: int) -> Floats:
    """Return ``count`` points evenly spread over the Catmull-Rom curve through the given ones."""
    control = np.asarray(points, dtype=np.float64)
    padded = np.vstack([2 * control[0] - control[1], control, 2 * control[-1] - control[-2]])
    t = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None]
    pieces = []
    for p0, p1, p2, p3 in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        pieces.append(
            0.5
            * (
                2 * p1
                + (p2 - p0) * t
                + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2
                + (3 * p1 - p0 - 3 * p2 + p3) * t**3
            )
        )
    dense = np.vstack([*pieces, control[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(wanted, along, dense[:, axis]) for axis in range(3)])


def torus(points: Floats, radius: float, *, material: int) -> Mesh:
    """Return a torus through a closed plane loop of points (in the plane of constant y)."""
    sides = 12
    centre = points.mean(axis=0)
    outward = points - centre
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    rings = (
        points[:, None, :]
        + radius * np.cos(angle)[None, :, None] * outward[:, None, :]
        + radius * np.sin(angle)[None, :, None] * np.array([0.0, 1.0, 0.0])
    )
    n = len(points)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(n), np.arange(sides), indexing="ij"))
    k, h = (i + 1) % n, (j + 1) % sides
    a, b, c, d = i * sides + j, i * sides + h, k * sides + h, k * sides + j
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    vertices = rings.reshape(-1, 3)
    if _volume(vertices, faces) < 0.0:
        faces = faces[:, ::-1]
    uv = np.stack([vertices[faces][..., 0], vertices[faces][..., 2] / 0.1], axis=-1)
    return Mesh(vertices, faces, uv, np.full(len(faces), material))


def moved(mesh: Mesh, to_from_mesh: Floats) -> Mesh:
    """Return the mesh under a 4x4 rigid transform."""
    vertices = mesh.vertices @ to_from_mesh[:3, :3].T + to_from_mesh[:3, 3]
    return replace(mesh, vertices=vertices)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Return all meshes as one; they stay separate closed surfaces."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.vstack([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def corner_normals(mesh: Mesh) -> Floats:
    """Return (F, 3, 3) unit normals per corner, smooth except across creases.

    A corner's normal averages, by area, the faces round its vertex that lie within the crease
    angle of its own face.
    """
    p = mesh.vertices[mesh.faces]
    area = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-18)
    corner_vertex = mesh.faces.ravel()
    order = np.argsort(corner_vertex, kind="stable")
    counts = np.bincount(corner_vertex, minlength=len(mesh.vertices))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    repeat = counts[corner_vertex]
    corner = np.repeat(np.arange(len(corner_vertex)), repeat)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    other = order[starts[corner_vertex[corner]] + within] // 3
    own = corner // 3
    smooth = np.einsum("ij,ij->i", unit[own], unit[other]) > _CREASE_COS
    total = np.zeros((len(corner_vertex), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(
            corner[smooth], weights=area[other[smooth], axis], minlength=len(corner_vertex)
        )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    fallback = np.repeat(unit, 3, axis=0)
    normals = np.where(length > 1e-18, total / np.maximum(length, 1e-18), fallback)
    return normals.reshape(-1, 3, 3)


def rotation(axis: Sequence[float], angle: float) -> Floats:
    """Return the 3x3 rotation by ``angle`` rad about ``axis`` (Rodrigues)."""
    x, y, z = _unit(np.asarray(axis, dtype=np.float64))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross))


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def _corners(*columns: Floats) -> Floats:
    return np.stack(columns, axis=1).reshape(-1, 3, 2)


def _frames(centre: Floats, up: Floats) -> tuple[Floats, Floats, Floats]:
    """Return tangents, side and up axes along a path, the last as close to ``up`` as it can be."""
    tangent = np.gradient(centre, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(up, tangent)
    length = np.linalg.norm(side, axis=1, keepdims=True)
    if float(length.min()) < 1e-3:
        raise ValueError("the path runs along its up direction")
    side /= length
    return tangent, side, np.cross(tangent, side)


def _volume(vertices: Floats, faces: Ints) -> float:
    p = vertices[faces]
    return float(np.einsum("ij,ij->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6.0)
