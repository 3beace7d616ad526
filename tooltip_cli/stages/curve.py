"""Estimates from ever fewer of the training frames (4.4: are 400 too many?)."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tooltip_cli.log.views import Views
from tooltip_cli.method.estimators import ESTIMATORS, estimate_tip
from tooltip_cli.method.evaluation import pixel_errors
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.estimate import METHOD as VOTING
from tooltip_cli.method.voting.estimate import estimate_by_voting
from tooltip_cli.report.model import FrameTable, TrainingPoint
from tooltip_cli.report.scoring import project_tip
from tooltip_cli.stages.artifacts import artifact_path, plain, read_json, stage_key, write_whole
from tooltip_cli.stages.estimate import estimation_input

if TYPE_CHECKING:
    from tooltip_cli.stages.measure import Case

SIZES: Mapping[int, int] = {10: 5, 25: 5, 50: 5, 100: 2, 200: 1, 400: 1}
"""Frames, and how many random subsets of each: large ones are costly and alike, and more than half
of the frames would be nearly the same frames again."""
VOTING_SIZES: Mapping[int, int] = {30: 3, 50: 3, 100: 2}
QUICK_VOTING_SIZES: Mapping[int, int] = {50: 1, 100: 1}  # 3 s, where nobody asked
SUFFIX = ".curve.json"
VERSION = 1
_LOGGER = logging.getLogger(__name__)

Tips = list[Array | None]
EstimateOn = Callable[[Indices], Array | None]


def training_curve(case: Case, table: FrameTable, report_dir: Path) -> Iterator[TrainingPoint]:
    """Yield the errors of estimates from random subsets of the training frames, and from all.

    The estimates are kept under ``tips/`` in the report, so that new labels cost none of them.
    """
    method, curve = case.protocol.params.method, case.protocol.curve
    final = case.found["detections"].estimate
    if curve is False or (method == VOTING and final.position is None):
        return
    if curve is None and method == VOTING and not np.isfinite(table.label).any():
        return  # there is no error to show
    sizes = SIZES
    if method == VOTING:
        sizes = VOTING_SIZES if curve else QUICK_VOTING_SIZES
    tips = _tips(case, sizes, report_dir)
    points = [*tips.items(), (_used(case), [final.position])]
    yield from (
        _training_point(size, found, final.position, case.seen_by, table) for size, found in points
    )


def _used(case: Case) -> int:
    """Return how many training frames the estimate is from."""
    if case.protocol.params.method in ESTIMATORS:
        return len(_detected(case))
    return case.found["detections"].estimate.frames_used


def _tips(case: Case, sizes: Mapping[int, int], report_dir: Path) -> dict[int, Tips]:
    """Return the tips of all sizes that are small enough, stored or new."""
    parents = {"estimate": case.found["detections"].key}
    key = stage_key("curve", VERSION, parents, {"sizes": sizes, "seed": case.protocol.seed})
    place = artifact_path(case.recording.path, SUFFIX, report_dir / "tips" / "curve")
    stored = _stored(place, key)
    if stored is not None:
        return stored
    frames, estimate_on = _votes(case) if case.voters is not None else _detections(case)
    rng = np.random.default_rng(case.protocol.seed)
    tips = {
        size: [estimate_on(rng.permutation(frames)[:size]) for _ in range(repeats)]
        for size, repeats in sizes.items()
        if 2 * size <= len(frames)
    }
    write_whole(place, json.dumps({"key": key, "tips_m": plain(tips)}) + "\n")
    return tips


def _stored(place: Path, key: str) -> dict[int, Tips] | None:
    document = read_json(place)
    if not isinstance(document, dict) or document.get("key") != key:
        return None
    try:
        return {
            int(size): [None if tip is None else np.array(tip, dtype=float) for tip in found]
            for size, found in document["tips_m"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError):
        _LOGGER.info("%s cannot be read and is made anew", place)
        return None


def _detected(case: Case) -> Indices:
    """Return the training frames with a detection."""
    frames = case.detected.detections.tip_pixels().frames
    return case.split.train[np.isin(case.split.train, frames)]


def _detections(case: Case) -> tuple[Indices, EstimateOn]:
    """Return the training frames with a detection, and the estimate from some of them."""
    pixels = case.detected.detections.tip_pixels()

    def estimate_on(frames: Indices) -> Array | None:
        chosen = pixels.select(np.isin(pixels.frames, frames))
        return estimate_tip(estimation_input(case.views, chosen), case.protocol.params).position

    return _detected(case), estimate_on


def _votes(case: Case) -> tuple[Indices, EstimateOn]:
    """Return the frames that vote, and the estimate from some of them."""
    settings, views = case.protocol.params.voting, case.seen_by
    votes = None if case.voters is None else case.voters.votes()
    if votes is None:
        return case.split.train[:0], lambda frames: None
    edges = votes.known_to(views)

    def estimate_on(frames: Indices) -> Array | None:
        chosen = votes.seen_by(views, settings, edges.of_frames(frames))
        return estimate_by_voting(chosen, votes.spheres, settings).position

    return edges.frames, estimate_on


def _training_point(
    size: int, found: Sequence[Array | None], final: Array | None, views: Views, table: FrameTable
) -> TrainingPoint:
    tips = [tip for tip in found if tip is not None]
    errors = [pixel_errors(project_tip(views, tip, table.frames), table.label) for tip in tips]
    means = [float(np.nanmean(error)) for error in errors if np.isfinite(error).any()]
    shifts = [] if final is None else [float(np.linalg.norm(tip - final)) for tip in tips]
    return TrainingPoint(
        frames=size,
        repeats=len(found),
        refused=len(found) - len(tips),
        error_px=float(np.mean(means)) if means else None,
        low_px=min(means) if means else None,
        high_px=max(means) if means else None,
        shift_mm=float(1000 * np.mean(shifts)) if shifts else None,
    )
