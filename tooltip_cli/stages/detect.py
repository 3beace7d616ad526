"""The detect stage: the tip's pixel in every pair of consecutive images."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.detections import read_detections, read_provenance, write_detections
from tooltip_cli.log.recording import LoggedImage, Recording, Topics, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.detector import (
    Detections,
    DetectorParams,
    Image,
    TipDetection,
    detect_tip,
    find_edges,
)
from tooltip_cli.stages.artifacts import (
    artifact_path,
    ensure_directory,
    known_places,
    provenance,
    stage_key,
)
from tooltip_cli.stages.clock import Lap, laps
from tooltip_cli.stages.passes import Job, Part, look_through

if TYPE_CHECKING:
    from tooltip_cli.stages.near import NearHand

SUFFIX = ".detections.mcap"
VERSION = 1
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Detected:
    """What the stage returns: the artifact and its content."""

    path: Path
    key: str
    reused: bool
    detections: Detections


def detection_key(recording: Recording, params: DetectorParams) -> str:
    """Return the key of detections among all edges, which do not depend on the rig."""
    parents = {"recording": recording.sha256, "image_topic": recording.image_topic}
    return stage_key("detect", VERSION, parents, params)


def detect(
    recording_path: Path,
    *,
    topics: Topics | None = None,
    params: DetectorParams | None = None,
    preset: str = "paper",
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
) -> Detected:
    """Find the tip's pixel in each pair of consecutive images (paper, 3.1), or reuse it.

    Args:
        preset: ``paper``, or ``voting``: look for it near the hand, by the rig in the recording.
        out: directory for the artifact; default: beside the recording.
        force: compute even where a fresh artifact exists.
        jobs: threads; the result does not depend on them.
        on_pair: called after every pair, for progress.

    Raises:
        TooltipError: the recording cannot be read, or the artifact not written.
    """
    recording = read_recording(recording_path, topics or Topics())
    near = None
    if preset != "paper":
        from tooltip_cli.stages.near import near_hand

        views = resolve_views(recording, resolve_rig(recording, None))
        near = near_hand(recording, views, detector=params)
    return detect_in(
        recording, params=params, near=near, out=out, force=force, jobs=jobs, on_pair=on_pair
    )


def detect_in(
    recording: Recording,
    *,
    params: DetectorParams | None = None,
    near: NearHand | None = None,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
    along: Sequence[Job[Any]] = (),
) -> Detected:
    """Do the same for a recording that is already open; see :func:`detect`.

    Args:
        params: of the paper's detector, which weighs all edges.
        near: weigh those near the hand instead, by the parameters that this has.
        along: who is to see the images in the same pass, where one is made.
    """
    params = params or DetectorParams()
    key = detection_key(recording, params) if near is None else near.key
    if not force:
        for place in known_places(recording.path, SUFFIX, out):
            stored = _stored(place, key, recording)
            if stored is not None:
                return Detected(place, key, True, stored)
    if len(recording.image_stamps_ns) < 2:
        raise TooltipError(
            f"{recording.path} holds a single image; detection compares consecutive images, so "
            "record at least two" + "".join(f"; {note}" for note in recording.notes)
        )
    path = artifact_path(recording.path, SUFFIX, out)
    ensure_directory(path.parent)
    lap = laps()
    of_images = (lambda images: _SomePairs(images, params)) if near is None else near.parts()
    lap("noise")
    pairs = _Pairs(len(recording.image_stamps_ns), of_images, on_pair)
    look_through(recording, [pairs, *along], jobs)
    lap = laps()
    detections = _table(pairs.rows)
    write_detections(
        path,
        detections,
        recording.image_stamps_ns,
        recording.image_frame,
        provenance(recording.path, recording.sha256, key, near.params if near else params),
    )
    lap("write")
    return Detected(path, key, False, detections)


def _stored(place: Path, key: str, recording: Recording) -> Detections | None:
    """Return the detections at a place if they have this key and are whole."""
    origin = read_provenance(place)
    if origin is None or origin.get("key") != key:
        return None
    try:
        return read_detections(place, recording.image_stamps_ns)
    except TooltipError:
        _LOGGER.info("%s cannot be read and is made anew", place)
        return None


class _Pairs:
    """The job of finding the tip in all pairs of ``count`` images.

    Args:
        of_images: returns the part of some consecutive images.
    """

    def __init__(
        self,
        count: int,
        of_images: Callable[[range], Part[list[TipDetection]]],
        on_pair: Callable[[], None],
    ) -> None:
        self.rows: list[TipDetection] = []
        self._count, self._of_images, self._on_pair = count, of_images, on_pair

    def part(self, start: int, stop: int) -> Part[list[TipDetection]]:
        """Return the pairs whose first images these are."""
        return self._of_images(range(start, min(stop + 1, self._count)))

    def add(self, result: list[TipDetection]) -> None:
        """Take detections."""
        self.rows += result
        for _ in result:
            self._on_pair()


class _SomePairs:
    """The pairs of some consecutive images."""

    def __init__(self, images: range, params: DetectorParams) -> None:
        self.wanted = frozenset(images) if len(images) > 1 else frozenset()
        self._params = params
        self._first: Image | None = None
        self._rows: list[TipDetection] = []

    def take(self, index: int, image: LoggedImage, lap: Lap) -> None:
        """Compare an image with the one before."""
        second = image.gray
        lap("decode")
        if self._first is not None:
            edges = find_edges(self._first, self._params)
            lap("edges")
            self._rows.append(detect_tip(self._first, second, edges, self._params, lap))
        self._first = second

    def result(self) -> list[TipDetection]:
        """Return the detections."""
        return self._rows


def _table(rows: list[TipDetection]) -> Detections:
    frames = np.arange(len(rows))
    return Detections(
        frames=frames,
        partners=frames + 1,
        pixels=np.array([row.pixel for row in rows]).reshape(-1, 2),
        weights=np.array([row.weight for row in rows]),
        affines=np.array([row.affine for row in rows]).reshape(-1, 2, 3),
        edges=np.array([row.edges for row in rows], dtype=np.int64),
        background_edges=np.array([row.background_edges for row in rows], dtype=np.int64),
        flags=tuple(row.flags for row in rows),
    )
