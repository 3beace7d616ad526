"""Errors of one recording's detections and estimates, frame by frame and in sum (section 4)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import MatchedLabels, TipLabels
from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.detector import Detections
from tooltip_cli.method.evaluation import pixel_errors, summarize
from tooltip_cli.method.types import Array, Indices, TipEstimate
from tooltip_cli.report.model import (
    CandidateScore,
    DetectionScore,
    EstimateScore,
    FrameTable,
    LabelSet,
    Vector,
)
from tooltip_cli.rig.kinematics import inverse_transform

TRUTH = "truth.json"
SIMULATOR = "sim"  # the labeler of simulated labels
UNLABELLED = "unlabelled"
CHI2_95_3D = 7.814727903251179  # 95 % quantile of chi squared with three degrees of freedom


@dataclass(frozen=True)
class Truth:
    """What a simulator knows and no stage but evaluation may look at."""

    tip_hand: Array  # (3,) metres, hand frame
    pixels: Array  # (N, 2) u, v in every image; NaN where unknown


def read_truth(recording: Recording) -> Truth | None:
    """Return the truth attached to a recording, or in ``STEM.truth.json`` beside it.

    A file without ``tip_in_hand_m`` states another kind of truth and counts as none.

    Raises:
        TooltipError: it states a tip that is not three numbers, or is not JSON.
    """
    sidecar = recording.path.with_name(f"{recording.path.stem}.{TRUTH}")
    data = recording.attachments.get(TRUTH)
    source = str(sidecar) if data is None else f"{recording.path}: attachment {TRUTH}"
    try:
        if data is None:
            data = sidecar.read_bytes() if sidecar.is_file() else b"{}"
        document = json.loads(data)
        if "tip_in_hand_m" not in document:
            return None
        tip = np.array(document["tip_in_hand_m"], dtype=float)
        if tip.shape != (3,) or not np.isfinite(tip).all():
            raise ValueError("tip_in_hand_m must be three numbers")
        return Truth(tip, _truth_pixels(document, recording))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise TooltipError(f"{source}: not a simulator's truth ({error})") from error


def _truth_pixels(document: Mapping[str, Any], recording: Recording) -> Array:
    pixels = np.full((len(recording.image_stamps_ns), 2), np.nan)
    stamps = np.array(document.get("stamps_ns", []), dtype=np.int64)
    if not len(stamps) or "uv" not in document:
        return pixels
    rows = np.array(document["uv"], dtype=float).reshape(len(stamps), 2)
    index = np.minimum(
        np.searchsorted(recording.image_stamps_ns, stamps), len(recording.image_stamps_ns) - 1
    )
    known = recording.image_stamps_ns[index] == stamps
    pixels[index[known]] = rows[known]
    return pixels


def project_tip(views: Views, tip_hand: Array, frames: Indices) -> Array:
    """Return (F, 2) pixels of a point of the hand frame; NaN where it cannot be seen.

    Args:
        tip_hand: (3,) metres, hand frame.
        frames: (F,) image indices.
    """
    camera_from_hand = inverse_transform(views.hand_from_camera[frames])
    points = np.einsum("nij,j->ni", camera_from_hand[:, :3, :3], tip_hand)
    return views.camera.project(points + camera_from_hand[:, :3, 3])


def turn_deg(hand_from_camera: Array) -> Array:
    """Return (N, 3) turns of the hand about the camera's axes, degrees, from the mean turn.

    Args:
        hand_from_camera: (N, 4, 4); NaN where unknown.
    """
    import cv2

    rotations = np.swapaxes(hand_from_camera[:, :3, :3], 1, 2)
    known = np.isfinite(rotations).all(axis=(1, 2))
    turns = np.full((len(rotations), 3), np.nan)
    if not known.any():
        return turns
    left, _, right = np.linalg.svd(rotations[known].mean(axis=0))
    mean = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    for row in np.flatnonzero(known):
        turns[row] = np.degrees(cv2.Rodrigues(rotations[row] @ mean.T)[0].ravel())
    return turns


def frame_table(
    views: Views,
    seen_by: Views,
    test: Indices,
    states: Mapping[int, str],
    labels: MatchedLabels | None,
    detections: Detections,
    tips: Mapping[str, Array | None],
    truth: Truth | None,
) -> FrameTable:
    """Collect what is known of every test frame.

    Args:
        seen_by: views that the estimate from detections is by.
        test: (T,) image indices.
        states: of the labelled frames, by image index.
        tips: ``detections`` and ``labels`` -> (3,) estimate, metres, hand frame; None: refused.
    """
    count = len(views.stamps_ns)

    def spread(frames: Indices, values: Array) -> Array:
        column = np.full((count, *values.shape[1:]), np.nan)
        column[frames] = values
        return column[test]

    def projected(name: str, by: Views) -> Array:
        tip = tips.get(name)
        return np.full((len(test), 2), np.nan) if tip is None else project_tip(by, tip, test)

    seen = detections.tip_pixels()
    shown = None if labels is None else labels.visible
    nothing = np.full((len(test), 2), np.nan)
    return FrameTable(
        frames=test,
        stamps_ns=views.stamps_ns[test],
        states=tuple(states.get(int(frame), UNLABELLED) for frame in test),
        label=nothing if shown is None else spread(shown.frames, shown.pixels),
        detection=spread(seen.frames, seen.pixels),
        weight=spread(seen.frames, seen.weights),
        prediction=projected("detections", seen_by),
        baseline=projected("labels", views),
        truth=nothing if truth is None else truth.pixels[test],
        turn_deg=turn_deg(views.hand_from_camera)[test],
    )


def score_detections(detections: Detections, table: FrameTable) -> DetectionScore:
    """Compare detections with labels, and with the estimate's projection."""
    errors = table.detection_error_px
    finite = errors[np.isfinite(errors)]
    flags = Counter(flag for row in detections.flags for flag in row)
    return DetectionScore(
        pairs=len(detections.frames),
        valid=int(detections.valid.sum()),
        flags=dict(sorted(flags.items())),
        error_px=summarize(errors),
        within_10_px=float((finite <= 10).mean()) if len(finite) else None,
        consistency_px=summarize(table.apart_px),
    )


def score_estimate(
    source: str,
    estimate: TipEstimate,
    document: Mapping[str, Any],
    views: Views,
    table: FrameTable,
    truth: Truth | None,
    artifact: str,
) -> EstimateScore:
    """Compare an estimate with labels in the image and with the truth in space.

    Args:
        source: ``detections`` or ``labels``.
        document: the estimate's ``tip.json``.
        artifact: where it is, relative to the report.
    """
    column = table.prediction_error_px if source == "detections" else table.baseline_error_px
    position, covariance = estimate.position, estimate.covariance
    lengths, axes = _region(covariance)
    offset = None if position is None or truth is None else position - truth.tip_hand
    inside = None
    if offset is not None and covariance is not None:
        inside = bool(offset @ np.linalg.pinv(covariance) @ offset <= CHI2_95_3D)
    return EstimateScore(
        source=source,
        status=estimate.status,
        reasons=estimate.reasons,
        method=estimate.method,
        frames_used=estimate.frames_used,
        position_m=None if position is None else vector(position),
        covariance_m2=None if covariance is None else _rows(covariance),
        deviations_mm=(
            None if covariance is None else vector(1000 * np.sqrt(np.diagonal(covariance)))
        ),
        region_mm=lengths,
        region_axes=axes,
        candidates=tuple(
            _score_candidate(item, views, table, truth) for item in document["candidates"]
        ),
        error_px=summarize(column),
        tip_error_mm=None if offset is None else float(1000 * np.linalg.norm(offset)),
        inside_region=inside,
        artifact=artifact,
        key=str(document["provenance"]["key"]),
    )


def _score_candidate(
    item: Mapping[str, Any], views: Views, table: FrameTable, truth: Truth | None
) -> CandidateScore:
    position = np.array(item["position_m"], dtype=float)
    axis, axis_deg = item.get("axis"), item.get("axis_std_deg")
    error = summarize(pixel_errors(project_tip(views, position, table.frames), table.label))
    return CandidateScore(
        position_m=vector(position),
        support=float(item["support"]),
        axis=None if axis is None else vector(np.array(axis, dtype=float)),
        axis_deg=None if axis_deg is None else float(axis_deg),
        error_px=None if error is None else error.mean,
        tip_error_mm=(
            None if truth is None else float(1000 * np.linalg.norm(position - truth.tip_hand))
        ),
    )


def _region(
    covariance: Array | None,
) -> tuple[Vector | None, tuple[Vector, Vector, Vector] | None]:
    """Return the semi-axes of the 95 % ellipsoid in mm, longest first, and their directions."""
    if covariance is None:
        return None, None
    values, vectors = np.linalg.eigh(covariance)
    lengths = 1000 * np.sqrt(CHI2_95_3D * np.maximum(values, 0.0))
    return vector(lengths[::-1]), _rows(vectors.T[::-1])


def vector(values: Array) -> Vector:
    """Return (3,) values as plain numbers."""
    x, y, z = map(float, values)
    return x, y, z


def _rows(matrix: Array) -> tuple[Vector, Vector, Vector]:
    first, second, third = (vector(row) for row in matrix)
    return first, second, third


def describe_labels(
    path: Path,
    digest: str,
    labels: MatchedLabels,
    second: tuple[Path, MatchedLabels] | None,
) -> LabelSet:
    """Return what the report says about the labels, and how two annotators differ."""
    distance, disagreements = None, 0
    if second is not None:
        other = second[1]
        both = np.intersect1d(labels.visible.frames, other.visible.frames)
        mine = labels.visible.pixels[np.isin(labels.visible.frames, both)]
        theirs = other.visible.pixels[np.isin(other.visible.frames, both)]
        distance = summarize(pixel_errors(mine, theirs))
        judged = np.intersect1d(labels.frames, other.frames)
        apart = np.setxor1d(labels.visible.frames, other.visible.frames)
        disagreements = int(np.isin(apart, judged).sum())
    return LabelSet(
        file=path.name,
        digest=digest,
        labelers=labels.labelers,
        simulated=SIMULATOR in labels.labelers,
        visible=len(labels.visible.frames),
        hidden=len(labels.frames) - len(labels.visible.frames),
        second=None if second is None else second[0].name,
        annotator_px=distance,
        disagreements=disagreements,
    )


def states_by_frame(rows: TipLabels, recording: Recording) -> dict[int, str]:
    """Return the state of every labelled frame by image index."""
    index = np.searchsorted(recording.image_stamps_ns, rows.stamps_ns)
    return {int(frame): state for frame, state in zip(index, rows.states, strict=True)}
