"""The estimate stage: the 3D tip in the hand frame, from detections or hand labels."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import MatchedLabels, match_labels, read_labels
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.detector import FEW_EDGES, NO_MOTION, Detections, DetectorParams
from tooltip_cli.method.estimators import EstimationInput, EstimatorParams, estimate_tip
from tooltip_cli.method.rays import rays_in_hand, sphere_array
from tooltip_cli.method.types import (
    Candidate,
    Reason,
    TipEstimate,
    TipPixels,
    refused,
)
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.artifacts import (
    artifact_path,
    digest,
    known_places,
    plain,
    provenance,
    read_json,
    stage_key,
    write_whole,
)
from tooltip_cli.stages.calibrate import refinement_document, refinement_from_document
from tooltip_cli.stages.clock import laps
from tooltip_cli.stages.detect import Detected, detect_in
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.memory import ONE_RECORDING, give_back_large_arrays
from tooltip_cli.stages.moving import VERSION as EDGES_VERSION
from tooltip_cli.stages.moving import DetectedEdges
from tooltip_cli.stages.near import near_unless
from tooltip_cli.stages.refined import vote

SUFFIX = ".tip.json"
VERSION = 10
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Estimated:
    """What the stage returns: the artifact and its content."""

    path: Path
    key: str
    reused: bool
    estimate: TipEstimate
    document: dict[str, Any]  # what tip.json holds
    detected: Detected | DetectedEdges | None  # None: from labels, or nothing was detected
    notes: tuple[str, ...] = ()  # what was odd about the recording


def estimate(
    recording_path: Path,
    *,
    rig: Path | None = None,
    topics: Topics | None = None,
    params: EstimatorParams | None = None,
    detector: DetectorParams | None = None,
    preset: str = "voting",
    from_labels: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
) -> Estimated:
    """Estimate the tip of one recording and write ``STEM.tip.json``, or reuse it.

    Detections that are missing or out of date are made first. Frames that hand labels exist for
    (``STEM.labels.csv``) are left out, so that an evaluation on them stays honest.

    Args:
        rig: rig file; default: the one stored in the recording.
        preset: ``voting`` or ``paper``: whether detections, where the method takes them, are looked
            for near the hand or among all edges.
        from_labels: a label file to estimate from instead of detections (the paper's baseline).

    Raises:
        TooltipError: anything wrong with the inputs.
    """
    give_back_large_arrays(ONE_RECORDING)  # half of what is held, and it may be needed twice
    lap = laps()
    recording = read_recording(recording_path, topics or Topics())
    lap("read")
    resolved = resolve_rig(recording, rig)
    views = resolve_views(recording, resolved)
    lap("poses")
    params = params or EstimatorParams()
    if from_labels is not None:
        labels = match_labels(read_labels(from_labels), recording.image_stamps_ns, views.camera)
        found = estimate_from_labels(recording, views, labels, params, out=out, force=force)
    else:
        allowed = unlabelled(recording, views.camera, out)
        found = estimate_from_images(
            recording,
            resolved,
            views,
            params,
            allowed,
            detector=detector,
            preset=preset,
            out=out,
            force=force,
            jobs=jobs,
            on_pair=on_pair,
        )
    return replace(found, notes=(*recording.notes, *_unknown_poses(views)))


def _unknown_poses(views: Views) -> list[str]:
    unknown = int(np.count_nonzero(~views.known))
    if not unknown:
        return []
    return [
        f"the hand's pose is unknown at {unknown} of {len(views.stamps_ns)} images, which are left "
        "out"
    ]


def estimate_from_images(
    recording: Recording,
    rig: Rig,
    views: Views,
    params: EstimatorParams,
    allowed: npt.NDArray[np.bool_],
    *,
    detector: DetectorParams | None = None,
    preset: str = "voting",
    out: Path | None = None,
    detected_out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
) -> Estimated:
    """Estimate from what moves in the allowed images, by the method that ``params`` names.

    Args:
        rig: that the views are by.
        allowed: (N,) images that may be used; a detection belongs to its first image.
        detector: of the paper's methods, ``kmeans`` and ``map``; ``preset`` likewise.
        detected_out: directory for what is detected; default: ``out``.
    """
    detected_out = detected_out or out
    if params.method != "voting":
        detected = detect_in(
            recording,
            params=detector,
            near=near_unless(preset, recording, views, params.voting, detector),
            out=detected_out,
            jobs=jobs,
            on_pair=on_pair,
        )
        return estimate_from_detections(
            recording, views, detected, params, allowed, out=out, force=force
        )
    origin = {"recording": recording.sha256, "image_topic": recording.image_topic}
    parents = {**origin, "allowed": digest(allowed), "edges_version": str(EDGES_VERSION)}
    used: list[DetectedEdges] = []

    def compute() -> TipEstimate:
        result, edges = vote(
            recording,
            rig,
            views,
            params.voting,
            allowed,
            out=detected_out,
            jobs=jobs,
            on_frame=on_pair,
        )
        used.extend([] if edges is None else [edges])
        return result

    found = _estimate(recording, views, compute, parents, params, out, force)
    return Estimated(*found, used[0] if used else None)


def estimate_from_detections(
    recording: Recording,
    views: Views,
    detected: Detected,
    params: EstimatorParams,
    allowed: npt.NDArray[np.bool_],
    *,
    out: Path | None = None,
    force: bool = False,
) -> Estimated:
    """Estimate from the detections in the allowed images (N,)."""
    pixels = detected.detections.tip_pixels()
    pixels = pixels.select(allowed[pixels.frames])
    parents = {"detections": detected.key, "frames": digest(pixels.frames)}

    def compute() -> TipEstimate:
        if not len(pixels.frames):
            return refused(params.method, 0, _nothing_detected(detected.detections))
        lap = laps()
        result = estimate_tip(estimation_input(views, pixels), params)
        lap("estimate")
        return result

    return Estimated(*_estimate(recording, views, compute, parents, params, out, force), detected)


def _nothing_detected(detections: Detections) -> Reason:
    """Return why no frame has a detection: darkness, or nothing that moves."""
    dark = sum(FEW_EDGES in flags for flags in detections.flags)
    if dark > len(detections.flags) / 2:
        return Reason(
            "few_edges",
            f"{dark} of {len(detections.flags)} pairs of images have too few edges to match; light "
            "the scene, and check that the camera sees it",
        )
    return Reason(
        NO_MOTION,
        "no frame shows anything that moves against the background; turn the wrist while "
        "recording, slowly enough for the camera",
    )


def estimate_from_labels(
    recording: Recording,
    views: Views,
    labels: MatchedLabels,
    params: EstimatorParams,
    *,
    out: Path | None = None,
    force: bool = False,
) -> Estimated:
    """Estimate from hand labels: the paper's baseline (4.3)."""
    pixels = labels.visible
    parents = {"labels": digest(pixels), "image_stamps": digest(recording.image_stamps_ns)}

    def compute() -> TipEstimate:
        if not len(pixels.frames):
            reason = Reason("no_labels", "no label shows the tip; label frames in which it is seen")
            return refused(params.method, 0, reason)
        lap = laps()
        result = estimate_tip(estimation_input(views, pixels), params)
        lap("estimate")
        return result

    return Estimated(*_estimate(recording, views, compute, parents, params, out, force), None)


def _estimate(
    recording: Recording,
    views: Views,
    compute: Callable[[], TipEstimate],
    parents: dict[str, str],
    params: EstimatorParams,
    out: Path | None,
    force: bool,
) -> tuple[Path, str, bool, TipEstimate, dict[str, Any]]:
    parents = {**parents, "camera": digest(views.camera), "spheres": digest(views.spheres)}
    parents["poses"] = digest(views.hand_from_camera)
    settings = {"method": params.method, "settings": params.relevant}
    key = stage_key("estimate", VERSION, parents, settings)
    if not force:
        for place in known_places(recording.path, SUFFIX, out):
            stored = _stored(place, key)
            if stored is not None:
                return place, key, True, *stored
    result = compute()
    lap = laps()
    origin = provenance(recording.path, recording.sha256, key, settings)
    document = tip_document(result, {**origin, "poses": parents["poses"]})
    path = artifact_path(recording.path, SUFFIX, out)
    write_whole(path, json.dumps(document, indent=1) + "\n")
    lap("write")
    return path, key, False, result, document


def _stored(place: Path, key: str) -> tuple[TipEstimate, dict[str, Any]] | None:
    """Return the estimate at a place if it has this key and is whole."""
    document = read_json(place)
    try:
        if document is None or document["provenance"]["key"] != key:
            return None
        return estimate_from_document(document, place), document
    except (KeyError, TypeError, TooltipError):
        _LOGGER.info("%s cannot be read and is made anew", place)
        return None


def estimation_input(views: Views, pixels: TipPixels) -> EstimationInput:
    """Turn pixels into rays; frames whose hand pose is unknown are left out."""
    directions = views.camera.directions(pixels.pixels)
    usable = views.known[pixels.frames] & np.isfinite(directions).all(axis=1)
    pixels, directions = pixels.select(usable), directions[usable]
    transforms = views.hand_from_camera[pixels.frames]
    camera = views.camera
    return EstimationInput(
        rays_in_hand(pixels.frames, directions, transforms),
        directions,
        inverse_transform(transforms),
        sphere_array([(sphere.center, sphere.radius) for sphere in views.spheres]),
        float(np.sqrt(camera.fx * camera.fy)),
        float(camera.width * camera.height),
    )


def tip_document(result: TipEstimate, origin: dict[str, Any]) -> dict[str, Any]:
    """Return what ``tip.json`` holds."""
    tip = {
        "frame": "hand",
        "position_m": plain(result.position),
        "covariance_m2": plain(result.covariance),
    }
    candidates = []
    for item in result.candidates:
        candidate = {"position_m": plain(item.position), "support": item.support}
        if item.covariance is not None:
            candidate["covariance_m2"] = plain(item.covariance)
        if item.axis is not None:
            candidate["axis"] = plain(item.axis)
        if item.axis_std is not None:
            candidate["axis_std_deg"] = float(np.degrees(item.axis_std))
        if item.agreement is not None:
            candidate["agreement"] = item.agreement
        candidates.append(candidate)
    refined = result.refinement
    return {
        "status": result.status,
        "tip": None if result.position is None else tip,
        "candidates": candidates,
        "reasons": [{"code": reason.code, "text": reason.text} for reason in result.reasons],
        "method": result.method,
        "frames_used": result.frames_used,
        **({} if refined is None else {"refined": refinement_document(refined)}),
        "provenance": origin,
    }


def estimate_from_document(document: dict[str, Any], path: Path) -> TipEstimate:
    """Read a ``tip.json`` back.

    Raises:
        TooltipError: it is not one.
    """
    try:
        tip = document["tip"]
        return TipEstimate(
            method=str(document["method"]),
            position=None if tip is None else np.array(tip["position_m"], dtype=float),
            covariance=None if tip is None else np.array(tip["covariance_m2"], dtype=float),
            candidates=tuple(
                Candidate(
                    np.array(item["position_m"], dtype=float),
                    float(item["support"]),
                    _array(item.get("covariance_m2")),
                    _array(item.get("axis")),
                    _radians(item.get("axis_std_deg")),
                    item.get("agreement"),
                )
                for item in document["candidates"]
            ),
            reasons=tuple(Reason(item["code"], item["text"]) for item in document["reasons"]),
            frames_used=int(document["frames_used"]),
            refinement=(
                refinement_from_document(document["refined"]) if "refined" in document else None
            ),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise TooltipError(
            f"{path} is not a tip file ({error!r}); --force makes it anew"
        ) from error


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else float(np.radians(degrees))


def _array(value: Any) -> npt.NDArray[np.float64] | None:
    return None if value is None else np.array(value, dtype=float)
