"""The detect stage of the voting method: moving edges of frames paired by the hand's motion."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.detections import read_provenance
from tooltip_cli.log.edges import read_edges, write_edges
from tooltip_cli.log.recording import LoggedImage, Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.lighting import gain
from tooltip_cli.method.voting.moving import (
    FrameEdges,
    Image,
    MovingEdges,
    canny_thresholds,
    image_edges,
    join,
    moving_edges,
    noise_level,
    smooth,
)
from tooltip_cli.method.voting.pairing import Pairing
from tooltip_cli.method.voting.params import MovingParams, VotingSettings
from tooltip_cli.method.voting.silhouette import FrameSilhouette
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
from tooltip_cli.stages.clock import Lap, laps
from tooltip_cli.stages.passes import look_through
from tooltip_cli.stages.scene import Scene

SUFFIX = ".edges.mcap"
VERSION = 5
_NOISE_PAIRS = 8
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class DetectedEdges:
    """What the stage returns: the artifact and its content."""

    path: Path
    key: str
    reused: bool
    edges: MovingEdges


@dataclass(frozen=True)
class PendingEdges:
    """Edges that are still to be found.

    Attributes:
        job: who is to look at the images, perhaps in a pass with others.
    """

    recording: Recording
    path: Path
    key: str
    params: dict[str, Any]
    job: FramesJob

    def finish(self, jobs: int = 1, on_frame: Callable[[], None] = lambda: None) -> DetectedEdges:
        """Look at the images, if that was not done yet, and write what was found.

        Raises:
            TooltipError: an image cannot be decoded, or the artifact not written.
        """
        recording = self.recording
        if not self.job.done:
            self.job.on_frame = on_frame
            look_through(recording, [self.job], jobs)
        edges = self.job.edges()
        lap = laps()
        ensure_directory(self.path.parent)
        write_edges(
            self.path,
            edges,
            recording.image_stamps_ns,
            recording.image_frame,
            provenance(recording.path, recording.sha256, self.key, self.params),
        )
        lap("write")
        return DetectedEdges(self.path, self.key, False, edges)


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
    found = known_edges(recording, views, pairing, settings, out=out, force=force, jobs=jobs)
    return found if isinstance(found, DetectedEdges) else found.finish(jobs, on_frame)


def known_edges(
    recording: Recording,
    views: Views,
    pairing: Pairing,
    settings: VotingSettings,
    *,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
) -> DetectedEdges | PendingEdges:
    """Return the edges that are stored, or what will find them; see `detect_edges_in`.

    Raises:
        TooltipError: an image cannot be decoded.
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
    if pairing.levels.any():  # where all are matched whole, as before there were levels
        parents["levels"] = digest(pairing.levels)
    key = stage_key("edges", VERSION, parents, params)
    if not force:
        for place in known_places(recording.path, SUFFIX, out):
            stored = _stored(place, key, recording)
            if stored is not None:
                return DetectedEdges(place, key, True, stored)
    job = FramesJob(recording, views, pairing, settings, jobs)
    return PendingEdges(recording, artifact_path(recording.path, SUFFIX, out), key, params, job)


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
) -> MovingEdges:
    """Find the edges and silhouettes of all chosen frames; they do not depend on ``jobs``."""
    job = FramesJob(recording, views, pairing, settings, jobs)
    look_through(recording, [job], jobs)
    return job.edges()


class FramesJob:
    """The job of finding the edges and silhouettes of all chosen frames.

    Making it looks at a few images, for the noise and for the scene behind the hand.

    Attributes:
        on_frame: called after every frame, for progress.
    """

    def __init__(
        self,
        recording: Recording,
        views: Views,
        pairing: Pairing,
        settings: VotingSettings,
        jobs: int,
    ) -> None:
        lap = laps()
        light = light_in(recording, noise_frames(pairing, len(views.stamps_ns)))
        lap("noise")
        scene = Scene(recording, views, pairing.frames, settings.silhouette, jobs)
        lap("background")
        self.on_frame: Callable[[], None] = lambda: None
        self._pairing, self._found = pairing, list[FrameEdges]()
        self._finder = _Finder(views, scene, light, settings.moving)

    @property
    def done(self) -> bool:
        """Whether all images have been looked at."""
        return len(self._found) == len(self._pairing.frames)

    def part(self, start: int, stop: int) -> _SomeFrames:
        """Return the chosen ones of some images."""
        rows = slice(*np.searchsorted(self._pairing.frames, [start, stop]))
        pairing = self._pairing
        return _SomeFrames(
            self._finder, pairing.frames[rows], pairing.partners[rows], pairing.levels[rows]
        )

    def add(self, result: list[FrameEdges]) -> None:
        """Take the edges of some frames."""
        self._found += result
        for _ in result:
            self.on_frame()

    def edges(self) -> MovingEdges:
        """Return what was found."""
        return join(self._pairing.frames, self._pairing.partners, self._found)


@dataclass(frozen=True)
class _Finder:
    """What finding the edges of any frame takes."""

    views: Views
    scene: Scene
    light: Light
    params: MovingParams


class Look:
    """A smoothed image, and its edges once somebody asks."""

    def __init__(self, gray: Image, params: MovingParams) -> None:
        self.smoothed = smooth(gray, params)
        self._params = params
        self._edges: dict[tuple[int, int], npt.NDArray[np.int32]] = {}

    def edges(self, noise: float) -> npt.NDArray[np.int32]:
        """Return the edges (N, 2) that stand out from so much noise, grey levels."""
        thresholds = canny_thresholds(noise, self._params)
        if thresholds not in self._edges:
            self._edges[thresholds] = image_edges(self.smoothed, thresholds, self._params)
        return self._edges[thresholds]


def look_at(image: LoggedImage, gray: Image, params: MovingParams) -> Look:
    """Return the look that all jobs share, given the image's grey levels."""
    return image.once((Look, params), lambda: Look(gray, params))


class _SomeFrames:
    """Some chosen frames (F,) with their partners (F, 2), before and after, and levels (F,).

    Memory: the images from a frame's first partner to its second.
    """

    def __init__(
        self, finder: _Finder, frames: Indices, partners: Indices, levels: Indices
    ) -> None:
        self.wanted = frozenset(map(int, (*frames, *partners.ravel())))
        self._finder, self._frames, self._partners = finder, frames, partners
        self._levels = levels
        self._centres, self._radii = hand_in_image(finder.views, frames, finder.params.reach)
        self._looks: dict[int, Look] = {}
        self._silhouettes: list[FrameSilhouette] = []
        self._found: list[FrameEdges] = []

    def take(self, index: int, image: LoggedImage, lap: Lap) -> None:
        """Look at a frame or a partner."""
        gray = image.gray
        lap("decode")
        self._looks[index] = look_at(image, gray, self._finder.params)
        lap("smooth")
        if index in self._frames:
            colour = image.decode(gray=False)
            lap("decode")
            turned = self._finder.views.root_from_camera[index]
            self._silhouettes.append(self._finder.scene.silhouette(colour, turned))
            lap("silhouettes")
        while len(self._found) < len(self._frames) and self._last_of_next() <= index:
            self._found.append(self._next())
            wanted = self._partners[len(self._found) :]
            for past in [i for i in self._looks if not len(wanted) or i < wanted.min()]:
                del self._looks[past]
        lap("moving edges")

    def result(self) -> list[FrameEdges]:
        """Return the frames' edges and silhouettes."""
        return self._found

    def _last_of_next(self) -> int:
        return int(self._partners[len(self._found), 1])

    def _next(self) -> FrameEdges:
        row = len(self._found)
        look = self._looks[int(self._frames[row])]
        light = self._finder.light
        before, after = (self._looks[int(index)].smoothed for index in self._partners[row])
        edges = moving_edges(
            look.smoothed,
            (before, after),
            self._centres[row],
            float(self._radii[row]),
            light.noise,
            self._finder.params,
            int(self._levels[row]),
            look.edges(light.noise),
            light.steady,
        )
        return replace(edges, silhouette=self._silhouettes[row])


def noise_frames(pairing: Pairing, count: int) -> Indices:
    """Return (P, 2) chosen frames and their later partners, evenly spread, that show the noise.

    Where none are chosen, neighbours among all ``count`` images show it.
    """
    firsts, seconds = pairing.frames, pairing.partners[:, 1]
    if not len(firsts):
        firsts, seconds = np.arange(count - 1), np.arange(1, count)
    few = min(_NOISE_PAIRS, len(firsts))
    rows = np.linspace(0, len(firsts) - 1, few).astype(int)
    return np.stack([firsts[rows], seconds[rows]], axis=1)


@dataclass(frozen=True)
class Light:
    """What some pairs of images show of sensor and lamps."""

    noise: float  # of the sensor, grey levels
    steady: bool  # whether all images are equally bright, and need not be made so


def light_in(recording: Recording, pairs: Indices) -> Light:
    """Look at (P, 2) pairs of images for the noise and for light that flickers."""

    def look() -> Light:
        images = list(recording.images(pairs.ravel(), gray=True))
        shown = list(zip(images[::2], images[1::2], strict=True))
        return Light(noise_level(shown), all(gain(*pair) == 1.0 for pair in shown))

    return recording.once((light_in, pairs.tobytes()), look)


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
