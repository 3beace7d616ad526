"""The detect stage: the tip's pixel in every pair of consecutive images."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.detections import read_detections, read_provenance, write_detections
from tooltip_cli.log.recording import LoggedImage, Recording, Topics, read_recording
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
from tooltip_cli.stages.passes import Job, look_through

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
    """Return the key of a recording's detections; consecutive pairs do not depend on the rig."""
    parents = {"recording": recording.sha256, "image_topic": recording.image_topic}
    return stage_key("detect", VERSION, parents, params)


def detect(
    recording_path: Path,
    *,
    topics: Topics | None = None,
    params: DetectorParams | None = None,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
) -> Detected:
    """Find the tip's pixel in each pair of consecutive images (paper, 3.1), or reuse it.

    Args:
        out: directory for the artifact; default: beside the recording.
        force: compute even where a fresh artifact exists.
        jobs: threads; the result does not depend on them.
        on_pair: called after every pair, for progress.

    Raises:
        TooltipError: the recording cannot be read, or the artifact not written.
    """
    recording = read_recording(recording_path, topics or Topics())
    return detect_in(recording, params=params, out=out, force=force, jobs=jobs, on_pair=on_pair)


def detect_in(
    recording: Recording,
    *,
    params: DetectorParams | None = None,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
    along: Sequence[Job[Any]] = (),
) -> Detected:
    """Do the same for a recording that is already open; see :func:`detect`.

    Args:
        along: who is to see the images in the same pass, where one is made.
    """
    params = params or DetectorParams()
    key = detection_key(recording, params)
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
    pairs = _Pairs(len(recording.image_stamps_ns), params, on_pair)
    look_through(recording, [pairs, *along], jobs)
    lap = laps()
    detections = _table(pairs.rows)
    write_detections(
        path,
        detections,
        recording.image_stamps_ns,
        recording.image_frame,
        provenance(recording.path, recording.sha256, key, params),
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
    """The job of finding the tip in all pairs of ``count`` images."""

    def __init__(self, count: int, params: DetectorParams, on_pair: Callable[[], None]) -> None:
        self.rows: list[TipDetection] = []
        self._count, self._params, self._on_pair = count, params, on_pair

    def part(self, start: int, stop: int) -> _SomePairs:
        """Return the pairs whose first images these are."""
        return _SomePairs(range(start, min(stop + 1, self._count)), self._params)

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
