"""What an evaluation found: the types behind ``report.json``, the tables, figures and the page.

``report.json`` is an :class:`EvaluationReport` taken apart field by field; the comments here are
its documentation. Numbers that do not exist are null. Lengths named ``_px`` are pixels, ``_mm``
millimetres, ``_m`` metres; positions are in the hand frame.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.method.types import Array, Indices, Reason

SCHEMA = "tooltip-report/1"
AMBIGUOUS = "ambiguous_end"  # the reason code of an estimate with a second right answer
Vector = tuple[float, float, float]
_Type = TypeVar("_Type")


@dataclass(frozen=True)
class CandidateScore:
    """One place where the tip may be, and how it would have done."""

    position_m: Vector
    support: float  # share of the evidence, 0 to 1
    axis: Vector | None  # unit vector out of the tool's end, where the method states one
    axis_deg: float | None  # standard deviation of its direction either way
    error_px: float | None  # mean over the scored test frames
    tip_error_mm: float | None  # distance to the true tip


@dataclass(frozen=True)
class EstimateScore:
    """An estimate and its errors in the test frames (paper, 4.3)."""

    source: str  # detections, or labels for the baseline
    status: str  # ok or refused
    reasons: tuple[Reason, ...]
    method: str
    frames_used: int
    position_m: Vector | None
    covariance_m2: tuple[Vector, Vector, Vector] | None
    deviations_mm: Vector | None  # standard deviation along x, y, z of the hand frame
    region_mm: Vector | None  # semi-axes of the 95 % ellipsoid, longest first
    region_axes: tuple[Vector, Vector, Vector] | None  # their unit vectors
    candidates: tuple[CandidateScore, ...]  # the first is the estimate
    error_px: ErrorSummary | None  # distance between its projection and the visible labels
    tip_error_mm: float | None  # distance to the true tip, where truth exists
    inside_region: bool | None  # whether the true tip lies in the 95 % ellipsoid
    artifact: str  # tip.json, relative to the report
    key: str  # of that artifact

    @property
    def ambiguous(self) -> bool:
        """Whether several candidates are right as far as the data tell."""
        return any(reason.code == AMBIGUOUS for reason in self.reasons)

    @property
    def nearest_px(self) -> float | None:
        """Error of the best candidate, where several are right as far as the data tell."""
        errors = [item.error_px for item in self.candidates if item.error_px is not None]
        return min(errors) if self.ambiguous and errors else None


@dataclass(frozen=True)
class DetectionScore:
    """What the 2D detector found, and how far from the labels (paper, 4.2)."""

    pairs: int  # pairs of images in the recording
    valid: int  # with a detection
    flags: dict[str, int]  # why the others have none
    error_px: ErrorSummary | None  # detections to visible labels, test frames
    within_10_px: float | None  # share of them at most 10 px away
    consistency_px: ErrorSummary | None  # detections to the projected tip, test frames; no label


@dataclass(frozen=True)
class ErrorShares:
    """Where the detector-based estimate's mean error comes from; the three shares add up to it."""

    total_px: float  # mean error of the estimate from detections
    detection_px: float  # what goes when labels replace detections
    clock_px: float  # of the baseline, what goes when the clocks are aligned
    calibration_px: float  # the rest of the baseline: calibration and the labels' own noise
    clock_offset_ms: float | None  # to add to the image stamps, fitted to the labels
    clock_deviation_ms: float | None  # its standard deviation
    clock_shown: bool  # whether the labels show an offset at all
    label_noise_px: float | None  # mean distance between labels and truth, where truth exists


@dataclass(frozen=True)
class TrainingPoint:
    """Estimates from fewer training frames."""

    frames: int
    repeats: int  # random subsets drawn
    refused: int  # of them
    error_px: float | None  # mean over the repeats of the mean test error
    low_px: float | None  # least and largest of the repeats
    high_px: float | None
    shift_mm: float | None  # mean distance to the estimate from all training frames


@dataclass(frozen=True)
class LabelSet:
    """The labels that a recording was scored against."""

    file: str
    digest: str  # SHA-256 over frames and pixels
    labelers: tuple[str, ...]
    simulated: bool  # placed by the simulator, not by a person
    visible: int
    hidden: int  # occluded or out of view
    second: str | None  # a second annotator's file
    annotator_px: ErrorSummary | None  # distance between the two, where both saw the tip
    disagreements: int  # frames that only one of the two called visible


@dataclass(frozen=True)
class SplitUsed:
    """Which frames trained and which tested."""

    kind: str  # labels, random or blocks
    seed: int
    train: int
    test: int


@dataclass(frozen=True)
class RecordingReport:
    """One recording, which is one row of every table."""

    name: str  # the tool: the recording's file name without its suffix
    recording: str  # path as given
    sha256: str
    status: str  # ok, refused, or failed where the recording could not be evaluated
    reasons: tuple[Reason, ...]  # why it is not ok
    notes: tuple[str, ...]  # what a reader of the numbers should know
    frames: int  # images
    duration_s: float
    image_size: tuple[int, int]  # width, height, pixels
    scored: int  # test frames with a visible label and a known hand pose
    split: SplitUsed | None
    labels: LabelSet | None
    truth_m: Vector | None  # the true tip, simulated data only
    apart_mm: float | None  # distance between the estimates from detections and from labels
    detection: DetectionScore | None
    detector: EstimateScore | None
    baseline: EstimateScore | None
    shares: ErrorShares | None
    training: tuple[TrainingPoint, ...]
    provenance: dict[str, Any]  # recording_sha256, parameters, version, created, key

    @property
    def detector_px(self) -> ErrorSummary | None:
        """Error of the estimate from detections."""
        return None if self.detector is None else self.detector.error_px

    @property
    def baseline_px(self) -> ErrorSummary | None:
        """Error of the estimate from labels."""
        return None if self.baseline is None else self.baseline.error_px

    @property
    def detection_px(self) -> ErrorSummary | None:
        """Error of the 2D detections."""
        return None if self.detection is None else self.detection.error_px

    @property
    def tip_error_mm(self) -> float | None:
        """Distance of the estimate from detections to the true tip."""
        return None if self.detector is None else self.detector.tip_error_mm

    @property
    def baseline_tip_error_mm(self) -> float | None:
        """Distance of the estimate from labels to the true tip."""
        return None if self.baseline is None else self.baseline.tip_error_mm


@dataclass(frozen=True)
class Histogram:
    """Detection errors over all tools (paper, Figure 7)."""

    bin_px: float
    counts: tuple[int, ...]  # counts[i] errors in [i, i + 1) * bin_px
    detections: int  # their sum

    @property
    def edges_px(self) -> Array:
        """(B + 1,) edges of the bins."""
        return np.asarray(np.arange(len(self.counts) + 1) * self.bin_px, dtype=float)


@dataclass(frozen=True)
class Overall:
    """All recordings together; each tool counts alike."""

    recordings: int
    ok: int
    refused: int
    failed: int
    compared: int  # tools with both errors, over which the means below run
    detector_px: ErrorSummary | None  # mean over tools of their mean errors
    baseline_px: ErrorSummary | None
    tip_error_mm: ErrorSummary | None  # over tools with truth
    histogram: Histogram


@dataclass(frozen=True)
class EvaluationReport:
    """What ``report.json`` holds."""

    schema: str
    version: str  # of this program
    created: str  # ISO 8601, UTC
    options: dict[str, Any]  # as asked for: split, seed, train, test, methods and parameters
    recordings: tuple[RecordingReport, ...]
    overall: Overall
    page: str  # path of index.html

    @property
    def status(self) -> str:
        """``ok`` where any recording is, else ``refused`` or ``failed``."""
        known = {row.status for row in self.recordings}
        return next(status for status in ("ok", "refused", "failed") if status in known)


@dataclass(frozen=True)
class FrameTable:
    """The test frames of one recording; pixels are NaN where there is none."""

    frames: Indices  # (T,) image indices, ascending
    stamps_ns: npt.NDArray[np.int64]  # (T,)
    states: tuple[str, ...]  # (T,) visible, occluded, out_of_view, or unlabelled
    label: Array  # (T, 2) u, v
    detection: Array  # (T, 2)
    weight: Array  # (T,) of the detection
    prediction: Array  # (T, 2) the estimate from detections, projected
    baseline: Array  # (T, 2) the estimate from labels, projected
    truth: Array  # (T, 2) the true tip's pixel
    turn_deg: Array  # (T, 3) the hand's turn about the camera's x, y, z from its mean orientation

    @property
    def detection_error_px(self) -> Array:
        """(T,) detection to label."""
        return np.asarray(np.linalg.norm(self.detection - self.label, axis=1))

    @property
    def prediction_error_px(self) -> Array:
        """(T,) prediction to label."""
        return np.asarray(np.linalg.norm(self.prediction - self.label, axis=1))

    @property
    def baseline_error_px(self) -> Array:
        """(T,) baseline's prediction to label."""
        return np.asarray(np.linalg.norm(self.baseline - self.label, axis=1))

    @property
    def apart_px(self) -> Array:
        """(T,) detection to prediction, which needs no label."""
        return np.asarray(np.linalg.norm(self.detection - self.prediction, axis=1))


def mean_of(errors: ErrorSummary | None) -> float | None:
    """Return the mean of errors that may not exist."""
    return None if errors is None else errors.mean


def from_plain(kind: type[_Type], value: Any) -> _Type:
    """Build a dataclass of this module from what JSON holds.

    Raises:
        TooltipError: the value does not fit the type.
    """
    try:
        built: _Type = _build(kind, value)
        return built
    except (KeyError, TypeError, ValueError) as error:
        raise TooltipError(f"not a {kind.__name__} of {SCHEMA} ({error!r})") from error


def _build(kind: Any, value: Any) -> Any:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        chosen = next(item for item in inner if item is not type(None))
        return None if value is None else _build(chosen, value)
    if origin is tuple:
        if len(inner) == 2 and inner[1] is ...:
            return tuple(_build(inner[0], item) for item in value)
        return tuple(_build(part, item) for part, item in zip(inner, value, strict=True))
    if origin is dict:
        return {str(key): _build(inner[1], item) for key, item in value.items()}
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        known = typing.get_type_hints(kind)
        names = [item.name for item in dataclasses.fields(kind)]
        return kind(**{name: _build(known[name], value[name]) for name in names})
    return value if kind is Any else kind(value)


_FLOAT_COLUMNS = ("label", "detection", "weight", "prediction", "baseline", "truth", "turn_deg")


def table_from_plain(value: Any) -> FrameTable:
    """Build a frame table from what JSON holds.

    Raises:
        TooltipError: the value is none.
    """
    try:
        shapes = {"weight": (-1,), "turn_deg": (-1, 3)}
        columns = {
            name: np.array(value[name], dtype=float).reshape(shapes.get(name, (-1, 2)))
            for name in _FLOAT_COLUMNS
        }
        return FrameTable(
            frames=np.array(value["frames"], dtype=np.intp),
            stamps_ns=np.array(value["stamps_ns"], dtype=np.int64),
            states=tuple(map(str, value["states"])),
            **columns,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise TooltipError(f"not a table of frames ({error!r})") from error
