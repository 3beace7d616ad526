"""The pictures of a simulated recording: exposure by exposure, in order, on several threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tooltip_cli.sources.sim import raster
from tooltip_cli.sources.sim.background import Image, seen_background
from tooltip_cli.sources.sim.bench import CAMERA_FRAME, HAND_FRAME, LINKS, inverse
from tooltip_cli.sources.sim.mesh import Floats
from tooltip_cli.sources.sim.scene import SHADOW_SIZE, shadow_frame
from tooltip_cli.sources.sim.simulation import Simulation, see_tip

Poses = dict[str, Floats]  # camera_from_link by link, (4, 4)

_SAMPLES = 8  # per pixel; each at its own instant and place within exposure and pixel
_BLUR_PX = 6.0  # more blur than this takes more samples
_MOST_SAMPLES = 40
_SPREAD_PX = 0.42  # deviation of the samples' places: the pixel and a slightly soft lens
_CURVE_STEPS = 8192


@dataclass(frozen=True)
class SimFrame:
    """One picture and the truth about it."""

    index: int
    stamp_ns: int  # end of the exposure
    jpeg: bytes
    tip_pixel: Floats  # (2,) u, v at mid-exposure, px; may lie outside the image
    tip_visible: bool  # in view and hidden by nothing
    tip_in_view: bool


@dataclass(frozen=True)
class _Shot:
    """What one exposure sees; kinematics is done by one thread only, as pinocchio shares state."""

    index: int
    middle: Poses
    samples: Sequence[Poses]  # one per instant
    background: Image


@dataclass(frozen=True)
class _Still:
    """What does not move, per place within the pixel: depth, radiance and their mean."""

    depth: NDArray[np.float32]  # (_SAMPLES, h, w)
    radiance: NDArray[np.float32]  # (_SAMPLES, h, w, 4)
    mean: NDArray[np.float32]  # (h, w, 4)
    faces: int  # how many of the scene's first faces these pictures show
    vertices: int  # and of its vertices


def render_frames(simulation: Simulation, jobs: int = 1) -> Iterator[SimFrame]:
    """Render every frame, in order.

    Args:
        simulation: from ``simulate``.
        jobs: threads that render; the kernels run without the interpreter's lock. The bytes do
            not depend on it.
    """
    still = _still(simulation)
    waiting: deque[Future[SimFrame]] = deque()
    with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
        try:
            for shot in _shots(simulation):
                waiting.append(pool.submit(_expose, simulation, still, shot))
                if len(waiting) > 2 * jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def truth(simulation: Simulation, frames: Iterable[SimFrame]) -> dict[str, Any]:
    """Return what ``evaluate`` may know: JSON-ready, metres in the hand frame, pixels."""
    rendered = list(frames)
    return {
        "tool": simulation.params.tool,
        "tip_in_hand_m": simulation.tip_hand.tolist(),
        "axis": simulation.axis_hand.tolist(),
        "other_ends": simulation.other_ends_hand.tolist(),
        "stamps_ns": [frame.stamp_ns for frame in rendered],
        "uv": [frame.tip_pixel.tolist() for frame in rendered],
        "visible": [frame.tip_visible for frame in rendered],
        "in_view": [frame.tip_in_view for frame in rendered],
        "mid_exposure_before_stamp_s": 0.5 * simulation.exposure_s,
        "params": asdict(simulation.params),
    }


def _shots(simulation: Simulation) -> Iterator[_Shot]:
    """Yield the poses and the background of every exposure."""
    sim = simulation
    middles = sim.positions_at(sim.mid_exposure_s)
    nominal = sim.bench.base_from(sim.positions_at(np.zeros(1))[0], (CAMERA_FRAME,))[CAMERA_FRAME]
    background = seen_background(sim.backdrop, sim.camera, np.eye(4))
    for index, positions in enumerate(middles):
        end = sim.image_times_s[index]
        edges = sim.positions_at(np.array([end - sim.exposure_s, end]))
        first, last = (sim.bench.camera_from(q, (HAND_FRAME,))[HAND_FRAME] for q in edges)
        tips = np.array([pose[:3, :3] @ sim.tip_hand + pose[:3, 3] for pose in (first, last)])
        blur = float(np.linalg.norm(np.diff(sim.camera.project(tips), axis=0)))
        count = int(np.clip(_SAMPLES * np.ceil(blur / _BLUR_PX), _SAMPLES, _MOST_SAMPLES))
        instants = end - sim.exposure_s * (1.0 - (np.arange(count) + 0.5) / count)
        if sim.params.head_motion_deg > 0.0:
            base_from_camera = sim.bench.base_from(positions, (CAMERA_FRAME,))[CAMERA_FRAME]
            background = seen_background(
                sim.backdrop, sim.camera, inverse(base_from_camera) @ nominal
            )
        yield _Shot(
            index,
            sim.bench.camera_from(positions, LINKS),
            [sim.bench.camera_from(q, LINKS) for q in sim.positions_at(instants)],
            background,
        )


def _expose(simulation: Simulation, still: _Still, shot: _Shot) -> SimFrame:
    """Render, develop and compress one frame."""
    sim, camera = simulation, simulation.camera
    radiance = still.mean.copy()
    light = _vertex_light(sim, shot.middle, len(sim.scene.geometry.faces))
    faces = (still.faces, len(sim.scene.geometry.faces))
    points = [sim.scene.geometry.placed(poses) for poses in shot.samples]
    left, top, right, bottom = _region(sim, (points[0], points[-1]), still.vertices)
    if left < right and top < bottom:
        total = np.zeros((bottom - top, right - left, 4), dtype=np.float32)
        for k, (placed, poses) in enumerate(zip(points, shot.samples, strict=True)):
            layer = k % _SAMPLES
            depth = still.depth[layer, top:bottom, left:right].copy()
            ids = np.full(depth.shape, -1, dtype=np.int32)
            _trace(sim, placed, poses, faces, layer, light, (left, top), depth, ids, total)
            raster.underlay(ids, still.radiance[layer, top:bottom, left:right], total)
        radiance[top:bottom, left:right] = total / len(points)
    rng = np.random.default_rng([sim.params.seed, shot.index, 1])
    noise = rng.standard_normal((camera.height, camera.width, 3), dtype=np.float32)
    image = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    raster.develop(radiance, shot.background, _CURVE, noise, sim.params.noise_sigma, image)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(sim.params.jpeg_quality)]
    _, jpeg = cv2.imencode(".jpg", image, quality)
    pixel, inside, free = see_tip(camera, sim.scene.geometry, sim.tip_hand, shot.middle)
    return SimFrame(
        shot.index, int(sim.image_stamps_ns[shot.index]), jpeg.tobytes(), pixel, free, inside
    )


def _still(simulation: Simulation) -> _Still:
    """Render once what stays where it is in every image: nothing, if the head moves."""
    sim, camera = simulation, simulation.camera
    shape = (_SAMPLES, camera.height, camera.width)
    depth = np.zeros(shape, dtype=np.float32)
    radiance = np.zeros((*shape, 4), dtype=np.float32)
    count = vertices = 0
    if sim.params.head_motion_deg == 0.0:
        count, vertices = sim.scene.geometry.before("wrist")
        poses = sim.bench.camera_from(sim.positions_at(np.zeros(1))[0], LINKS)
        placed = sim.scene.geometry.placed(poses)
        light = _vertex_light(sim, poses, count)
        for layer in range(_SAMPLES):
            ids = np.full(shape[1:], -1, dtype=np.int32)
            _trace(
                sim, placed, poses, (0, count), layer, light, (0, 0), depth[layer], ids,
                radiance[layer],
            )  # fmt: skip
    return _Still(depth, radiance, radiance.mean(axis=0), count, vertices)


def _trace(
    sim: Simulation, placed: Floats, poses: Poses, faces: tuple[int, int], layer: int,
    light: tuple[Floats, NDArray[np.float32]], corner: tuple[int, int],
    depth: NDArray[np.float32], ids: NDArray[np.int32], total: NDArray[np.float32],
) -> None:  # fmt: skip
    """Draw and shade faces at one instant and one place within the pixel, adding to ``total``."""
    scene, camera = sim.scene, sim.camera
    du, dv = _PLACES[layer]
    view = np.array([camera.fx, camera.fy, camera.cx + du, camera.cy + dv])
    screen = np.empty_like(placed)
    raster.project(placed, view, screen)
    raster.draw(screen, scene.geometry.faces, *faces, *corner, depth, ids)
    rotations = np.stack([poses[link][:3, :3] for link in LINKS])
    raster.shade(
        ids, *corner, screen, view, scene.geometry.faces, scene.corners, light[0],
        scene.face_index, rotations, scene.materials, scene.texture_rows, scene.texels,
        sim.lights.table, sim.lights.room, light[1], total,
    )  # fmt: skip


def _vertex_light(sim: Simulation, poses: Poses, last: int) -> tuple[Floats, NDArray[np.float32]]:
    """Return (V, 4) light data of the vertices and the shadow map of faces up to ``last``."""
    scene = sim.scene
    placed = scene.geometry.placed(poses)
    linear, shift = shadow_frame(sim.lights, poses[HAND_FRAME][:3, 3])
    at = placed @ linear.T + shift
    heights = np.zeros((SHADOW_SIZE, SHADOW_SIZE), dtype=np.float32)
    ids = np.full(heights.shape, -1, dtype=np.int32)
    raster.draw(at, scene.geometry.faces, 0, last, 0, 0, heights, ids)
    return np.column_stack([scene.openness, at]), heights


def _region(sim: Simulation, points: Sequence[Floats], moving: int) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of the pixels that vertices from ``moving`` on reach.

    The first and the last instant of an exposure suffice: between them paths are nearly straight.
    """
    camera = sim.camera
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for placed in points:
        ahead = placed[moving:][placed[moving:, 2] > raster.NEAR_M]
        pixels = camera.project(ahead)
        low = np.minimum(low, pixels.min(axis=0, initial=np.inf))
        high = np.maximum(high, pixels.max(axis=0, initial=-np.inf))
    size = (camera.width, camera.height)
    first, last = np.clip(low - 4.0, 0, size), np.clip(high + 5.0, 0, size)
    return int(first[0]), int(first[1]), int(last[0]), int(last[1])


def _places() -> Floats:
    """Return (_SAMPLES, 2) offsets within the pixel, px: bell-shaped, one per row and column.

    The two orders are uncorrelated with one another and with the instants of the exposure.
    """
    bell = np.array([-1.534, -0.887, -0.489, -0.157, 0.157, 0.489, 0.887, 1.534])  # normal octiles
    return _SPREAD_PX * np.column_stack(
        [bell[[5, 2, 0, 7, 4, 3, 6, 1]], bell[[1, 7, 2, 3, 6, 0, 5, 4]]]
    )


def _curve() -> NDArray[np.float32]:
    """Return (n, 2) the sRGB level 0..255 of linear light 0..1 and the noise's relative deviation.

    Brighter light is noisier, as photons are counted; the deviation is 1 at mid grey.
    """
    light = np.linspace(0.0, 1.0, _CURVE_STEPS)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    level = 255.0 * encoded
    return np.column_stack([level, np.sqrt(0.4 + 0.6 * level / 128.0)]).astype(np.float32)


_PLACES = _places()
_CURVE = _curve()
