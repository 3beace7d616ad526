"""Everything that is drawn, packed for the kernels, with the light that falls on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tooltip_cli.sources.sim.background import Image
from tooltip_cli.sources.sim.bench import LINKS
from tooltip_cli.sources.sim.grasp import Grasp
from tooltip_cli.sources.sim.hand import forearm_mesh, upper_arm_mesh, wrist_mesh
from tooltip_cli.sources.sim.materials import Material
from tooltip_cli.sources.sim.mesh import Floats, Mesh, corner_normals, merged
from tooltip_cli.sources.sim.raster import draw

SHADOW_SIZE = 320  # samples along each side of the shadow map
_SHADOW_REACH_M = 0.36  # half its width
_SHADOW_LIFT_M = 10.0  # heights in the map stay positive
_OPENNESS_DIRECTIONS = 48


@dataclass(frozen=True)
class Lights:
    """One key light and the room's reflected light, fixed in the camera frame.

    The camera turns by a few degrees at most, so lights that turn with it look the same.
    """

    table: Floats  # (6, 3): direction to the key light, its colour, four ambient terms
    room: NDArray[np.float32]  # (2, n, n, 3) sphere maps, blurred and clear


@dataclass(frozen=True)
class Geometry:
    """The shapes of all links, ordered by link."""

    meshes: tuple[Mesh, ...]  # in the order of LINKS, each in its link's frame
    vertices: Floats  # (V, 3) m
    vertex_link: NDArray[np.int64]  # (V,) index into LINKS
    faces: NDArray[np.int32]  # (F, 3)

    def placed(self, camera_from_link: Mapping[str, Floats]) -> Floats:
        """Return (V, 3) vertices in the camera frame."""
        points = np.empty_like(self.vertices)
        for index, link in enumerate(LINKS):
            own = self.vertex_link == index
            pose = camera_from_link[link]
            points[own] = self.vertices[own] @ pose[:3, :3].T + pose[:3, 3]
        return points

    def before(self, link: str) -> tuple[int, int]:
        """Return how many faces and vertices belong to the links before this one."""
        meshes = self.meshes[: LINKS.index(link)]
        return sum(len(mesh.faces) for mesh in meshes), sum(len(mesh.vertices) for mesh in meshes)


@dataclass(frozen=True)
class Scene:
    """Arrays in the layout that ``raster.shade`` describes."""

    geometry: Geometry
    corners: NDArray[np.float32]  # (F, 3, 5)
    face_index: NDArray[np.int32]  # (F, 2) material and link
    openness: Floats  # (V,) share of the surroundings that each vertex sees
    materials: Floats  # (M, 5)
    texture_rows: NDArray[np.int64]  # (M, 3)
    texels: NDArray[np.float32]  # (T, 4)


def build_geometry(grasp: Grasp) -> Geometry:
    """Return the arm and what the hand holds."""
    shapes = {
        "upper_arm": upper_arm_mesh(),
        "forearm": forearm_mesh(),
        "wrist": wrist_mesh(),
        "hand": merged([grasp.hand, grasp.tool]),
    }
    meshes = tuple(shapes[link] for link in LINKS)
    whole = merged(meshes)
    link = np.repeat(np.arange(len(LINKS)), [len(mesh.vertices) for mesh in meshes])
    return Geometry(meshes, whole.vertices, link, whole.faces.astype(np.int32))


def build_scene(geometry: Geometry, materials: Sequence[Material]) -> Scene:
    """Return shapes with the surfaces and the light that the kernels need."""
    meshes = geometry.meshes
    counts = [len(mesh.faces) for mesh in meshes]
    normals = np.vstack([corner_normals(mesh) for mesh in meshes])
    uv = np.vstack([mesh.uv for mesh in meshes])
    material = np.concatenate([mesh.material for mesh in meshes])
    table, rows, texels = _pack(materials)
    return Scene(
        geometry,
        np.concatenate([normals, uv], axis=2).astype(np.float32),
        np.column_stack([material, np.repeat(np.arange(len(meshes)), counts)]).astype(np.int32),
        np.concatenate([openness(mesh) for mesh in meshes]),
        table,
        rows,
        texels,
    )


def build_lights(texture: Image, rng: np.random.Generator) -> Lights:
    """Return light that suits a backdrop (h, w, 3): its colours all round, and a window."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    towards = np.array(
        [side * rng.uniform(0.35, 0.8), -rng.uniform(0.6, 1.0), -rng.uniform(0.3, 0.8)]
    )
    towards /= np.linalg.norm(towards)
    mean = texture.reshape(-1, 3).mean(axis=0).astype(np.float64)
    tone = 0.65 + 0.35 * mean / max(float(mean.mean()), 1e-3)
    key = float(rng.uniform(0.75, 1.05)) * np.array([1.0, 0.97, 0.92])
    sky = 0.42 * tone
    table = np.vstack([towards, key, sky, 0.0 * sky, -0.20 * tone, -0.10 * tone])
    return Lights(table, _room(texture, towards))


def shadow_frame(lights: Lights, centre: Floats) -> tuple[Floats, Floats]:
    """Return (3, 3) and (3,) that take camera-frame points to shadow map pixels and height."""
    axes = _light_axes(lights.table[0])
    scale = np.array([0.5 * SHADOW_SIZE / _SHADOW_REACH_M] * 2 + [1.0])
    linear = axes * scale[:, None]
    shift = np.array([0.5 * SHADOW_SIZE, 0.5 * SHADOW_SIZE, _SHADOW_LIFT_M])
    return linear, shift - linear @ centre


def openness(mesh: Mesh) -> Floats:
    """Return (V,) the cosine-weighted share of the surroundings that each vertex sees.

    Ambient occlusion by depth maps from directions spread over the sphere (golden spiral).
    """
    index = np.arange(_OPENNESS_DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * index / _OPENNESS_DIRECTIONS
    turn = np.pi * (1.0 + 5.0**0.5) * index
    ring = np.sqrt(1.0 - height**2)
    directions = np.column_stack([ring * np.cos(turn), ring * np.sin(turn), height])
    normals = _vertex_normals(mesh)
    faces = mesh.faces.astype(np.int32)
    lifted = mesh.vertices + 0.002 * normals
    size = 224
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    reach = 1.02 * float(np.linalg.norm(mesh.vertices - centre, axis=1).max())
    seen, total = np.zeros(len(lifted)), np.full(len(lifted), 1e-9)
    for direction in directions:
        axes = _light_axes(direction)
        scale = np.array([0.5 * size / reach, 0.5 * size / reach, 1.0])
        shift = np.array([0.5 * size, 0.5 * size, _SHADOW_LIFT_M])
        screen = ((mesh.vertices - centre) @ axes.T) * scale + shift
        depth = np.zeros((size, size), dtype=np.float32)
        ids = np.full((size, size), -1, dtype=np.int32)
        draw(screen, faces, 0, len(faces), 0, 0, depth, ids)
        at = ((lifted - centre) @ axes.T) * scale + shift
        column = np.clip(np.round(at[:, 0]).astype(np.int64), 0, size - 1)
        row = np.clip(np.round(at[:, 1]).astype(np.int64), 0, size - 1)
        cosine = np.maximum(normals @ direction, 0.0)
        seen += cosine * (at[:, 2] + 0.002 >= depth[row, column])
        total += cosine
    return np.asarray(0.12 + 0.88 * seen / total)


def _vertex_normals(mesh: Mesh) -> Floats:
    p = mesh.vertices[mesh.faces]
    area = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    total = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], area)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-18))


def _light_axes(towards: Floats) -> Floats:
    """Return (3, 3) rows: map x, map y, height towards the light; a view as through a camera."""
    helper = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(helper, towards)
    x /= np.linalg.norm(x)
    return np.vstack([x, np.cross(-towards, x), towards])


def _room(texture: Image, towards: Floats) -> NDArray[np.float32]:
    """Return sphere maps of a made-up room: the backdrop all round, a window, a lighter ceiling."""
    size = 96
    grid = np.linspace(-1.0, 1.0, size)
    x, y = np.meshgrid(grid, grid)
    radius = np.minimum(np.hypot(x, y), 1.0)
    z = 2.0 * radius**2 - 1.0
    across = np.sqrt(np.maximum(1.0 - z**2, 0.0)) / np.maximum(radius, 1e-6)
    direction = np.stack([x * across, y * across, z], axis=-1)
    small = cv2.resize(texture, (96, 72), interpolation=cv2.INTER_AREA)
    column = (0.5 + 0.48 * direction[..., 0]) * 95.0
    row = (0.5 + 0.48 * direction[..., 1]) * 71.0
    seen = cv2.remap(small, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
    ceiling = np.clip(-direction[..., 1:2], 0.0, 1.0) * 0.5
    window = np.clip((direction @ towards - 0.86) / 0.06, 0.0, 1.0)[..., None] * 1.6
    clear = cv2.GaussianBlur((0.8 * seen + ceiling + window).astype(np.float32), (0, 0), 0.8)
    return np.stack([cv2.GaussianBlur(clear, (0, 0), 7.0), clear]).astype(np.float32)


def _pack(
    materials: Sequence[Material],
) -> tuple[Floats, NDArray[np.int64], NDArray[np.float32]]:
    table = np.array(
        [[1.0 / m.period_m, m.specular, m.exponent, m.metal, m.mirror] for m in materials]
    )
    sizes = [m.texture.shape[:2] for m in materials]
    starts = np.cumsum([0, *(h * w for h, w in sizes)])[:-1]
    rows = np.array([(s, h, w) for s, (h, w) in zip(starts, sizes, strict=True)], dtype=np.int64)
    flat: list[NDArray[Any]] = [m.texture.reshape(-1, 4) for m in materials]
    return table, rows, np.vstack(flat)
