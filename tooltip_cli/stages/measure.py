"""What one recording's row of the report is made of: errors and their shares."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import MatchedLabels
from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views, resolve_views
from tooltip_cli.method.detector import DetectorParams
from tooltip_cli.method.estimators import EstimatorParams, estimate_tip
from tooltip_cli.method.evaluation import Split, fit_clock, pixel_errors
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.report.model import (
    ErrorShares,
    EstimateScore,
    FrameTable,
    LabelSet,
    RecordingReport,
    SplitUsed,
)
from tooltip_cli.report.scoring import (
    Truth,
    frame_table,
    project_tip,
    score_detections,
    score_estimate,
    vector,
)
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.artifacts import digest, plain, provenance
from tooltip_cli.stages.calibrate import refinement_sentence
from tooltip_cli.stages.curve import training_curve
from tooltip_cli.stages.detect import Detected
from tooltip_cli.stages.estimate import Estimated, estimation_input
from tooltip_cli.stages.shape import Voters


@dataclass(frozen=True)
class Protocol:
    """How recordings are split and estimated; everything that a number may depend on."""

    train: int = 400  # frames (4.1)
    test: int = 100  # frames (4.1); where labels exist, the labelled frames
    seed: int = 0
    split: str = "random"  # or blocks: contiguous test blocks
    params: EstimatorParams = field(default_factory=EstimatorParams)
    detector: DetectorParams = field(default_factory=DetectorParams)
    curve: bool | None = None  # estimate from fewer training frames too; None: as far as is quick
    preset: str = "voting"  # detections near the hand; or paper: among all edges


@dataclass(frozen=True)
class Labelled:
    """The labels of one recording."""

    path: Path
    labels: MatchedLabels
    states: Mapping[int, str]  # of the labelled frames, by image index
    described: LabelSet  # the second annotator's among them


@dataclass(frozen=True)
class Case:
    """Everything about one recording that its row is made from."""

    recording: Recording
    rig: Rig
    views: Views
    seen_rig: Rig  # that the estimate from detections is by: the same, or put right by it
    seen_by: Views
    labelled: Labelled | None
    split: Split
    detected: Detected
    found: Mapping[str, Estimated]  # detections, and labels where they show the tip
    truth: Truth | None
    protocol: Protocol
    key: str
    voters: Voters | None = None  # of an estimate by voting


def measure(case: Case, report_dir: Path) -> tuple[RecordingReport, FrameTable]:
    """Return one recording's row, and its test frames."""
    recording, views, labelled = case.recording, case.views, case.labelled
    tips = {name: item.estimate.position for name, item in case.found.items()}
    table = frame_table(
        views,
        case.seen_by,
        case.split.test,
        {} if labelled is None else labelled.states,
        None if labelled is None else labelled.labels,
        case.detected.detections,
        tips,
        case.truth,
    )
    detector = _score(case, "detections", table, report_dir)
    baseline = _score(case, "labels", table, report_dir) if "labels" in case.found else None
    stamps = recording.image_stamps_ns
    pose_known = views.known[case.split.test]
    split = case.split
    row = RecordingReport(
        name=recording.path.stem,
        recording=str(recording.path),
        sha256=recording.sha256,
        status=detector.status,
        reasons=detector.reasons,
        notes=_notes(case, int((~pose_known).sum())),
        frames=len(stamps),
        duration_s=float(stamps[-1] - stamps[0]) * 1e-9,
        image_size=(views.camera.width, views.camera.height),
        scored=int((np.isfinite(table.label).all(axis=1) & pose_known).sum()),
        split=SplitUsed(split.kind, split.seed, len(split.train), len(split.test)),
        labels=None if labelled is None else labelled.described,
        truth_m=None if case.truth is None else vector(case.truth.tip_hand),
        apart_mm=_apart_mm(tips),
        detection=score_detections(case.detected.detections, table),
        detector=detector,
        baseline=baseline,
        shares=_shares(case, table),
        training=tuple(training_curve(case, table, report_dir)),
        provenance=_provenance(case),
    )
    return row, table


def _score(case: Case, source: str, table: FrameTable, report_dir: Path) -> EstimateScore:
    item = case.found[source]
    path = item.path
    place = path.relative_to(report_dir) if path.is_relative_to(report_dir) else path
    views = case.seen_by if source == "detections" else case.views
    return score_estimate(
        source, item.estimate, item.document, views, table, case.truth, str(place)
    )


def _apart_mm(tips: Mapping[str, Array | None]) -> float | None:
    ours, baseline = tips.get("detections"), tips.get("labels")
    if ours is None or baseline is None:
        return None
    return float(1000 * np.linalg.norm(ours - baseline))


def _provenance(case: Case) -> dict[str, Any]:
    recording = case.recording
    origin = provenance(recording.path, recording.sha256, case.key, case.protocol)
    origin["detections_key"] = case.detected.key
    origin["split_digest"] = digest(case.split)
    origin["rig"] = {
        "source": case.rig.source,
        "hand_frame": case.rig.hand_frame,
        "camera": plain(case.views.camera),
        "time_offset_s": case.rig.time_offset_s,
        "refine": case.protocol.params.voting.put_right,
        "poses_digest": digest(case.views.hand_from_camera),
    }
    return origin


def _notes(case: Case, without_pose: int) -> tuple[str, ...]:
    notes = [*case.recording.notes, *case.split.notes]
    refined = case.found["detections"].document.get("refined")
    if refined is not None and refined["applied"]:
        notes.append(
            f"the estimate from images puts the rig right: {refinement_sentence(refined)}"
            + ("; the baseline takes it as it is" if "labels" in case.found else "")
        )
    if without_pose:
        notes.append(f"in {without_pose} test frames the hand's pose is unknown; they do not count")
    if case.labelled is None:
        notes.append(
            "no labels, so the error in pixels is unknown; all that can be told is whether "
            "detections in held-out frames agree with the estimate, and they would also agree on "
            "a wrong point that moves with the hand. Label the test frames with: tooltip label "
            f"{case.recording.path.name}"
        )
        return tuple(notes)
    described = case.labelled.described
    if described.simulated:
        notes.append("the labels are simulated, not placed by a person")
    apart = described.annotator_px
    if apart is not None:
        notes.append(
            f"two labellers differ by {apart.mean:.1f} px on average over {apart.count} frames, a "
            "floor for every error here"
        )
    if not described.visible:
        notes.append("no label shows the tip, so there is no error in pixels and no baseline")
    baseline = case.found.get("labels")
    if baseline is not None and baseline.estimate.position is None:
        why = "; ".join(reason.text for reason in baseline.estimate.reasons)
        notes.append(f"no baseline: the labels alone do not give the tip ({why})")
    return tuple(notes)


def _clock_projection(case: Case, frames: Indices) -> Callable[[Array, float], Array]:
    """Return the projection of a tip into frames whose stamps are shifted by an offset."""
    clipped = replace(case.recording, image_stamps_ns=case.recording.image_stamps_ns[frames])
    places = np.arange(len(frames))
    known: dict[float, Views | None] = {}

    def project(tip: Array, offset_s: float) -> Array:
        if offset_s not in known:
            try:
                known[offset_s] = resolve_views(clipped, _shifted(case.seen_rig, offset_s))
            except TooltipError:  # still views: no pose is known between them
                known[offset_s] = None
        views = known[offset_s]
        if views is None:
            return np.full((len(frames), 2), np.nan)
        return project_tip(views, tip, places)

    return project


def _shifted(rig: Rig, offset_s: float) -> Rig:
    return replace(rig, time_offset_s=rig.time_offset_s + offset_s)


def _from_labels(case: Case, table: FrameTable, views: Views) -> tuple[Array, Array] | None:
    """Return the tip that the labels give by some views, and the test frames' errors by them."""
    if case.labelled is None:
        return None
    seen = estimation_input(views, case.labelled.labels.visible)
    tip = estimate_tip(seen, case.protocol.params).position
    if tip is None:
        return None
    return tip, pixel_errors(project_tip(views, tip, table.frames), table.label)


def _clock_px(case: Case, table: FrameTable, offset_s: float, residual_px: float) -> float:
    """Return what of the labels' error goes when they are used anew with shifted stamps."""
    views = resolve_views(case.recording, _shifted(case.seen_rig, offset_s))
    found = _from_labels(case, table, views)
    if found is None:
        return 0.0
    return float(np.clip(residual_px - np.nanmean(found[1]), 0.0, residual_px))


def _shares(case: Case, table: FrameTable) -> ErrorShares | None:
    """Attribute the mean error to detection, to the clocks, and to calibration and labels.

    All by the rig that the estimate from detections is by, which may have put it right.
    """
    labels, prediction = case.found.get("labels"), table.prediction_error_px
    if labels is None or labels.estimate.position is None or not np.isfinite(prediction).any():
        return None
    tip, baseline = labels.estimate.position, table.baseline_error_px
    if case.seen_by is not case.views:
        again = _from_labels(case, table, case.seen_by)
        if again is None:
            return None
        tip, baseline = again
    scored = np.isfinite(baseline)
    project = _clock_projection(case, table.frames[scored])
    fit = fit_clock(project, table.label[scored], tip)
    total, residual = float(np.nanmean(prediction)), float(np.nanmean(baseline))
    shown = fit is not None and fit.shown
    clock = _clock_px(case, table, fit.offset_s, residual) if fit and shown else 0.0
    noise = pixel_errors(table.truth, table.label)
    return ErrorShares(
        total_px=total,
        detection_px=total - residual,
        clock_px=clock,
        calibration_px=residual - clock,
        clock_offset_ms=None if fit is None else 1000 * fit.offset_s,
        clock_deviation_ms=None if fit is None else 1000 * fit.deviation_s,
        clock_shown=shown,
        label_noise_px=float(np.nanmean(noise)) if np.isfinite(noise).any() else None,
    )
