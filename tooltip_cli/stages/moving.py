"""The detect stage of the voting method: moving edges of frames paired by the hand's motion."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.detections import read_provenance
from tooltip_cli.log.edges import read_edges, write_edges
from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.moving import (
    FrameEdges,
    Image,
    MovingEdges,
    join,
    moving_edges,
    noise_level,
    smooth,
)
from tooltip_cli.method.voting.pairing import Pairing
from tooltip_cli.method.voting.params import MovingParams, VotingSettings
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.stages.artifacts import (
    artifact_path,
    digest,
    ensure_directory,
    known_places,
    provenance,
    stage_key,
)
from tooltip_cli.stages.clock import laps
from tooltip_cli.stages.scene import Scene
from tooltip_cli.stages.threads import in_order

SUFFIX = ".edges.mcap"
VERSION = 3
_FRAMES_A_TASK = 16
_NOISE_PAIRS = 8
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class DetectedEdges:
    """What the stage returns: the artifact and its content."""

    path: Path
    key: str
    reused: bool
    edges: MovingEdges


def detect_edges_in(
    recording: Recording,
    views: Views,
    pairing: Pairing,
    settings: VotingSettings,
    *,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_frame: Callable[[], None] = lambda: None,
) -> DetectedEdges:
    """Find what moves or stands before the background in all chosen frames.

    Writes ``STEM.edges.mcap``, or reuses it. It depends on the rig through the pairing, through
    where the hand is in the images, and through how the camera turns.

    Args:
        jobs: threads; the result does not depend on them.
        on_frame: called after every frame, for progress.

    Raises:
        TooltipError: an image cannot be decoded, or the artifact not written.
    """
    params = {"moving": settings.moving, "silhouette": settings.silhouette}
    centres, radii = hand_in_image(views, pairing.frames, settings.moving.reach)
    parents = {
        "recording": recording.sha256,
        "image_topic": recording.image_topic,
        "frames": digest(pairing.frames),
        "partners": digest(pairing.partners),
        # to the pixel: what is looked at does not change with less
        "hand": digest(np.round(np.column_stack([centres, radii]))),
        "turned": digest(np.round(views.root_from_camera[pairing.frames], 4)),
    }
    key = stage_key("edges", VERSION, parents, params)
    if not force:
        for place in known_places(recording.path, SUFFIX, out):
            stored = _stored(place, key, recording)
            if stored is not None:
                return DetectedEdges(place, key, True, stored)
    edges = find_moving_edges(recording, views, pairing, settings, jobs, on_frame)
    lap = laps()
    path = artifact_path(recording.path, SUFFIX, out)
    ensure_directory(path.parent)
    write_edges(
        path,
        edges,
        recording.image_stamps_ns,
        recording.image_frame,
        provenance(recording.path, recording.sha256, key, params),
    )
    lap("write")
    return DetectedEdges(path, key, False, edges)


def _stored(place: Path, key: str, recording: Recording) -> MovingEdges | None:
    """Return the edges at a place if they have this key and are whole."""
    origin = read_provenance(place)
    if origin is None or origin.get("key") != key:
        return None
    try:
        return read_edges(place, recording.image_stamps_ns)
    except TooltipError:
        _LOGGER.info("%s cannot be read and is made anew", place)
        return None


def find_moving_edges(
    recording: Recording,
    views: Views,
    pairing: Pairing,
    settings: VotingSettings,
    jobs: int,
    on_frame: Callable[[], None],
) -> MovingEdges:
    """Find the edges and silhouettes of all chosen frames; they do not depend on ``jobs``."""
    lap = laps()
    noise = _noise(recording, pairing)
    lap("decode")
    scene = Scene(recording, views, pairing.frames, settings.silhouette)
    lap("background")
    parts: list[FrameEdges] = []
    starts = range(0, len(pairing.frames), _FRAMES_A_TASK)

    def work(start: int) -> list[FrameEdges]:
        edges = _chunk(recording, views, pairing, noise, settings.moving, start)
        shown = scene.silhouettes(pairing.frames[start : start + _FRAMES_A_TASK])
        return [
            replace(part, silhouette=silhouette)
            for part, silhouette in zip(edges, shown, strict=True)
        ]

    for part in in_order(work, starts, jobs):
        parts.append(part)
        on_frame()
    return join(pairing.frames, pairing.partners, parts)


def _noise(recording: Recording, pairing: Pairing) -> float:
    """Estimate the sensor noise from chosen frames and their partners, evenly spread."""
    rows = np.unique(np.linspace(0, len(pairing.frames) - 1, _NOISE_PAIRS).astype(int))
    wanted = [i for row in rows for i in (pairing.frames[row], pairing.partners[row, 1])]
    images = list(recording.images(wanted, gray=True))
    return noise_level(list(zip(images[::2], images[1::2], strict=True)))


def _chunk(
    recording: Recording,
    views: Views,
    pairing: Pairing,
    noise: float,
    params: MovingParams,
    start: int,
) -> list[FrameEdges]:
    frames = pairing.frames[start : start + _FRAMES_A_TASK]
    partners = pairing.partners[start : start + _FRAMES_A_TASK]
    needed = np.unique(np.concatenate([frames, partners.ravel()]))
    lap = laps()
    images: dict[int, Image] = {}
    for index, image in zip(needed, recording.images(needed, gray=True), strict=True):
        lap("decode")
        images[int(index)] = smooth(image, params)
        lap("moving edges")
    centres, radii = hand_in_image(views, frames, params.reach)
    found = [
        moving_edges(
            images[int(frame)],
            (images[int(before)], images[int(after)]),
            centre,
            float(radius),
            noise,
            params,
        )
        for frame, (before, after), centre, radius in zip(
            frames, partners, centres, radii, strict=True
        )
    ]
    lap("moving edges")
    return found


def hand_in_image(views: Views, frames: Indices, reach: float) -> tuple[Array, Array]:
    """Return (F, 2) where the hand's origin projects and (F,) the reach around it, pixels."""
    camera_from_hand = inverse_transform(views.hand_from_camera[frames])
    origins = camera_from_hand[:, :3, 3]
    ahead = np.maximum(origins[:, 2] - 0.5 * reach, 0.1)
    radii = max(views.camera.fx, views.camera.fy) * reach / ahead
    return views.camera.project(origins), radii


def image_extent(camera: CameraModel) -> Array:
    """Return (2, 2) the smallest and largest normalized coordinates seen, within 56 degrees."""
    u = np.linspace(0, camera.width - 1, 33)
    v = np.linspace(0, camera.height - 1, 33)
    border = np.concatenate(
        [
            np.stack([u, np.zeros(33)], axis=1),
            np.stack([u, np.full(33, camera.height - 1.0)], axis=1),
            np.stack([np.zeros(33), v], axis=1),
            np.stack([np.full(33, camera.width - 1.0), v], axis=1),
        ]
    )
    rays = camera.directions(border)
    normalized = np.clip(rays[:, :2] / np.maximum(rays[:, 2:], 1e-6), -1.5, 1.5)
    return np.stack([np.nanmin(normalized, axis=0), np.nanmax(normalized, axis=0)])
