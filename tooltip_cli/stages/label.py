"""The label stage: which frames a person labels, into which file, and what may be shown to help."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.book import open_book
from tooltip_cli.labels.files import frames_of, read_labels
from tooltip_cli.labels.session import Hints, Session
from tooltip_cli.log.detections import read_detections, read_provenance
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.evaluation import split_frames
from tooltip_cli.report.scoring import project_tip
from tooltip_cli.stages.artifacts import (
    artifact_path,
    digest,
    ensure_directory,
    find_artifact,
    read_json,
)
from tooltip_cli.stages.calibrate import rig_of
from tooltip_cli.stages.detect import SUFFIX as DETECTIONS_SUFFIX
from tooltip_cli.stages.estimate import SUFFIX as TIP_SUFFIX
from tooltip_cli.stages.estimate import estimate_from_document
from tooltip_cli.stages.held_out import LABELS_SUFFIX

Frames = npt.NDArray[np.intp]
_NAME = re.compile(r"\w[\w.@-]{0,63}")


@dataclass(frozen=True)
class Selection:
    """Which frames are labelled; the defaults are the test frames of ``evaluate``."""

    test: int = 100
    train: int = 400
    seed: int = 0
    split: str = "random"
    frames: int | None = None  # instead of the split: that many, evenly spread; 0: all
    given: bool = False  # asked for; else a blind labeller gets the frames that are labelled


@dataclass(frozen=True)
class Labeler:
    """Who labels, and whether by themselves: then into a file of their own, without hints."""

    name: str
    blind: bool = False


@contextmanager
def open_session(
    path: Path,
    labeler: Labeler,
    *,
    selection: Selection | None = None,
    topics: Topics | None = None,
    rig: Path | None = None,
    out: Path | None = None,
) -> Iterator[Session]:
    """Open a recording and its label file for labelling; the file is closed again afterwards.

    Args:
        rig: for predictions; default: the one stored in the recording.
        out: directory of the label file; default: beside the recording.

    Raises:
        TooltipError: anything wrong with the recording, the labeller's name or the label file.
    """
    recording = read_recording(path, topics or Topics())
    place = label_place(recording, labeler, out)
    frames = choose_frames(recording, selection or Selection(), labeler.blind, out)
    ensure_directory(place.parent)
    shortage = _shortage(selection or Selection(), len(frames))
    with open_book(place) as book:
        if place.exists():
            frames_of(read_labels(place), recording.image_stamps_ns)
        yield Session(
            recording,
            image_size(recording),
            frames,
            book,
            labeler.name,
            None if labeler.blind else lambda: find_hints(recording, rig, out),
            (*recording.notes, *book.notes, *shortage),
        )


def _shortage(selection: Selection, count: int) -> tuple[str, ...]:
    wanted = selection.test if selection.frames is None else selection.frames
    return (f"asked for {wanted} frames to label; there are {count}",) if count < wanted else ()


def label_place(recording: Recording, labeler: Labeler, out: Path | None) -> Path:
    """Return the file that someone's labels go to.

    Raises:
        TooltipError: a name that cannot stand in a file.
    """
    name = labeler.name
    if not name.isprintable() or not name.strip() or len(name) > 64:
        raise TooltipError(f"{name!r} is no name for a labeller; give --labeler a short one")
    if not labeler.blind:
        return artifact_path(recording.path, LABELS_SUFFIX, out)
    if not _NAME.fullmatch(name):
        raise TooltipError(
            f"{name!r} becomes part of a file's name; give --labeler letters, digits, and . _ @ -"
        )
    return artifact_path(recording.path, f".labels.{name}.csv", out)


def choose_frames(
    recording: Recording, selection: Selection, blind: bool = False, out: Path | None = None
) -> Frames:
    """Return the ascending image indices to label.

    A blind labeller gets the frames of the first set of labels where there is one, so that both
    judge the same.

    Raises:
        TooltipError: the first set is malformed or of another recording.
    """
    count = len(recording.image_stamps_ns)
    first = find_artifact(recording.path, LABELS_SUFFIX, out) if blind else None
    if first is not None and not selection.given:
        frames = np.unique(frames_of(read_labels(first), recording.image_stamps_ns))
        if len(frames):
            return frames
    if selection.frames is not None:
        wanted = min(selection.frames or count, count)
        return np.unique(np.linspace(0, count - 1, wanted).round().astype(np.intp))
    chosen = split_frames(count, selection.train, selection.test, selection.seed, selection.split)
    return chosen.test.astype(np.intp)


def image_size(recording: Recording) -> tuple[int, int]:
    """Return width and height of a recording's images, by the first of them."""
    height, width = next(recording.images([0])).shape[:2]
    return int(width), int(height)


def find_hints(recording: Recording, rig: Path | None, out: Path | None) -> Hints:
    """Return what the machine has found so far; ``notes`` say what is missing and how to get it."""
    notes: list[str] = []
    detections: dict[int, tuple[float, float]] = {}
    predictions: dict[int, tuple[float, float]] = {}
    try:
        detections = _detections(recording, out)
        if not detections:
            notes.append(f"no detections yet: tooltip detect {recording.path.name}")
        predictions = _predictions(recording, rig, out)
        if not predictions:
            notes.append(f"no prediction yet: tooltip estimate {recording.path.name}")
    except TooltipError as error:
        notes.append(str(error))
    return Hints(detections, predictions, tuple(notes))


def _detections(recording: Recording, out: Path | None) -> dict[int, tuple[float, float]]:
    place = find_artifact(recording.path, DETECTIONS_SUFFIX, out)
    origin = read_provenance(place) if place is not None else None
    if place is None or origin is None or origin.get("recording_sha256") != recording.sha256:
        return {}
    found = read_detections(place, recording.image_stamps_ns).tip_pixels()
    return _by_frame(found.frames, found.pixels)


def _predictions(
    recording: Recording, rig: Path | None, out: Path | None
) -> dict[int, tuple[float, float]]:
    place = find_artifact(recording.path, TIP_SUFFIX, out)
    document = read_json(place) if place is not None else None
    if place is None or not isinstance(document, dict):
        return {}
    estimate = estimate_from_document(document, place)
    tip = estimate.position
    if tip is None or document["provenance"].get("recording_sha256") != recording.sha256:
        return {}
    given = resolve_rig(recording, rig)
    views = resolve_views(recording, given)
    if document["provenance"].get("poses") == digest(views.hand_from_camera):
        # it is of this rig that the estimate says how to put it right
        _, views = rig_of(recording, given, views, estimate.refinement)
    frames = np.flatnonzero(views.known)
    return _by_frame(frames, project_tip(views, tip, frames))


def _by_frame(frames: Frames, pixels: npt.NDArray[np.float64]) -> dict[int, tuple[float, float]]:
    known = np.isfinite(pixels).all(axis=1)
    rows = zip(frames[known].tolist(), pixels[known].round(2).tolist(), strict=True)
    return {frame: (u, v) for frame, (u, v) in rows}
