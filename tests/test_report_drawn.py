"""What figures show is drawn again from the data beside them, and compared."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.logs import jpeg_of, wrist_parts, write_log, write_true_labels
from tests.helpers.robot import TIP
from tooltip_cli.labels.files import TipLabels, read_labels, write_labels
from tooltip_cli.method.detector import DetectorParams
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.report.charts import Chart, Drawing
from tooltip_cli.report.figures import _medians
from tooltip_cli.report.scenes import VotedShape
from tooltip_cli.stages import evaluate as evaluation
from tooltip_cli.stages.evaluate import evaluate

Array = npt.NDArray[np.float64]

FRAMES = 60
HALF = 0.51e-4  # of the last digit of most data
PICTURES = ("prediction", "closeup", "edges")
PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")


@dataclass(frozen=True)
class Drawn:
    """A report on two tools, and the canvas of each of its charts."""

    folder: Path
    canvases: dict[str, Any]

    def axes(self, name: str) -> Any:
        return self.canvases[name].axes

    def data(self, name: str) -> list[dict[str, str]]:
        with (self.folder / "figures" / f"{name}.csv").open(newline="") as file:
            return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    """Return a report whose two tools differ, with hidden labels and something voted."""
    place = tmp_path_factory.mktemp("drawn")
    truth = {"truth.json": json.dumps({"tip_in_hand_m": TIP.tolist()}).encode()}
    first = write_log(place / "one.mcap", wrist_parts(FRAMES), truth)
    second = Path(shutil.copy(first, place / "two.mcap"))
    write_true_labels(place / "one.labels.csv", range(1, FRAMES, 4))
    rows = read_labels(place / "one.labels.csv")
    moved = rows.pixels + np.random.default_rng(0).normal(0, 1.5, rows.pixels.shape)
    states = ("occluded", *rows.states[1:])
    write_labels(
        place / "two.labels.csv", TipLabels(rows.stamps_ns, moved, states, ("me",) * len(rows))
    )
    canvases: dict[str, Any] = {}
    draw = Chart.drawing

    def kept(chart: Chart, name: str, *rest: Any) -> Drawing:
        canvases[name] = chart.canvas
        return draw(chart, name, *rest)

    rng = np.random.default_rng(1)
    voted = VotedShape(rng.normal(TIP / 2, 0.02, (70, 3)), rng.uniform(0, 1, 70), 9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Chart, "drawing", kept)
        patch.setattr(evaluation, "voted_shape", lambda *_: voted)
        evaluate([first, second], out=place / "out", params=EstimatorParams(method="kmeans"))
    return Drawn(place / "out", canvases)


def numbers(rows: Sequence[dict[str, str]], *columns: str) -> Array:
    """Return (N, columns); NaN where a cell is empty."""
    return np.array([[float(row[name] or "nan") for name in columns] for row in rows])


def bars(axes: Any) -> list[Array]:
    """Return the (tools, 2) start and length of each series of horizontal bars."""
    return [
        np.array([(patch.get_x(), patch.get_width()) for patch in series])
        for series in axes.containers
    ]


def labels(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.get_yticklabels()]


def test_every_chart_was_kept(drawn: Drawn) -> None:
    files = {path.stem for path in (drawn.folder / "figures").glob("*.csv")}
    pictures = {f"{tool}-{kind}" for tool in ("one", "two") for kind in PICTURES}
    assert files - pictures == set(drawn.canvases)


def test_bars_of_errors(drawn: Drawn) -> None:
    (axes,) = drawn.axes("error-by-tool")
    rows = drawn.data("error-by-tool")
    assert labels(axes) == [row["tool"] for row in rows]
    spans = [line.get_xydata() for line in axes.lines if line.get_color() == "#1b1f24"]
    for at, kind in enumerate(("detector", "baseline")):
        means = numbers(rows, f"{kind}_px_mean")[:, 0]
        np.testing.assert_allclose(bars(axes)[at][:, 1], means, atol=HALF)
        ends = numbers(rows, f"{kind}_px_low", f"{kind}_px_high")
        mine = spans[at * len(rows) : (at + 1) * len(rows)]
        np.testing.assert_allclose([span[:, 0] for span in mine], ends, atol=HALF)
        shown = [text.get_text() for text in axes.texts[at * len(rows) : (at + 1) * len(rows)]]
        assert shown == [f"{mean:.1f}" for mean in means]


def test_bars_of_distances(drawn: Drawn) -> None:
    (axes,) = drawn.axes("tip-error-by-tool")
    rows = drawn.data("tip-error-by-tool")
    for series, column in zip(bars(axes), ("tip_error_mm", "baseline_tip_error_mm"), strict=True):
        np.testing.assert_allclose(series[:, 1], numbers(rows, column)[:, 0], atol=HALF)
    (strokes,) = [line for line in axes.lines if line.get_label() == "stated 95 %"]
    np.testing.assert_allclose(strokes.get_xdata(), numbers(rows, "region_mm")[:, 0], atol=HALF)


def test_bars_of_shares(drawn: Drawn) -> None:
    (axes,) = drawn.axes("shares-by-tool")
    rows = drawn.data("shares-by-tool")
    parts = np.maximum(numbers(rows, "detection_px", "clock_px", "calibration_px"), 0)
    for at, series in enumerate(bars(axes)):
        np.testing.assert_allclose(series[:, 1], parts[:, at], atol=HALF)
        np.testing.assert_allclose(series[:, 0], parts[:, :at].sum(axis=1), atol=3 * HALF)
    totals = numbers(rows, "total_px")[:, 0]
    assert [text.get_text() for text in axes.texts] == [f"{total:.1f}" for total in totals]


def test_bars_of_the_histogram(drawn: Drawn) -> None:
    whole, close = drawn.axes("detection-histogram")
    rows = drawn.data("detection-histogram")
    counts = numbers(rows, "detections")[:, 0]
    starts = numbers(rows, "from_px")[:, 0]
    for axes in (whole, close):
        low, high = axes.get_xlim()
        assert low == 0
        width = axes.patches[1].get_x() - axes.patches[0].get_x()
        for patch in axes.patches:
            begin = patch.get_x()
            inside = (starts >= begin - 1e-6) & (starts < begin + width - 1e-6)
            assert patch.get_height() == counts[inside].sum()
        assert sum(patch.get_height() for patch in axes.patches) == counts[starts < high].sum()


def test_lines_of_training_frames(drawn: Drawn) -> None:
    (axes,) = drawn.axes("error-by-training")
    rows = drawn.data("error-by-training")
    for line, tool in zip(axes.lines, ("one", "two"), strict=False):
        mine = [row for row in rows if row["tool"] == tool]
        np.testing.assert_allclose(
            line.get_xydata(), numbers(mine, "frames", "error_px"), atol=HALF
        )
    assert len(rows) == 4
    median = next(line for line in axes.lines if line.get_label() == "median of the tools")
    for size, error in median.get_xydata():
        mine = [row for row in rows if abs(float(row["frames"]) - size) < 3]
        assert len(mine) == 2
        assert error == pytest.approx(np.median(numbers(mine, "error_px")), abs=HALF)
    assert median.get_xdata()[-1] == numbers(rows, "frames").max()


def test_the_median_over_tools_reaches_all_of_their_frames() -> None:
    curves: list[list[tuple[int, float | None]]] = [
        [(10, 9.0), (100, 4.0), (397, 2.0)],
        [(10, 7.0), (100, None), (400, 3.0)],
        [(10, 8.0), (100, 2.0), (400, 4.0)],
        [(50, 1.0)],
    ]
    assert _medians(curves) == [(10.0, 8.0), (398.5, 2.5)]


def test_marks_over_time(drawn: Drawn) -> None:
    (axes,) = drawn.axes("two-over-time")
    rows = drawn.data("two-over-time")
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    for name in ("detection", "prediction", "baseline"):
        expected = numbers(rows, "seconds", f"{name}_px")
        expected[:, 1] = np.maximum(expected[:, 1], 0.1)
        np.testing.assert_allclose(lines[name], expected, atol=HALF)
    hidden = [float(row["seconds"]) for row in rows if row["hidden"] == "1"]
    assert len(hidden) == 1
    np.testing.assert_allclose(lines["hidden"][:, 0], hidden, atol=HALF)


def test_dots_over_the_turn(drawn: Drawn) -> None:
    axes = drawn.axes("two-over-turn")[0]
    turns = numbers(drawn.data("two-over-turn"), "turn_x_deg", "turn_y_deg", "turn_z_deg")
    (dots,) = axes.collections
    shown = np.sort(np.argsort(-turns.std(axis=0))[:2])
    np.testing.assert_allclose(dots.get_offsets(), turns[:, shown], atol=6e-4)
    errors = numbers(drawn.data("two-over-turn"), "error_px")[:, 0]
    np.testing.assert_allclose(dots.get_array(), errors, atol=HALF)


def test_outlines_of_the_region(drawn: Drawn) -> None:
    rows = {row["what"]: row for row in drawn.data("two-region")}
    for axes, (i, j) in zip(drawn.axes("two-region"), ((0, 2), (1, 2), (0, 1)), strict=False):
        marks = {line.get_label(): line.get_xydata() for line in axes.lines}
        loops = [line.get_xydata() for line in axes.lines if len(line.get_xdata()) > 2]
        for name in rows:
            place = numbers([rows[name]], "x_mm", "y_mm", "z_mm")[0]
            np.testing.assert_allclose(marks[name], [place[[i, j]]], atol=HALF)
        for name, loop in zip(("estimate", "from labels"), loops, strict=True):
            place = numbers([rows[name]], "x_mm", "y_mm", "z_mm")[0]
            upper = numbers([rows[name]], *(f"c_{pair}_mm2" for pair in PAIRS))[0]
            covariance = np.zeros((3, 3))
            covariance[np.triu_indices(3)] = upper
            covariance += np.triu(covariance, 1).T
            inverse = np.linalg.inv(covariance[np.ix_((i, j), (i, j))])
            off = loop - place[[i, j]]
            squared = np.einsum("ni,ij,nj->n", off, inverse, off)
            np.testing.assert_allclose(squared, 7.8147, rtol=0.05)  # data of 4 decimals


class Rays:
    """The data of a figure of rays, and the view they are to be seen from."""

    def __init__(self, rows: list[dict[str, str]]) -> None:
        self.rows = rows
        (right,), (up,) = self.ends("all", "view right"), self.ends("all", "view up")
        self.center = right[0]
        self.radius = float(np.linalg.norm(right[1] - right[0]))
        self.basis = np.stack([right[1] - right[0], up[1] - up[0]]) / self.radius

    def of(self, panel: str, *kinds: str) -> list[dict[str, str]]:
        return [row for row in self.rows if row["panel"] == panel and row["kind"] in kinds]

    def ends(self, panel: str, *kinds: str) -> Array:
        """Return (N, 2, 3) metres; NaN where there is one place only."""
        names = [f"{axis}{end}_m" for end in "12" for axis in "xyz"]
        return numbers(self.of(panel, *kinds), *names).reshape(-1, 2, 3)

    def flat(self, points: Array) -> Array:
        """Return millimetres in the picture."""
        return np.asarray((points - self.center) @ self.basis.T * 1000)


NEAR = 0.05  # mm: data have 0.01 mm, and so have the ends of the view's axes
PANELS = ("what moves with the hand", "training, by detection", "test, by label")


def test_rays_are_drawn_from_their_data(drawn: Drawn) -> None:
    data = Rays(drawn.data("two-rays"))
    for axes, panel in zip(drawn.axes("two-rays"), PANELS, strict=True):
        assert axes.get_title().startswith(panel)
        np.testing.assert_allclose(
            axes.get_xlim(), [-1000 * data.radius, 1000 * data.radius], atol=NEAR
        )
        lines, dots = axes.collections
        segments = np.array(lines.get_segments()).reshape(-1, 2, 2)
        np.testing.assert_allclose(segments, data.flat(data.ends(panel, "ray")), atol=0.2)
        kind = "voted" if panel == PANELS[0] else "intersection"
        places = data.flat(data.ends(panel, kind)[:, 0])
        assert len(places) > 20
        np.testing.assert_allclose(dots.get_offsets(), places, atol=0.1)
        colors = dots.get_facecolors()
        if kind == "voted":
            shares = numbers(data.of(panel, kind), "share")[:, 0]
            assert (
                np.corrcoef(colors[:, 3], np.minimum(shares, np.quantile(shares, 0.95)))[0, 1]
                > 0.999
            )
        else:
            clusters = [row["cluster"] for row in data.of(panel, kind)]
            pairs = {
                (cluster, tuple(color)) for cluster, color in zip(clusters, colors, strict=True)
            }
            assert len(pairs) == len(set(clusters))  # a colour each
        spheres = data.ends("all", "sphere")
        circles = [(*patch.center, patch.radius) for patch in axes.patches]
        sizes = 1000 * np.linalg.norm(spheres[:, 1] - spheres[:, 0], axis=1)
        expected = np.column_stack([data.flat(spheres[:, 0]), sizes])
        np.testing.assert_allclose(circles, expected, atol=NEAR)
        single = [line.get_xydata()[0] for line in axes.lines if len(line.get_xdata()) == 1]
        tip = data.flat(data.ends(panel, "estimate")[0, 0])
        truth = data.flat(data.ends("all", "true tip")[0, 0])
        np.testing.assert_allclose(single, [tip, tip, truth], atol=NEAR)
        loops = [line.get_xydata() for line in axes.lines if len(line.get_xdata()) > 2]
        semi = data.ends(panel, "95 % semi-axis")
        axes_mm = data.flat(semi[:, 1]) - data.flat(semi[:, 0])
        assert len(loops) == 3
        for loop, (i, j) in zip(loops, ((0, 1), (1, 2), (2, 0)), strict=True):
            for turn, place in ((0, axes_mm[i]), (12, axes_mm[j]), (24, -axes_mm[i])):
                np.testing.assert_allclose(loop[turn] - tip, place, atol=0.02)


def test_rays_turn_in_the_page_as_their_data_say(drawn: Drawn) -> None:
    page = (drawn.folder / "index.html").read_text()
    start = page.index('<figure id="two-rays">')
    found = re.search(r'<script type="application/json">(.*?)</script>', page[start:])
    assert found is not None
    scene = json.loads(found[1])
    data = Rays(drawn.data("two-rays"))

    def same(shown: Sequence[int], places: Array) -> None:
        expected = 1000 * (places.reshape(-1, 3) - data.center)
        np.testing.assert_allclose(np.reshape(shown, (-1, 3)), expected, atol=0.53)

    np.testing.assert_allclose(np.reshape(scene["basis"], (3, 3))[:2], data.basis, atol=2e-4)
    same(scene["truth"], data.ends("all", "true tip")[:, 0])
    same([v for item in scene["spheres"] for v in item[:3]], data.ends("all", "sphere")[:, 0])
    assert [item["title"] for item in scene["panels"]] == list(PANELS)
    for item in scene["panels"]:
        title = item["title"]
        kind = "voted" if title == PANELS[0] else "intersection"
        same(item["rays"], data.ends(title, "ray"))
        same(item["points"], data.ends(title, kind)[:, 0])
        same(item["tip"], data.ends(title, "estimate")[:, 0])
        same([v for other in item["others"] for v in other], data.ends(title, "candidate")[:, 0])
        if kind == "intersection":
            clusters = [int(row["cluster"]) for row in data.of(title, kind)]
            assert item["clusters"] == clusters


@pytest.mark.parametrize("tool", ["one", "two"])
def test_the_edge_map_is_drawn_from_its_data(drawn: Drawn, tool: str) -> None:
    """Edges of their colours over the darkened frame, dots above the threshold, and the ring."""
    (marks,) = drawn.data(f"{tool}-closeup")
    frame = cv2.imdecode(np.frombuffer(jpeg_of(int(marks["frame"])), np.uint8), 1)
    assert frame is not None
    picture = cv2.cvtColor(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) // 3, cv2.COLOR_GRAY2BGR)
    u, v, weights = numbers(drawn.data(f"{tool}-edges"), "u", "v", "weight").T
    least = DetectorParams().min_weight
    colors = ramp(weights / max(weights.max(), least))
    order = np.argsort(weights, kind="stable")
    for place in order:
        picture[int(v[place]), int(u[place])] = colors[place]
    for place in order[weights[order] > least]:
        spot = (int(u[place]), int(v[place]))
        cv2.circle(picture, spot, 2, colors[place].tolist(), -1)
    shown = cv2.imread(str(drawn.folder / "figures" / f"{tool}-edges.png"))
    assert shown is not None
    scale = shown.shape[1] / picture.shape[1]
    size = (shown.shape[1], shown.shape[0])
    expected = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
    apart = np.abs(expected.astype(int) - shown).max(axis=2)
    heaviest = int(np.argmax(weights))
    assert [u[heaviest], v[heaviest]] == [float(marks[f"detection_{axis}"]) for axis in "uv"]
    middle = (np.array([u[heaviest], v[heaviest]]) + 0.5) * scale - 0.5
    rows, columns = np.indices(apart.shape)
    away = np.hypot(columns - middle[0], rows - middle[1]) / scale
    radius, width = 9 * picture.shape[1] / 640, 1.5 + 1.4  # with its casing
    ring = np.abs(away - radius) < width / 2 + 1.5
    assert apart[~ring].max() <= 2
    on = np.abs(away - radius) < 0.3
    assert np.median(shown[on]) == 255


def ramp(strength: Array) -> Array:
    """Return the colours by linear interpolation between the five that the caption names, BGR."""
    stops = [(110, 80, 50), (190, 90, 150), (110, 110, 245), (60, 190, 255), (190, 255, 255)]
    places = np.linspace(0, 1, len(stops))
    channels = [np.interp(strength, places, [stop[c] for stop in stops]) for c in range(3)]
    return np.stack(channels, axis=1)


@pytest.mark.parametrize("tool", ["one", "two"])
def test_marks_over_images_are_drawn_from_their_data(drawn: Drawn, tool: str) -> None:
    """The SVG's marks, in image pixels, are what its data hold."""
    (marks,) = drawn.data(f"{tool}-prediction")
    svg = (drawn.folder / "figures" / f"{tool}-prediction.svg").read_text()
    found = [
        tuple(map(float, item))
        for item in re.findall(r'<circle cx="([-\d.]+)" cy="([-\d.]+)" r="([-\d.]+)"', svg)
    ]
    half = len(found) // 2  # each has a casing first
    ring, dot = found[half:]
    tip = [float(marks[f"prediction_{axis}"]) for axis in "uv"]
    np.testing.assert_allclose(ring, [*tip, float(marks["mean_error_px"])], atol=0.006)
    np.testing.assert_allclose(dot[:2], [float(marks[f"label_{a}"]) for a in "uv"], atol=0.006)
    lines = np.array(
        [
            tuple(map(float, item))
            for item in re.findall(
                r'<line x1="([-\d.]+)" y1="([-\d.]+)" x2="([-\d.]+)" y2="([-\d.]+)"', svg
            )
        ]
    ).reshape(-1, 2, 2)
    low, high = lines.min(axis=(0, 1)), lines.max(axis=(0, 1))
    np.testing.assert_allclose(high - low, 40, atol=0.02)  # Figure 5's cross
    np.testing.assert_allclose((high + low) / 2, tip, atol=0.02)
    close = (drawn.folder / "figures" / f"{tool}-closeup.svg").read_text()
    for name in ("label", "detection"):
        u, v = (float(marks[f"{name}_{axis}"]) for axis in "uv")
        assert f'<circle cx="{u:.2f}" cy="{v:.2f}"' in close
