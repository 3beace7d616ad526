"""What is done with one recording of a shelf, in whatever process it is done."""

from __future__ import annotations

import datetime
import json
import logging
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import match_labels, read_labels
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.report.model import RecordingReport, mean_of
from tooltip_cli.stages.artifacts import digest, read_json
from tooltip_cli.stages.detect import VERSION as DETECT_VERSION
from tooltip_cli.stages.estimate import VERSION as ESTIMATE_VERSION
from tooltip_cli.stages.estimate import Estimated, estimate_from_images
from tooltip_cli.stages.evaluate import VERSION as EVALUATE_VERSION
from tooltip_cli.stages.evaluate import Places, evaluate_recording
from tooltip_cli.stages.measure import Protocol
from tooltip_cli.stages.memory import MANY_RECORDINGS, give_back_large_arrays
from tooltip_cli.stages.moving import VERSION as EDGES_VERSION
from tooltip_cli.stages.near import VERSION as NEAR_VERSION
from tooltip_cli.stages.shelf.plan import Item
from tooltip_cli.stages.shelf.scratch import Bench, at_hand
from tooltip_cli.stages.shelf.store import Place, Remote, Seen, look_at, place, read_some, write
from tooltip_cli.stages.shelf.table import FAILED, OK, Row, row_from_document

ROW = "row.json"
VERSION = 2
VERSIONS = (
    VERSION,
    DETECT_VERSION,
    NEAR_VERSION,
    EDGES_VERSION,
    ESTIMATE_VERSION,
    EVALUATE_VERSION,
)
"""Of everything that a row is made by; a row of other versions is made anew."""
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Task:
    """One recording to take through the stages; every path is absolute."""

    item: Item  # its labels are those that were found
    folder: Place  # for everything that is written about it
    inputs: str  # digest of all that the row depends on
    topics: Topics
    params: EstimatorParams
    force: bool = False  # compute even where a fresh artifact exists
    trust: bool = True  # take a stored row with the same inputs for what it says
    version: str = __version__  # of the program that asks
    seen: Seen | None = None  # of a recording in a bucket: what was listed
    beside: tuple[Remote, ...] = ()  # in buckets: what else belongs to recording and labels


def key_of(task: Task) -> str:
    """Return a name that no other task has."""
    return f"{task.inputs}{'-anew' if task.force else ''}"


@dataclass(frozen=True)
class Outcome:
    """A row, and whether anything was computed for it."""

    row: Row
    reused: bool


def stored_row(folder: Place, inputs: str) -> Row | None:
    """Return the row that was stored for these inputs, if it ended well and its tip is there.

    A failed row is not taken: what was missing then may be there now.

    Raises:
        TooltipError: the store that it lies in does not answer.
    """
    if isinstance(folder, Path):
        document = read_json(folder / ROW)
    else:
        document = parsed(next((data for _, data in read_some([folder / ROW])), None))
    row = row_of(document, inputs, folder)
    if row is None or row.tip_file is None:
        return None
    tip = place(row.tip_file)
    there = tip.exists() if isinstance(tip, Path) else look_at(tip) is not None
    return row if there else None


def parsed(data: bytes | None) -> Any | None:
    """Return what a JSON object holds; None where it is absent or not JSON."""
    try:
        return None if data is None else json.loads(data)
    except (ValueError, RecursionError):
        return None


def row_of(document: Any, inputs: str, folder: Place) -> Row | None:
    """Return the row of a stored document that was made from these inputs and did not fail."""
    if not isinstance(document, dict) or document.get("inputs") != inputs:
        return None
    try:
        row = row_from_document(document["row"])
    except (KeyError, TooltipError):
        _LOGGER.info("%s cannot be read and is made anew", folder / ROW)
        return None
    return None if row.status == FAILED else row


def store_row(task: Task, row: Row) -> None:
    """Store a row for :func:`stored_row`.

    Raises:
        TooltipError: it cannot be written.
    """
    document = {"inputs": task.inputs, "row": asdict(row)}
    write(task.folder / ROW, json.dumps(document) + "\n")


def failed_row(task: Task, code: str, reason: str) -> Row:
    """Return the row of a recording of which nothing is known but why."""
    return replace(_bare_row(task), status=FAILED, code=code, reason=reason)


def _bare_row(task: Task) -> Row:
    item = task.item
    return Row(
        name=item.name,
        recording=str(item.recording),
        rig=None if item.rig is None else str(item.rig),
        labels=None if item.labels is None else str(item.labels),
        tool=item.tool,
        status=OK,
        version=__version__,
        created=_now(),
        columns=item.columns,
    )


def work_on(task: Task) -> Outcome:
    """Take one recording through detect, estimate and, where it has labels, evaluate.

    Whatever goes wrong is a row with its reason. The row is stored before it is returned, so that
    what is finished stays finished whatever happens to who asked for it.
    """
    started = time.perf_counter()
    try:
        if task.trust:
            row = stored_row(task.folder, task.inputs)
            if row is not None:
                return Outcome(row, True)
        _one_thread()
        _check_version(task)
        outcome = _at_hand(task)
    except TooltipError as error:
        outcome = Outcome(failed_row(task, "failed", str(error)), False)
    except MemoryError:
        reason = "it needs more memory than a process may use; see --memory"
        outcome = Outcome(failed_row(task, "out_of_memory", reason), False)
    except Exception as error:  # a defect of this program must not end the work on the others
        _LOGGER.exception("%s", task.item.recording)
        reason = f"internal error: {type(error).__name__}: {error}"
        outcome = Outcome(failed_row(task, "internal_error", reason), False)
    outcome = replace(outcome, row=replace(outcome.row, seconds=_since(started)))
    try:
        store_row(task, outcome.row)
    except TooltipError as error:
        return Outcome(failed_row(task, "failed", str(error)), False)
    return outcome


def _at_hand(task: Task) -> Outcome:
    """Do the work on files of this machine, and say of them where they come from."""
    with at_hand(task.item, task.folder, task.seen, task.beside, anew=task.force) as bench:
        try:
            outcome = _through_the_stages(task, bench)
        except TooltipError as error:
            raise TooltipError(bench.said(str(error))) from error
        bench.keep()
        row = outcome.row
        return replace(
            outcome,
            row=replace(
                row,
                reason=None if row.reason is None else bench.said(row.reason),
                tip_file=None if row.tip_file is None else bench.said(row.tip_file),
            ),
        )


def _check_version(task: Task) -> None:
    if task.version != __version__:
        raise TooltipError(
            f"this worker has tooltip {__version__} and was asked by {task.version}; install the "
            "same version on both"
        )


def _one_thread() -> None:
    """Keep OpenCV from starting a thread for each core in each process."""
    import cv2

    cv2.setNumThreads(1)


def _through_the_stages(task: Task, bench: Bench) -> Outcome:
    give_back_large_arrays(MANY_RECORDINGS)
    started = time.perf_counter()
    recording = read_recording(bench.recording, task.topics)
    rig = resolve_rig(recording, bench.rig)
    views = resolve_views(recording, rig)
    found = estimate_from_images(
        recording,
        rig,
        views,
        task.params,
        _not_labelled(recording, views, bench.labels),
        out=bench.folder,
        force=task.force,
    )
    seconds = _since(started)
    row = replace(
        _bare_row(task),
        **_of_recording(recording),
        **_of_estimate(found),
        rig_id=digest((replace(rig, source=""), views.camera))[:12],
        seconds_estimate=seconds,
    )
    if bench.labels is None:
        return Outcome(row, found.reused)
    started = time.perf_counter()
    evaluated = evaluate_recording(
        bench.recording,
        Places(bench.folder, bench.folder, bench.labels, None, bench.rig),
        Protocol(params=task.params, curve=False),
        task.topics,
        task.force,
    )
    row = replace(row, **_of_evaluation(evaluated.row), seconds_evaluate=_since(started))
    return Outcome(row, found.reused and evaluated.reused)


def _not_labelled(recording: Recording, views: Views, labels: Path | None) -> Any:
    """Return (N,) which images may be estimated from: a labelled one never is."""
    allowed = np.ones(len(recording.image_stamps_ns), dtype=bool)
    if labels is not None:
        matched = match_labels(read_labels(labels), recording.image_stamps_ns, views.camera)
        allowed[matched.frames] = False
    return allowed


def _of_recording(recording: Recording) -> Mapping[str, Any]:
    first = float(recording.image_stamps_ns[0]) * 1e-9
    moment = datetime.datetime.fromtimestamp(first, datetime.timezone.utc)
    return {
        "recorded": moment.isoformat(timespec="milliseconds"),
        "frames": len(recording.image_stamps_ns),
        "bytes": recording.path.stat().st_size,
        "recording_sha256": recording.sha256,
    }


def _of_estimate(found: Estimated) -> Mapping[str, Any]:
    result = found.estimate
    reason = result.reasons[0] if result.reasons else None
    cells: dict[str, Any] = {
        "status": result.status,
        "code": None if reason is None else reason.code,
        "reason": None if reason is None else reason.text,
        "method": result.method,
        "frames_used": result.frames_used,
        "estimate_key": found.key,
        "tip_file": str(found.path),
    }
    if result.position is not None:
        cells |= {f"tip_{axis}_m": float(result.position[i]) for i, axis in enumerate("xyz")}
    if result.covariance is not None:
        for i, j in zip(*np.triu_indices(3), strict=True):
            cells[f"cov_{'xyz'[i]}{'xyz'[j]}_m2"] = float(result.covariance[i, j])
    return cells


def _of_evaluation(row: RecordingReport) -> Mapping[str, Any]:
    return {
        "error_px": mean_of(row.detector_px),
        "baseline_px": mean_of(row.baseline_px),
        "tip_error_mm": row.tip_error_mm,
        "scored": row.scored,
    }


def _since(started: float) -> float:
    return round(time.perf_counter() - started, 3)


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
