"""The evaluate stage: estimates against hand labels in frames that trained nothing (section 4)."""

from __future__ import annotations

import datetime
import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import MatchedLabels, match_labels, read_labels
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.detector import DetectorParams
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.evaluation import Split, split_by_labels, split_frames
from tooltip_cli.method.types import Reason
from tooltip_cli.method.voting.estimate import METHOD as VOTING
from tooltip_cli.report.model import (
    SCHEMA,
    EvaluationReport,
    FrameTable,
    RecordingReport,
    from_plain,
    table_from_plain,
)
from tooltip_cli.report.overall import Totals
from tooltip_cli.report.scenes import Scene, all_motion
from tooltip_cli.report.scoring import Truth, describe_labels, read_truth, states_by_frame
from tooltip_cli.report.writer import ReportWriter
from tooltip_cli.stages.artifacts import (
    digest,
    known_places,
    plain,
    read_json,
    stage_key,
    write_whole,
)
from tooltip_cli.stages.calibrate import rig_of
from tooltip_cli.stages.detect import Detected, detect_in
from tooltip_cli.stages.estimate import (
    Estimated,
    estimate_from_images,
    estimate_from_labels,
)
from tooltip_cli.stages.held_out import LABELS_SUFFIX
from tooltip_cli.stages.measure import Case, Labelled, Protocol, measure
from tooltip_cli.stages.memory import MANY_RECORDINGS, give_back_freed, give_back_large_arrays
from tooltip_cli.stages.near import near_unless
from tooltip_cli.stages.shape import Voters, voted_shape

VERSION = 6
DEFAULT_DIRECTORY = "report"
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Places:
    """Where inputs are looked for and results go."""

    report: Path  # directory of the report
    out: Path | None  # directory of detections; None: beside each recording
    labels: Path | None  # a file, a folder with STEM.labels.csv, or None: the usual places
    second_labels: Path | None
    rig: Path | None  # a file, a folder with STEM.rig.yaml, or None: stored in the recording


@dataclass(frozen=True)
class Evaluated:
    """One recording's row and frames, and whether they were stored already."""

    row: RecordingReport
    table: FrameTable
    reused: bool
    scene: Scene


def evaluate(
    recordings: Sequence[Path],
    *,
    labels: Path | None = None,
    second_labels: Path | None = None,
    rig: Path | None = None,
    topics: Topics | None = None,
    train: int = 400,
    test: int = 100,
    seed: int = 0,
    split: str = "random",
    params: EstimatorParams | None = None,
    detector: DetectorParams | None = None,
    preset: str = "voting",
    curve: bool | None = None,
    frame: int | None = None,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
    on_step: Callable[[Path, str], None] = lambda path, text: None,
) -> EvaluationReport:
    """Evaluate recordings one after the other and write the report.

    Per recording: detections (paper, 3.1); an estimate from those in the training frames; the
    baseline, an estimate from the labels; both projected into the test frames and compared with
    the visible labels (4.3). Labelled frames are the test set and train nothing. Memory does not
    grow with the number of recordings beyond a row of numbers for each.

    Args:
        labels: label file, or a folder with ``STEM.labels.csv``; default: under ``out``, then
            beside the recording.
        second_labels: likewise, of a second annotator; default: ``STEM.labels.*.csv``.
        rig: rig file, or a folder with ``STEM.rig.yaml``; default: the one in the recording.
        split: ``random`` or ``blocks``; where labels exist they decide.
        preset: ``voting`` or ``paper``: whether detections are looked for near the hand or among
            all edges.
        curve: estimate from ever fewer training frames too, which takes several estimates;
            default: from as few as are quick.
        frame: image index that the figures of each recording show, or the test frame nearest to
            it; default: one whose error is typical.
        out: directory of the report; default: ``report`` beside the first recording. Stages that
            have to run write there, and without ``out`` beside each recording.
        on_pair: called after every pair of images that the detector works on.
        on_step: called with a recording and what was reused or computed for it.

    Returns:
        The report as written to ``report.json``. Recordings that cannot be evaluated are rows with
        reasons.

    Raises:
        TooltipError: no recording could be read, two have the same name, or nothing can be
            written. With a single recording, whatever is wrong with it.
    """
    _check_names(recordings)
    give_back_large_arrays(MANY_RECORDINGS)
    params, detector = params or EstimatorParams(), detector or DetectorParams()
    protocol = Protocol(train, test, seed, split, params, detector, curve, preset)
    split_frames(train + test, train, test, seed, split)  # refuses wrong sizes before any work
    report_dir = out if out is not None else recordings[0].parent / DEFAULT_DIRECTORY
    places = Places(report_dir, out, labels, second_labels, rig)
    totals, rows = Totals(), []
    writer = ReportWriter(
        report_dir,
        len(recordings),
        lambda name, data: write_whole(report_dir / name, data),
        plain,
        frame,
    )
    for path in recordings:
        try:
            done = evaluate_recording(
                path, places, protocol, topics or Topics(), force, jobs, on_pair, on_step
            )
        except TooltipError as error:
            if len(recordings) == 1:
                raise
            on_step(path, f"failed: {error}")
            rows.append(_failed(path, error))
            totals.add(rows[-1], None)
            continue
        rows.append(done.row)
        totals.add(done.row, done.table)
        writer.add(done.row, done.table, done.scene)
        del done  # before the next one is read
        give_back_freed()
    if all(row.status == "failed" for row in rows):
        raise TooltipError(f"none of the {len(rows)} recordings could be evaluated")
    report = EvaluationReport(
        schema=SCHEMA,
        version=__version__,
        created=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        options=plain(protocol),
        recordings=tuple(rows),
        overall=totals.overall(),
        page=str(report_dir / "index.html"),
    )
    writer.finish(report)
    return report


def _check_names(recordings: Sequence[Path]) -> None:
    if not recordings:
        raise TooltipError("no recording to evaluate; name one or more MCAP files")
    twice = [stem for stem, count in Counter(path.stem for path in recordings).items() if count > 1]
    if twice:
        raise TooltipError(
            f"several recordings are called '{twice[0]}'; a report tells its recordings apart by "
            "file name, so rename one or write separate reports with --out"
        )


def evaluate_recording(
    path: Path,
    places: Places,
    protocol: Protocol,
    topics: Topics,
    force: bool = False,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
    on_step: Callable[[Path, str], None] = lambda path, text: None,
) -> Evaluated:
    """Evaluate one recording, or read what an equal evaluation stored under ``parts/``.

    Raises:
        TooltipError: anything wrong with the recording, its rig or its labels.
    """
    recording = read_recording(path, topics)
    rig = resolve_rig(recording, _for_recording(places.rig, path, ".rig.yaml"))
    views = resolve_views(recording, rig)
    labelled = find_labels(recording, views, places)
    split = _split(recording, labelled, protocol)
    near = near_unless(protocol.preset, recording, views, protocol.params.voting, protocol.detector)
    detected = detect_in(
        recording,
        params=protocol.detector,
        near=near,
        out=places.out,
        jobs=jobs,
        on_pair=on_pair,
    )
    on_step(path, f"{_how(detected.reused)} {detected.path}")
    tips = places.report / "tips"
    allowed = np.isin(np.arange(len(recording.image_stamps_ns)), split.train)
    estimate = estimate_from_images(
        recording,
        rig,
        views,
        protocol.params,
        allowed,
        detector=protocol.detector,
        preset=protocol.preset,
        out=tips / "detections",
        detected_out=places.out,
        force=force,
        jobs=jobs,
    )
    found = {"detections": replace(estimate, detected=None)}  # edges take a tenth of a gigabyte
    seen_rig, seen_by = rig_of(recording, rig, views, estimate.estimate.refinement)
    del estimate
    voting, edges_out = protocol.params.voting, places.out or tips / "detections"
    voters = Voters(recording, views, allowed, voting, edges_out, seen_by)
    if labelled is not None and len(labelled.labels.visible.frames):
        found["labels"] = estimate_from_labels(
            recording, views, labelled.labels, protocol.params, out=tips / "labels", force=force
        )
    for estimated in found.values():
        on_step(path, f"{_how(estimated.reused)} {estimated.path}")
    truth = read_truth(recording)
    scene = Scene(
        recording,
        seen_by,
        views,
        detected.detections,
        protocol.detector,
        protocol.preset,
        near.motion if near else partial(all_motion, protocol.detector),
        protocol.params,
        split,
        None if labelled is None else labelled.labels,
        lambda: voted_shape(voters, found["detections"], tips / "shape"),
    )
    key = _key(recording, detected, found, split, labelled, truth, protocol)
    place = places.report / "parts" / f"{path.stem}.json"
    stored = None if force else _stored(place, key)
    if stored is not None:
        on_step(path, f"reused {place}")
        row, table = stored  # perhaps of the time when it lay elsewhere
        return Evaluated(replace(row, recording=str(path)), table, True, scene)
    case = Case(
        recording,
        rig,
        views,
        seen_rig,
        seen_by,
        labelled,
        split,
        detected,
        found,
        truth,
        protocol,
        key,
        voters if protocol.params.method == VOTING else None,
    )
    row, table = measure(case, places.report)
    document = {"key": key, "row": plain(row), "frames": plain(table)}
    write_whole(place, json.dumps(document) + "\n")
    on_step(path, f"computed {place}")
    return Evaluated(row, table, False, scene)


def _how(reused: bool) -> str:
    return "reused" if reused else "computed"


def _for_recording(given: Path | None, recording: Path, suffix: str) -> Path | None:
    """Return the file of a recording: ``given``, or the one named after it in that folder."""
    if given is not None and given.is_dir():
        return given / f"{recording.stem}{suffix}"
    return given


def find_labels(recording: Recording, views: Views, places: Places) -> Labelled | None:
    """Return the labels of a recording; None where there are none.

    Raises:
        TooltipError: a label file was named and is not there, or does not fit the recording.
    """

    def matched(path: Path) -> MatchedLabels:
        return match_labels(read_labels(path), recording.image_stamps_ns, views.camera)

    path = _for_recording(places.labels, recording.path, LABELS_SUFFIX)
    if path is None:
        beside = known_places(recording.path, LABELS_SUFFIX, places.out)
        path = next((place for place in beside if place.exists()), None)
    if path is None:
        return None
    rows, labels = read_labels(path), matched(path)
    other = _for_recording(places.second_labels, recording.path, LABELS_SUFFIX)
    if other is None:
        pattern = f"{recording.path.stem}.labels.*.csv"
        other = next(iter(sorted(path.parent.glob(pattern))), None)
    second = None if other is None else (other, matched(other))
    described = describe_labels(path, digest(labels), labels, second)
    return Labelled(path, labels, states_by_frame(rows, recording), described)


def _split(recording: Recording, labelled: Labelled | None, protocol: Protocol) -> Split:
    count = len(recording.image_stamps_ns)
    if labelled is None:
        return split_frames(count, protocol.train, protocol.test, protocol.seed, protocol.split)
    split = split_by_labels(count, labelled.labels.frames, protocol.train, protocol.seed)
    if protocol.split != "random":
        note = f"the labelled frames are the test set, so --split {protocol.split} changes nothing"
        split = replace(split, notes=(*split.notes, note))
    return split


def _key(
    recording: Recording,
    detected: Detected,
    found: Mapping[str, Estimated],
    split: Split,
    labelled: Labelled | None,
    truth: Truth | None,
    protocol: Protocol,
) -> str:
    parents = {name: estimated.key for name, estimated in found.items()}
    parents |= {"recording": recording.sha256, "all_detections": detected.key}
    parents["split"] = digest(split)
    parents["label_set"] = digest(None if labelled is None else labelled.described)
    parents["states"] = digest(None if labelled is None else labelled.states)
    parents["truth"] = digest(truth)
    parents["name"] = recording.path.stem
    return stage_key("evaluate", VERSION, parents, protocol)


def _stored(place: Path, key: str) -> tuple[RecordingReport, FrameTable] | None:
    document = read_json(place)
    if not isinstance(document, dict) or document.get("key") != key:
        return None
    try:
        return from_plain(RecordingReport, document["row"]), table_from_plain(document["frames"])
    except (KeyError, TooltipError):
        _LOGGER.info("%s cannot be read and is made anew", place)
        return None


def _failed(path: Path, error: TooltipError) -> RecordingReport:
    return RecordingReport(
        name=path.stem,
        recording=str(path),
        sha256="",
        status="failed",
        reasons=(Reason("failed", str(error)),),
        notes=(),
        frames=0,
        duration_s=0.0,
        image_size=(0, 0),
        scored=0,
        split=None,
        labels=None,
        truth_m=None,
        apart_mm=None,
        detection=None,
        detector=None,
        baseline=None,
        shares=None,
        training=(),
        provenance={},
    )
