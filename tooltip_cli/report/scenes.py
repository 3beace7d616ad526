"""Figures of one recording that show its images: Figures 1 and 5 of the paper, the edge map."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tooltip_cli.labels.files import MatchedLabels
from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.detector import (
    NO_MOTION,
    Detections,
    DetectorParams,
    EdgeMotion,
    edge_motion,
    find_edges,
)
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.evaluation import Split
from tooltip_cli.method.types import Array
from tooltip_cli.report import overlay
from tooltip_cli.report.charts import Drawing
from tooltip_cli.report.model import FrameTable, RecordingReport, mean_of
from tooltip_cli.report.overlay import Circle, Image, Line, Shape, Window
from tooltip_cli.report.scoring import project_tip
from tooltip_cli.report.tables import csv_text, number

_GAP_PX = 10  # in the middle of that cross, where circle and dot are
CROSS_PX = 40  # Figure 5: "measures 40 pixels across for scale"
_OTHERS = "Green rings: the other ends that could be meant."
_OTHERS_OUTSIDE = "The other ends that could be meant lie outside this view."
_DOT_PX = 2  # radius of the edges that move
_RAMP = "from blue (0) over violet, red and orange to pale yellow"
_COLORS = np.array(  # from slow to fast, BGR; told apart by brightness too
    [[110, 80, 50], [190, 90, 150], [110, 110, 245], [60, 190, 255], [190, 255, 255]], dtype=float
)


@dataclass(frozen=True)
class VotedShape:
    """What voting sees of hand and tool, coarsely."""

    points: Array  # (P, 3) metres, hand frame
    shares: Array  # (P,) of the frames that agree on each
    frames: int  # that it was reconstructed from


Weigh = Callable[[int, Image, Image], EdgeMotion | str]
"""Returns the weighted edge map of an image index, given that image and the next one, both gray."""


def all_motion(
    detector: DetectorParams, frame: int, first: Image, second: Image
) -> EdgeMotion | str:
    """Weigh all edges, as the paper does; see `Weigh`."""
    return edge_motion(first, second, find_edges(first, detector), detector)


@dataclass(frozen=True)
class Scene:
    """A recording with all that its figures are drawn from."""

    recording: Recording
    views: Views  # that the estimate from detections is by
    given: Views  # that the baseline is by: the same, or before the rig was put right
    detections: Detections
    detector: DetectorParams
    preset: str  # voting or paper, as in `stages.evaluate`
    weigh: Weigh
    estimator: EstimatorParams
    split: Split
    labels: MatchedLabels | None
    shape: Callable[[], VotedShape | None]  # takes a second where it is not stored; None: no voting


def typical(row: RecordingReport, table: FrameTable) -> int | None:
    """Return the place in the table of the frame whose error is nearest to the tool's mean.

    Frames with a label and a detection come first. Without labels it is the frame whose
    detection lies nearest to the median distance from the prediction.
    """
    errors = table.prediction_error_px
    middle = mean_of(row.detector_px)
    if middle is None:
        errors = table.apart_px
        middle = float(np.nanmedian(errors)) if np.isfinite(errors).any() else 0.0
    complete = np.isfinite(table.label).all(axis=1) & np.isfinite(table.detection).all(axis=1)
    for usable in (np.isfinite(errors) & complete, np.isfinite(errors)):
        if usable.any():
            return int(np.argmin(np.where(usable, np.abs(errors - middle), np.inf)))
    shown = np.isfinite(table.label).all(axis=1) | np.isfinite(table.detection).all(axis=1)
    return int(np.argmax(shown)) if shown.any() else None


def scene_figures(
    row: RecordingReport, table: FrameTable, scene: Scene, frame: int | None = None
) -> Iterator[Drawing]:
    """Yield Figure 5, Figure 1 (right) and the weighted edge map of the same frame.

    Args:
        frame: image index; the test frame nearest to it is shown. Default: a typical one.
    """
    place = typical(row, table) if frame is None else int(np.argmin(abs(table.frames - frame)))
    if place is None:
        return
    first = int(table.frames[place])
    images = list(scene.recording.images(range(first, min(first + 2, row.frames))))
    yield _prediction(row, table, place, images[0], scene)
    yield _closeup(row, table, place, images[0], scene)
    if len(images) == 2:
        yield _edge_map(row, table, place, images, scene)


def _prediction(
    row: RecordingReport, table: FrameTable, place: int, image: Image, scene: Scene
) -> Drawing:
    scale = image.shape[1] / 640  # marks keep their weight on larger images
    low, high = np.zeros(2), np.array(image.shape[1::-1]) - 1.0
    mean = mean_of(row.detector_px)
    shapes: list[Shape] = []
    (u, v), (x, y) = table.prediction[place], table.label[place]
    if np.isfinite(u):
        shapes += overlay.cross(u, v, CROSS_PX, overlay.WHITE, scale, gap=_GAP_PX)
        if mean is not None:
            shapes.append(Circle(u, v, mean, overlay.WHITE, 0.8 * scale))
    if np.isfinite(x):
        shapes.append(Circle(x, y, 1.3 * scale, overlay.WHITE, filled=True))
    reach = CROSS_PX / 2 if mean is None else max(CROSS_PX / 2, mean)
    spots = np.array([(u - reach, v - reach), (u + reach, v + reach), (x, y)])
    corners = np.clip(spots[np.isfinite(spots).all(axis=1)], low, high)
    window = overlay.whole(image)
    if len(corners):
        window = overlay.window_around(corners, image, image.shape[1] // 4)
    words = f"Frame {table.frames[place]}"
    key = [f"Cross ({CROSS_PX} px across): the prediction."] if np.isfinite(u) else []
    if not np.isfinite(u):
        words += ": no prediction, the estimate was refused"
    elif mean is None:
        words += ": the prediction; without labels its error is unknown"
    elif np.isfinite(x):
        off = table.prediction_error_px[place]
        words += f": {off:.1f} px between prediction and label; the tool's mean is {mean:.1f} px"
        key.append("Circle: the tool's mean error.")
    key += ["Dot: the label."] if np.isfinite(x) else []
    others = _others(row, table, place, scene, 5 * scale)
    key += _others_words(others, window)
    return overlay.drawing(
        f"{row.name}-prediction",
        "Example prediction",
        f"Part of a camera image of {row.name} around the tip. {words}.",
        " ".join([f"{words}.", *key, "(Figure 5 of the paper.)"]),
        image,
        window,
        [*shapes, *others],
        _marks(table, place, {"mean_error_px": mean}),
    )


def _closeup(
    row: RecordingReport, table: FrameTable, place: int, image: Image, scene: Scene
) -> Drawing:
    points = (table.label[place], table.prediction[place], table.detection[place])
    hand = project_tip(scene.views, np.zeros(3), table.frames[place : place + 1])[0]
    corners = np.array([p for p in (*points[:2], hand) if np.isfinite(p).all()])
    if not len(corners):
        corners = points[2][None]
    low, high = np.zeros(2), np.array(image.shape[1::-1]) - 1.0
    window = overlay.window_around(np.clip(corners, low, high), image, image.shape[1] // 4)
    marks = window.width / 200
    shapes: list[Shape] = []
    for (u, v), color in zip(points, (overlay.WHITE, overlay.GREEN, overlay.BLACK), strict=True):
        if color == overlay.GREEN and np.isfinite(u):
            shapes += overlay.cross(u, v, 20 * marks, color, 1.6 * marks, gap=9 * marks)
        elif np.isfinite(u):
            shapes.append(Circle(u, v, 3 * marks, color, filled=True))
    others = _others(row, table, place, scene, 5 * marks)
    far = "" if _inside(points[2], window) else "; it lies outside this view"
    missing = "" if np.isfinite(points[2]).all() else "; there is none in this frame"
    return overlay.drawing(
        f"{row.name}-closeup",
        "Hand and tool",
        f"Magnified view of hand and tool in frame {table.frames[place]} of {row.name}, with the "
        f"motion interest point{missing or far}, the label and the estimate, where they exist.",
        " ".join(
            [
                f"Frame {table.frames[place]}, magnified.",
                f"Black: the motion interest point{missing or far}.",
                *(["White: the label."] if np.isfinite(points[0]).all() else []),
                *(["Green: the estimate."] if np.isfinite(points[1]).all() else []),
                *_others_words(others, window),
                "(Figure 1, right, of the paper.)",
            ]
        ),
        image,
        window,
        [*shapes, *others],
        _marks(table, place, {}),
    )


def _others(
    row: RecordingReport, table: FrameTable, place: int, scene: Scene, radius: float
) -> list[Circle]:
    """Return rings at the other candidates of an estimate with several right answers."""
    if row.detector is None or not row.detector.ambiguous:
        return []
    frame = table.frames[place : place + 1]
    tips = [np.array(item.position_m) for item in row.detector.candidates[1:]]
    pixels = [project_tip(scene.views, tip, frame)[0] for tip in tips]
    return [
        Circle(float(u), float(v), radius, overlay.GREEN, radius / 4)
        for u, v in pixels
        if np.isfinite(u)
    ]


def _others_words(others: Sequence[Circle], window: Window) -> list[str]:
    if not others:
        return []
    seen = any(_inside(np.array([ring.u, ring.v]), window) for ring in others)
    return [_OTHERS if seen else _OTHERS_OUTSIDE]


def _inside(point: Array, window: Window) -> bool:
    low = np.array([window.left, window.top])
    return bool(
        (point >= low).all() and (point < low + np.array([window.width, window.height])).all()
    )


def _edge_map(
    row: RecordingReport, table: FrameTable, place: int, images: Sequence[Image], scene: Scene
) -> Drawing:
    import cv2

    frame = int(table.frames[place])
    first, second = (np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) for image in images)
    motion = scene.weigh(frame, first, second)
    if not isinstance(motion, str) and not len(motion.edges):
        motion = NO_MOTION
    picture = np.asarray(cv2.cvtColor(first // 3, cv2.COLOR_GRAY2BGR))
    shapes: list[Shape] = []
    data, colors = "u,v,weight\n", ""
    if isinstance(motion, str):
        words = f"the detector finds no motion to weigh ({motion})"
    else:
        order = np.argsort(motion.weights, kind="stable")
        most = max(float(motion.weights.max()), scene.detector.min_weight)
        strength = motion.weights[order] / most
        u, v = motion.edges[order].T
        picture[v, u] = _ramp(strength)
        fast = motion.weights[order] > scene.detector.min_weight
        for x, y, color in zip(u[fast], v[fast], _ramp(strength[fast]), strict=True):
            cv2.circle(picture, (int(x), int(y)), _DOT_PX, color.tolist(), -1)
        u_most, v_most = map(float, motion.edges[np.argmax(motion.weights)])
        shapes = [Circle(u_most, v_most, 9 * picture.shape[1] / 640, overlay.WHITE)]
        heavy = int((motion.weights > scene.detector.min_weight).sum())
        words = (
            f"{heavy} of {len(motion.edges)} edges weigh more than "
            f"{scene.detector.min_weight:g}, the heaviest {motion.weights.max():.1f}"
        )
        colors = (
            "An edge's weight is its Mahalanobis distance from the motion of the background; its "
            f"colour goes {_RAMP} ({most:.1f}). Edges above the threshold are drawn as dots; the "
            "ring marks the heaviest, the motion interest point (section 3.1)."
        )
        if scene.preset != "paper":
            colors += " Edges that the tool cannot reach, or where nothing changed, are left out."
        lines = zip(*motion.edges.T.tolist(), motion.weights.tolist(), strict=True)
        data += "".join(f"{x},{y},{weight:.6f}\n" for x, y, weight in lines)
    return overlay.drawing(
        f"{row.name}-edges",
        "Weighted edge map",
        f"Edges of frame {frame} of {row.name} coloured by how much they move against the "
        f"background: {words}.",
        f"Frame {frame}: {words}. {colors}",
        picture,
        overlay.whole(picture),
        shapes,
        data,
    )


def _ramp(strength: Array) -> Image:
    """Return (N, 3) BGR colours for (N,) strengths from 0 to 1."""
    place = strength * (len(_COLORS) - 1)
    low = np.minimum(place.astype(int), len(_COLORS) - 2)
    part = (place - low)[:, None]
    return np.asarray(_COLORS[low] * (1 - part) + _COLORS[low + 1] * part, dtype=np.uint8)


def _marks(table: FrameTable, place: int, extra: dict[str, float | None]) -> str:
    """Return the data of a figure that shows one frame's marks."""
    columns: dict[str, str] = {
        "frame": str(int(table.frames[place])),
        "stamp_ns": str(int(table.stamps_ns[place])),
    }
    for name in ("label", "detection", "prediction", "baseline"):
        for axis, value in zip("uv", getattr(table, name)[place], strict=True):
            columns[f"{name}_{axis}"] = number(float(value), 3)
    columns |= {name: number(value) for name, value in extra.items()}
    return csv_text(list(columns), [list(columns.values())])


def by_severity(table: FrameTable) -> list[int]:
    """Return the table's places, the worst first; frames that cannot be scored come last.

    Without labels the distance between detection and prediction ranks.
    """
    errors = table.prediction_error_px
    if not np.isfinite(errors).any():
        errors = table.detection_error_px
    if not np.isfinite(errors).any():
        errors = table.apart_px
    return [int(place) for place in np.argsort(-np.nan_to_num(errors, nan=-1.0), kind="stable")]


@dataclass(frozen=True)
class Thumbnail:
    """A small part of a frame with its marks."""

    place: int  # in the table
    svg: str


def thumbnails(
    row: RecordingReport, table: FrameTable, scene: Scene, places: Sequence[int]
) -> Iterator[Thumbnail]:
    """Yield thumbnails in the order of the frames, so that the recording is read once."""
    ordered = sorted(places)
    images = scene.recording.images([int(table.frames[place]) for place in ordered])
    for place, image in zip(ordered, images, strict=True):
        yield Thumbnail(place, _thumbnail(row, table, place, image))


def _thumbnail(row: RecordingReport, table: FrameTable, place: int, image: Image) -> str:
    points = np.array(
        [table.label[place], table.prediction[place], table.baseline[place], table.detection[place]]
    )
    known = points[np.isfinite(points).all(axis=1)]
    height, width = image.shape[:2]
    if not len(known):
        known = np.array([[width / 2, height / 2]])
    known = np.clip(known, 0, (width - 1, height - 1))
    window = overlay.window_around(known[:3], image, width // 4)
    marks = window.width / 110
    shapes: list[Shape] = []
    (x, y), (u, v), _, (a, b) = points
    if np.isfinite(x) and np.isfinite(u):
        shapes.append(Line(x, y, u, v, overlay.WHITE, 0.5 * marks))
    if np.isfinite(a):
        shapes.append(Circle(a, b, 1.6 * marks, overlay.BLACK, filled=True))
    if np.isfinite(x):
        shapes.append(Circle(x, y, 1.6 * marks, overlay.WHITE, filled=True))
    if np.isfinite(u):
        shapes += overlay.cross(u, v, 11 * marks, overlay.GREEN, marks, gap=4.5 * marks)
    alt = f"Frame {table.frames[place]} of {row.name} around the tip"
    return overlay.overlay_svg(image, window, shapes, alt, 60, most=200)
