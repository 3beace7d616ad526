"""The report: one truth in page, JSON, CSV and LaTeX; figures that say what their data say."""

from __future__ import annotations

import csv
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.cli import tooltip
from tests.helpers.logs import wrist_parts, write_log, write_true_labels
from tests.helpers.robot import TIP
from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.labels.files import TipLabels, read_labels, write_labels
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.method.types import Candidate, Reason, TipEstimate
from tooltip_cli.method.voting.estimate import METHOD as VOTING
from tooltip_cli.report import charts, words, writer
from tooltip_cli.report.model import (
    ErrorShares,
    EvaluationReport,
    RecordingReport,
    from_plain,
)
from tooltip_cli.report.overall import MeanOfTools, Totals
from tooltip_cli.report.overlay import (
    BLACK,
    GREEN,
    WHITE,
    Circle,
    Line,
    overlay_png,
    overlay_svg,
    whole,
    window_around,
)
from tooltip_cli.report.region import shadow
from tooltip_cli.report.section import anchor
from tooltip_cli.report.tables import latex_table
from tooltip_cli.report.turnable import region_loops
from tooltip_cli.stages import evaluate as evaluation
from tooltip_cli.stages.estimate import Estimated, tip_document
from tooltip_cli.stages.evaluate import evaluate

Array = npt.NDArray[np.float64]
Rows = list[dict[str, str]]

FRAMES = 60
PAPER = EstimatorParams(method="kmeans")
NAMES = ("wrist", "odd & <i>name 100%")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a report on two tools, one with labels that hide some tips."""
    place = tmp_path_factory.mktemp("report")
    first = write_log(
        place / f"{NAMES[0]}.mcap",
        wrist_parts(FRAMES),
        {"truth.json": json.dumps({"tip_in_hand_m": TIP.tolist()}).encode()},
    )
    second = Path(shutil.copy(first, place / f"{NAMES[1]}.mcap"))
    write_true_labels(place / f"{NAMES[0]}.labels.csv", range(1, FRAMES, 4))
    rows = read_labels(place / f"{NAMES[0]}.labels.csv")
    shifted = rows.pixels + np.random.default_rng(0).normal(0, 1.5, rows.pixels.shape)
    states = ("occluded", "out_of_view", *rows.states[2:])
    write_labels(
        place / f"{NAMES[1]}.labels.csv",
        TipLabels(rows.stamps_ns, shifted, states, ("sim",) * len(rows)),
    )
    evaluate([first, second], out=place / "out", params=PAPER)
    return place / "out"


@pytest.fixture(scope="module")
def report(folder: Path) -> EvaluationReport:
    return from_plain(EvaluationReport, json.loads((folder / "report.json").read_text()))


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return (folder / "index.html").read_text(encoding="utf-8")


def table(path: Path) -> Rows:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def floats(rows: Rows, column: str) -> Array:
    return np.array([float(row[column]) for row in rows if row[column]])


# One number everywhere.


def test_frames_reproduce_every_mean(folder: Path, report: EvaluationReport) -> None:
    frames = table(folder / "frames.csv")
    for row in report.recordings:
        mine = [frame for frame in frames if frame["tool"] == row.name]
        assert len(mine) == (row.split.test if row.split else 0)
        for column, error in (
            ("prediction_error_px", row.detector_px),
            ("baseline_error_px", row.baseline_px),
            ("detection_error_px", row.detection_px),
        ):
            errors = floats(mine, column)
            assert error is not None
            assert error.count == len(errors)
            assert error.mean == pytest.approx(errors.mean(), abs=1e-4)
            assert error.median == pytest.approx(np.median(errors), abs=1e-4)
            assert error.maximum == pytest.approx(errors.max(), abs=1e-4)
        for start, end, column in (
            ("label", "prediction", "prediction_error_px"),
            ("label", "detection", "detection_error_px"),
        ):
            for frame in mine:
                if frame[column]:
                    apart = [
                        float(frame[f"{end}_{a}"]) - float(frame[f"{start}_{a}"]) for a in "uv"
                    ]
                    assert np.linalg.norm(apart) == pytest.approx(float(frame[column]), abs=2e-3)


def test_page_csv_and_latex_show_the_json(
    folder: Path, report: EvaluationReport, page: str
) -> None:
    tools = {row["tool"]: row for row in table(folder / "tools.csv")}
    latex = (folder / "tools.tex").read_text()
    lines = {line.split(" & ")[0]: line for line in latex.splitlines() if " & " in line}
    summary = page[page.index("<tbody>") : page.index("</tbody>")]
    for row in report.recordings:
        tex = lines[row.name.replace("&", r"\&").replace("%", r"\%")]
        for kind, error in (("detector", row.detector_px), ("baseline", row.baseline_px)):
            assert error is not None
            assert error.low is not None
            assert error.high is not None
            for name in ("mean", "median", "low", "high", "p95"):
                assert tools[row.name][f"{kind}_px_{name}"] == f"{getattr(error, name):.4f}"
            shown = (f"{error.mean:.2f}", f"[{error.low:.2f}, {error.high:.2f}]")
            assert " ".join(shown) in tex
            assert f"{shown[0]} <small>{shown[1]}</small>" in summary
        assert tools[row.name]["tip_error_mm"] == f"{row.tip_error_mm:.4f}"
        assert f"<td>{row.tip_error_mm:.1f}</td>" in summary
        assert f"{row.tip_error_mm:.2f}" in tex
    overall = report.overall
    assert overall.detector_px is not None
    means = [row.detector_px.mean for row in report.recordings if row.detector_px]
    assert overall.detector_px.mean == pytest.approx(np.mean(means))
    assert tools["mean of tools"]["detector_px_mean"] == f"{np.mean(means):.4f}"
    assert f"{np.mean(means):.2f} [" in latex.splitlines()[-3]


def test_the_histogram_holds_every_detection_once(
    folder: Path, report: EvaluationReport, page: str
) -> None:
    errors = floats(table(folder / "frames.csv"), "detection_error_px")
    histogram = report.overall.histogram
    assert histogram.detections == sum(histogram.counts) == len(errors)
    expected, _ = np.histogram(errors, bins=histogram.edges_px)
    np.testing.assert_array_equal(expected, histogram.counts)
    drawn = table(folder / "figures" / "detection-histogram.csv")
    assert [int(row["detections"]) for row in drawn] == list(histogram.counts)
    assert f"({len(errors)} detections of all tools)" in page


def test_shares_add_up(report: EvaluationReport) -> None:
    for row in report.recordings:
        assert row.shares is not None
        assert row.detector_px is not None
        parts = row.shares.detection_px + row.shares.clock_px + row.shares.calibration_px
        assert parts == pytest.approx(row.detector_px.mean)


def test_every_number_has_its_origin(report: EvaluationReport, page: str) -> None:
    for row in report.recordings:
        origin = row.provenance
        assert origin["recording_sha256"] == row.sha256
        assert origin["version"] == report.version
        assert origin["parameters"] == {**report.options}
        assert row.sha256[:12] in page
        assert row.labels is not None
        assert row.labels.digest[:12] in page
        for score in (row.detector, row.baseline):
            assert score is not None
            assert score.key[:12] in page
    assert "params.clusters" in page


# The page.


class Reader(HTMLParser):
    """Collects what a page is made of, and its mistakes."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.unnamed: list[str] = []
        self.mistakes: list[str] = []
        self.headings: list[int] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = {name: value or "" for name, value in attrs}
        if "id" in known:
            self.ids.append(known["id"])
        self.links += [known[name] for name in ("href", "src", "xlink:href") if name in known]
        inside = "svg" in self.open
        if tag == "svg" and not inside and not (known.get("role") and known.get("aria-label")):
            self.unnamed.append(str(attrs)[:80])
        if re.fullmatch(r"h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag not in {"meta", "image", "line", "circle"}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.mistakes.append(f"</{tag}> at {self.getpos()}")


@pytest.fixture(scope="module")
def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    return reader


def test_the_page_is_well_formed(read: Reader) -> None:
    assert not read.mistakes
    assert not read.open
    assert len(read.ids) == len(set(read.ids))
    steps = [
        after - before for before, after in zip(read.headings, read.headings[1:], strict=False)
    ]
    assert read.headings[0] == 1
    assert max(steps) <= 1  # no level is left out


def test_the_page_asks_no_host_for_anything(page: str, read: Reader) -> None:
    assert "default-src 'none'" in page
    outside = [link for link in read.links if not link.startswith(("#", "data:image/"))]
    assert all(re.match(r"^(figures|frames)/|^[a-z]+\.(json|csv|tex)$", link) for link in outside)
    assert not re.search(r"(src|href|url|import|fetch)[\s(=:'\"]+(https?:)?//", page)


def test_every_link_leads_somewhere(folder: Path, read: Reader) -> None:
    from urllib.parse import unquote

    for link in read.links:
        if link.startswith("#"):
            assert link[1:] in read.ids or link.startswith("#p") or link.startswith("#m"), link
        elif not link.startswith("data:"):
            assert (folder / unquote(link)).is_file(), link


def test_every_picture_has_a_text_alternative(read: Reader) -> None:
    assert not read.unnamed


def test_names_are_text_and_never_markup(page: str) -> None:
    assert "<i>" not in page
    assert "odd &amp; &lt;i&gt;name 100%" in page


def test_the_page_is_small(folder: Path) -> None:
    assert (folder / "index.html").stat().st_size < 3_000_000


def test_labels_by_a_simulator_are_called_so(page: str, report: EvaluationReport) -> None:
    marked = [row.labels.simulated for row in report.recordings if row.labels]
    assert marked == [False, True]
    assert "(simulated)" in page


def test_only_the_worst_of_many_recordings_are_shown_in_full(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "MOST_SECTIONS", 1)
    paths = [folder.parent / f"{name}.mcap" for name in NAMES]
    report = evaluate(paths, out=tmp_path, params=PAPER, curve=False)
    errors = {row.name: row.detector_px.mean for row in report.recordings if row.detector_px}
    worst = max(errors, key=lambda name: errors[name])
    page = (tmp_path / "index.html").read_text()
    for name in NAMES:
        assert (f'<h2 id="tool-{anchor(name)}">' in page) == (name == worst)
    assert "In the tables alone" in page
    assert {row["tool"] for row in table(tmp_path / "frames.csv")} == set(NAMES)


@given(st.text(max_size=12), st.text(max_size=12))
def test_anchors_are_safe_and_tell_names_apart(one: str, other: str) -> None:
    assert re.fullmatch(r"[A-Za-z0-9_.-]*", anchor(one))
    assert (anchor(one) == anchor(other)) == (one == other)


# Figures.


def test_every_figure_comes_in_all_forms_with_its_data(folder: Path) -> None:
    files = sorted((folder / "figures").iterdir())
    names = {path.stem for path in files}
    kinds = ("prediction", "closeup", "edges", "rays", "region", "over-time", "over-turn")
    assert names == {
        "error-by-tool",
        "tip-error-by-tool",
        "shares-by-tool",
        "detection-histogram",
        "error-by-training",
        *(f"{name}-{kind}" for name in NAMES for kind in kinds),
    }
    for name in names:
        place = folder / "figures"
        picture = cv2.imread(str(place / f"{name}.png"))
        assert picture is not None
        assert picture.shape[1] >= 1100  # 300 dots an inch over a column
        root = ElementTree.parse(place / f"{name}.svg").getroot()  # noqa: S314 - our own file
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert len(table(place / f"{name}.csv")) >= 1


def test_figures_that_were_removed_are_drawn_again(folder: Path, tmp_path: Path) -> None:
    place = Path(shutil.copytree(folder, tmp_path / "again"))
    (place / "figures" / "wrist-rays.png").unlink()
    shutil.rmtree(place / "frames")
    evaluate([folder.parent / f"{name}.mcap" for name in NAMES], out=place, params=PAPER)
    assert (place / "figures" / "wrist-rays.png").is_file()
    frames = {path.name for path in (folder / "frames").iterdir()}
    assert {path.name for path in (place / "frames").iterdir()} == frames


def test_figure_data_are_the_reports(folder: Path, report: EvaluationReport) -> None:
    figures = folder / "figures"
    bars = {row["tool"]: row for row in table(figures / "error-by-tool.csv")}
    frames = table(folder / "frames.csv")
    for row in report.recordings:
        assert row.detector_px is not None
        assert bars[row.name]["detector_px_mean"] == f"{row.detector_px.mean:.4f}"
        mine = [frame for frame in frames if frame["tool"] == row.name]
        over_time = table(figures / f"{row.name}-over-time.csv")
        assert [item["prediction_px"] for item in over_time] == [
            frame["prediction_error_px"] for frame in mine
        ]
        (marks,) = table(figures / f"{row.name}-prediction.csv")
        shown = next(frame for frame in mine if frame["frame"] == marks["frame"])
        for name in ("label_u", "prediction_v", "detection_u"):
            assert marks[name] == shown[name]
        assert float(marks["mean_error_px"]) == pytest.approx(row.detector_px.mean, abs=1e-4)
    points = table(figures / "error-by-training.csv")
    for row in report.recordings:
        mine = [point for point in points if point["tool"] == row.name]
        assert row.detector_px is not None
        assert float(mine[-1]["error_px"]) == pytest.approx(row.detector_px.mean, abs=1e-4)
        assert [(int(item["frames"]), item["error_px"], item["low_px"]) for item in mine] == [
            (point.frames, cell(point.error_px), cell(point.low_px)) for point in row.training
        ]


def cell(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def test_data_of_bars_are_the_reports(folder: Path, report: EvaluationReport) -> None:
    figures = folder / "figures"
    lengths = {row["tool"]: row for row in table(figures / "tip-error-by-tool.csv")}
    parts = {row["tool"]: row for row in table(figures / "shares-by-tool.csv")}
    for row in report.recordings:
        assert row.detector is not None
        assert row.detector.region_mm is not None
        assert lengths[row.name] == {
            "tool": row.name,
            "tip_error_mm": cell(row.tip_error_mm),
            "baseline_tip_error_mm": cell(row.baseline_tip_error_mm),
            "region_mm": cell(row.detector.region_mm[0]),
        }
        assert row.shares is not None
        assert parts[row.name] == {
            "tool": row.name,
            "total_px": cell(row.shares.total_px),
            "detection_px": cell(row.shares.detection_px),
            "clock_px": cell(row.shares.clock_px),
            "calibration_px": cell(row.shares.calibration_px),
        }


def test_data_of_the_region_are_the_estimates(folder: Path, report: EvaluationReport) -> None:
    row = report.recordings[0]
    marks = {mark["what"]: mark for mark in table(folder / "figures" / "wrist-region.csv")}
    assert list(marks) == ["estimate", "from labels", "true tip"]
    assert row.detector is not None
    assert row.detector.position_m is not None
    for name, score in (("estimate", row.detector), ("from labels", row.baseline)):
        assert score is not None
        assert score.position_m is not None
        offset = 1000 * (np.array(score.position_m) - np.array(row.detector.position_m))
        found = [float(marks[name][f"{axis}_mm"]) for axis in "xyz"]
        np.testing.assert_allclose(found, offset, atol=1e-4)
        spread = [float(marks[name][f"c_{pair}_mm2"]) for pair in ("xx", "xy", "zz")]
        covariance = 1e6 * np.array(score.covariance_m2)
        np.testing.assert_allclose(
            spread, [covariance[0, 0], covariance[0, 1], covariance[2, 2]], atol=1e-4
        )
    away = np.linalg.norm([float(marks["true tip"][f"{axis}_mm"]) for axis in "xyz"])
    assert away == pytest.approx(row.tip_error_mm, abs=1e-3)


def test_an_outline_is_the_ellipsoids_shadow() -> None:
    """The farthest that any point of the ellipsoid reaches along each direction of the picture."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(3, 3)) * 1e-3
    covariance = root @ root.T
    sphere = rng.normal(size=(200_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    surface = 1000 * np.sqrt(7.814727903251179) * sphere @ np.linalg.cholesky(covariance).T
    for pair in ((0, 2), (1, 2), (0, 1)):
        outline = shadow(covariance, pair)
        for angle in np.linspace(0, np.pi, 7):
            toward = np.array([np.cos(angle), np.sin(angle)])
            reach = (surface[:, list(pair)] @ toward).max()
            assert (outline @ toward).max() == pytest.approx(reach, rel=0.01)


def test_figures_of_frames_hold_what_the_table_holds(folder: Path) -> None:
    frames = {row["frame"]: row for row in table(folder / "frames.csv") if row["tool"] == NAMES[0]}
    dots = table(folder / "figures" / "wrist-over-turn.csv")
    assert {dot["frame"] for dot in dots} == set(frames)
    for dot in dots:
        assert dot["error_px"] == frames[dot["frame"]]["prediction_error_px"]
        for axis in "xyz":
            assert dot[f"turn_{axis}_deg"] == frames[dot["frame"]][f"turn_{axis}_deg"]


def test_the_interest_point_is_the_heaviest_edge(folder: Path) -> None:
    (marks,) = table(folder / "figures" / "wrist-closeup.csv")
    edges = table(folder / "figures" / "wrist-edges.csv")
    heaviest = max(edges, key=lambda row: float(row["weight"]))
    assert [float(heaviest[a]) for a in "uv"] == [float(marks[f"detection_{a}"]) for a in "uv"]


def test_the_shown_frame_can_be_chosen(folder: Path, tmp_path: Path) -> None:
    evaluate(
        [folder.parent / "wrist.mcap"], out=tmp_path, params=PAPER, curve=False, frame=FRAMES - 10
    )
    tested = np.arange(1, FRAMES, 4)
    nearest = tested[np.argmin(abs(tested - (FRAMES - 10)))]
    for kind in ("prediction", "closeup"):
        (marks,) = table(tmp_path / "figures" / f"wrist-{kind}.csv")
        assert int(marks["frame"]) == nearest


def test_rays_pass_the_true_tip(folder: Path) -> None:
    rows = table(folder / "figures" / "wrist-rays.csv")
    rays = [row for row in rows if row["kind"] == "ray" and row["panel"] == "test, by label"]
    assert len(rays) == len(range(1, FRAMES, 4))
    for row in rays:
        start, end = (np.array([float(row[f"{a}{i}_m"]) for a in "xyz"]) for i in (1, 2))
        along = (end - start) / np.linalg.norm(end - start)
        gap = TIP - start - ((TIP - start) @ along) * along
        assert np.linalg.norm(gap) < 2e-4
    (estimate,) = [
        row for row in rows if row["kind"] == "estimate" and row["panel"] == "test, by label"
    ]
    found = [float(estimate[f"{a}1_m"]) for a in "xyz"]
    np.testing.assert_allclose(found, TIP, atol=5e-4)


def test_charts_follow_the_theme(page: str) -> None:
    inline = re.findall(r"<figure id=\"error-by-tool\">.*?</svg>", page, re.DOTALL)[0]
    for color, name in (("#1b1f24", "ink"), ("#1f62b0", "detector"), ("#c4501b", "baseline")):
        assert color not in inline
        assert f"var(--{name})" in inline
    assert not re.search(r"fill: #(000000|ffffff)", inline)


def test_without_matplotlib_the_extra_is_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent() -> None:
        raise MissingExtraError("the report", "report", "matplotlib")

    monkeypatch.setattr(charts, "_matplotlib", absent)
    with pytest.raises(TooltipError, match=r"tooltip-cli\[report\]"):
        evaluate([folder.parent / "wrist.mcap"], out=tmp_path, params=PAPER, curve=False)


@settings(max_examples=20, deadline=None)
@given(st.floats(5, 90), st.floats(5, 60), st.sampled_from([WHITE, BLACK]))
def test_marks_are_painted_where_they_belong(u: float, v: float, color: str) -> None:
    image = np.full((66, 96, 3), 128, dtype=np.uint8)
    window = whole(image)
    mark = Circle(u, v, 2.0, color, filled=True)
    painted = cv2.imdecode(np.frombuffer(overlay_png(image, window, [mark]), np.uint8), 1)
    assert painted is not None
    scale = painted.shape[1] / 96
    value = 255 if color == WHITE else 0
    rows, columns = np.nonzero((painted == value).all(axis=2))
    disc = np.stack([columns, rows], axis=1)
    near = disc[np.linalg.norm((disc + 0.5) / scale - 0.5 - (u, v), axis=1) < 2.0]
    center = (near.mean(axis=0) + 0.5) / scale - 0.5
    np.testing.assert_allclose(center, (u, v), atol=0.06)
    svg = overlay_svg(image, window, [mark, Line(0, 0, u, v, color)], "a < b", 80)
    root = ElementTree.fromstring(svg)  # noqa: S314 - our own text
    assert root.get("aria-label") == "a < b"
    circles = root.findall("{http://www.w3.org/2000/svg}circle")
    assert [float(circles[-1].get(name, "")) for name in ("cx", "cy")] == [
        pytest.approx(u, abs=0.005),
        pytest.approx(v, abs=0.005),
    ]


@given(
    st.lists(st.tuples(st.floats(0, 159), st.floats(0, 119)), min_size=1, max_size=4),
    st.integers(10, 200),
)
def test_windows_hold_their_points_inside_the_image(
    points: list[tuple[float, float]], least: int
) -> None:
    image = np.zeros((120, 160, 3), dtype=np.uint8)
    window = window_around(np.array(points), image, least)
    assert 0 <= window.left <= window.left + window.width <= 160
    assert 0 <= window.top <= window.top + window.height <= 120
    assert window.cut(image).shape == (window.height, window.width, 3)
    for u, v in points:
        assert window.left - 1 <= u <= window.left + window.width
        assert window.top - 1 <= v <= window.top + window.height


def test_the_region_is_the_ellipsoid_of_the_covariance(report: EvaluationReport) -> None:
    score = report.recordings[0].detector
    assert score is not None
    assert score.covariance_m2 is not None
    inverse = np.linalg.inv(np.array(score.covariance_m2))
    for loop in region_loops(score):
        offsets = loop - np.array(score.position_m)
        squared = np.einsum("ni,ij,nj->n", offsets, inverse, offsets)
        np.testing.assert_allclose(squared, 7.8147, rtol=1e-3)


# Words.


def shares(**changes: object) -> ErrorShares:
    base = ErrorShares(6.0, 4.0, 0.0, 2.0, 0.5, 1.0, False, None)
    return replace(base, **changes)  # type: ignore[arg-type]


def test_shares_in_plain_words() -> None:
    text = words.share_words(shares())
    assert "Of 6.0 px, 4.0 px come from detection" in text
    assert "The clocks have no share" in text
    shown = words.share_words(
        shares(clock_shown=True, clock_px=1.5, clock_offset_ms=-31.0, calibration_px=0.5)
    )
    assert "1.5 px come from synchronisation" in shown
    assert "-31.0 ± 1.0 ms added to the image stamps" in shown
    better = words.share_words(shares(total_px=1.5, detection_px=-0.5))
    assert "Detection adds nothing: 1.5 px" in better
    assert "gives 2.0 px" in better
    unknown = words.share_words(shares(clock_offset_ms=None, clock_deviation_ms=None))
    assert "cannot be judged" in unknown
    several = words.share_words(shares(), nearest_px=2.5)
    assert "3.5 px of these are the choice between the tool's ends" in several
    assert "no visible part" in words.share_words(shares(label_noise_px=1.98))
    assert "about 1.7 px" in words.share_words(shares(label_noise_px=1.0))


def error(mean: float) -> ErrorSummary:
    return ErrorSummary(10, mean, mean, mean, mean, mean, mean - 0.1, mean + 0.1)


@pytest.mark.parametrize(
    ("ours", "theirs", "level"),
    [(2.0, 1.9, "good"), (3.0, 1.9, "fair"), (9.0, 1.9, "poor"), (0.4, 0.01, "good")],
)
def test_verdicts(report: EvaluationReport, ours: float, theirs: float, level: str) -> None:
    row = scored(report.recordings[0], ours, theirs)
    assert words.verdict(row).level == level


def scored(row: RecordingReport, ours: float, theirs: float) -> RecordingReport:
    assert row.detector is not None
    assert row.baseline is not None
    return replace(
        row,
        detector=replace(row.detector, error_px=error(ours)),
        baseline=replace(row.baseline, error_px=error(theirs)),
    )


def test_two_right_answers_are_both_named(report: EvaluationReport) -> None:
    row = report.recordings[0]
    assert row.detector is not None
    first = row.detector.candidates[0]
    other = replace(first, position_m=(0.1, 0.2, 0.3), error_px=1.25, tip_error_mm=4.0)
    reason = Reason("ambiguous_end", "two ends look alike")
    detector = replace(row.detector, candidates=(first, other), reasons=(reason,))
    text = words.end_words(other)
    assert "(100.0, 200.0, 300.0) mm" in text
    assert "1.2 px" in text
    assert "4.0 mm" in text
    command = words.prefer_command(replace(row, recording="a b/pen.mcap"), other)
    assert command == "tooltip estimate 'a b/pen.mcap' --prefer=0.100,0.200,0.300"
    rig = {**row.provenance["rig"], "source": "my rig.yaml"}
    given = replace(row, provenance={**row.provenance, "rig": rig})
    assert "--rig 'my rig.yaml' --prefer" in words.prefer_command(given, other)
    ambiguous = replace(row, detector=detector, reasons=(reason,))
    assert "Two ends look alike." in words.verdict(ambiguous).text


def test_latex_escapes_names(report: EvaluationReport) -> None:
    named = replace(report.recordings[0], name=r"a_b\c^2~50% & #{}$")
    text = latex_table(replace(report, recordings=(named,)))
    line = next(line for line in text.splitlines() if line.startswith("a"))
    assert line.startswith(
        r"a\_b\textbackslash{}c\textasciicircum{}2\textasciitilde{}50\% \& \#\{\}\$ & "
    )


# Sums over recordings.


def tools() -> Iterator[Array]:
    rng = np.random.default_rng(3)
    for mean in (2.0, 3.0, 7.0):
        yield rng.normal(mean, 1.0, size=100)


def test_the_mean_of_tools_counts_tools_alike() -> None:
    gathered = MeanOfTools()
    for seed, errors in enumerate(tools()):
        gathered.add(errors, str(seed))
    gathered.add(np.array([np.nan]), "none")
    summary = gathered.summary()
    assert summary is not None
    assert summary.count == 3
    assert summary.mean == pytest.approx(np.mean([errors.mean() for errors in tools()]))
    assert summary.low is not None
    assert summary.high is not None
    # three independent means of 100 errors with a deviation of 1
    assert summary.high - summary.low == pytest.approx(2 * 1.96 * 0.1 / np.sqrt(3), rel=0.25)


def test_the_mean_of_tools_does_not_mind_their_order() -> None:
    found = list(enumerate(tools()))
    forwards, backwards = MeanOfTools(), MeanOfTools()
    for gathered, order in ((forwards, found), (backwards, found[::-1])):
        for seed, errors in order:
            gathered.add(errors, str(seed))
    one, other = forwards.summary(), backwards.summary()
    assert one is not None
    assert other is not None
    assert [one.mean, one.low, one.high] == pytest.approx(
        [other.mean, other.low, other.high], rel=1e-12
    )


def test_totals_do_not_grow_with_the_recordings(report: EvaluationReport, folder: Path) -> None:
    import pickle

    from tooltip_cli.report.model import table_from_plain

    stored = json.loads((folder / "parts" / "wrist.json").read_text())["frames"]
    totals = Totals()
    sizes = []
    for _ in range(3):
        for _ in range(20):
            totals.add(report.recordings[0], table_from_plain(stored))
        sizes.append(len(pickle.dumps(totals)))
    assert sizes[2] - sizes[0] < 40 * 100  # a few numbers a recording
    assert totals.overall().recordings == 60
    assert totals.overall().histogram.detections == 60 * (
        report.recordings[0].detection_px.count if report.recordings[0].detection_px else 0
    )


# In a browser.


@pytest.fixture(scope="module")
def two_ends(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a report on an estimate with two ends."""
    place = tmp_path_factory.mktemp("ends")
    path = write_log(place / "wrist.mcap", wrist_parts(FRAMES))
    write_true_labels(place / "wrist.labels.csv", range(1, FRAMES, 4))
    covariance, axis = np.diag([1e-6, 4e-6, 9e-6]), np.array([0.0, 0.6, -0.8])
    ends = (
        Candidate(-TIP, 0.5, covariance, axis, np.radians(2.0)),
        Candidate(TIP, 0.4, covariance, -axis, np.radians(3.0)),
    )
    reason = Reason("ambiguous_end", "two ends look alike")
    found = TipEstimate(VOTING, -TIP, covariance, ends, (reason,), FRAMES)

    def ambiguous(*_: object, out: Path, **__: object) -> Estimated:
        document = tip_document(found, {"key": "ends"})
        return Estimated(out / "wrist.tip.json", "ends", False, found, document, None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "estimate_from_images", ambiguous)
        evaluate([path], out=place / "out", curve=False)
    return place / "out"


def test_both_ends_of_a_tool_are_in_every_figure_that_shows_one(two_ends: Path) -> None:
    for name in ("wrist-prediction", "wrist-closeup"):
        svg = (two_ends / "figures" / f"{name}.svg").read_text()
        assert GREEN in svg
    rows = table(two_ends / "figures" / "wrist-rays.csv")
    marked = [row for row in rows if row["panel"] == "training, by detection" and row["cluster"]]
    places = {
        row["kind"]: [float(row[f"{axis}1_m"]) for axis in "xyz"]
        for row in marked
        if row["kind"] in ("estimate", "candidate")
    }
    np.testing.assert_allclose(places["estimate"], -TIP, atol=1e-5)
    np.testing.assert_allclose(places["candidate"], TIP, atol=1e-5)
    page = (two_ends / "index.html").read_text()
    assert "± 2.0 degrees" in page
    assert "the choice between the tool&#39;s ends" in page
    bars = table(two_ends / "figures" / "error-by-tool.csv")
    assert float(bars[0]["nearest_candidate_px"]) < 0.1 < float(bars[0]["detector_px_mean"])


def test_an_end_is_chosen_by_click_and_by_key(browser: Any, two_ends: Path) -> None:
    """What the page then says runs, and takes that end."""
    import shlex

    view = browser.new_page(viewport={"width": 1280, "height": 900})
    view.goto((two_ends / "index.html").as_uri())
    assert view.locator(".chosen code").count() == 0
    view.get_by_role("button", name="End 1").focus()
    view.keyboard.press("Enter")
    assert "--prefer=-0.030,0.050,0.120" in view.locator(".chosen code").inner_text()
    canvas = view.locator(".turn canvas").nth(view.locator(".turn canvas").count() - 2)
    canvas.scroll_into_view_if_needed()
    u, v = canvas.evaluate(
        """canvas => {
          const scene = JSON.parse(canvas.closest(".turn").querySelector("script").textContent);
          const view = { basis: scene.basis, zoom: 1 };
          return projection(scene, view, canvas.clientWidth)(scene.ends[1].at, 0);
        }"""
    )
    canvas.click(position={"x": u + 3, "y": v - 2})
    command = view.locator(".chosen code").inner_text()
    assert "--prefer=0.030,-0.050,-0.120" in command
    assert view.get_by_role("button", name="End 2").get_attribute("aria-pressed") == "true"
    view.close()
    program, *arguments = shlex.split(command)
    assert program == "tooltip"
    done = tooltip(*arguments, "--json")
    assert done.code in (0, 3), done.err
    used = json.loads(done.out)["provenance"]["parameters"]["settings"]["prefer"]
    assert used == [0.03, -0.05, -0.12]


def test_the_accessibility_check_finds_nothing(browser: Any, folder: Path, two_ends: Path) -> None:
    """axe-core, with every part of the page opened, in light and dark."""
    script = Path(__file__).parent / "interop" / "node_modules" / "axe-core" / "axe.min.js"
    if not script.is_file():
        pytest.skip("axe-core is not installed: make interop")
    for place, scheme in ((folder, "light"), (folder, "dark"), (two_ends, "light")):
        context = browser.new_context(color_scheme=scheme, bypass_csp=True)
        view = context.new_page()
        view.goto((place / "index.html").as_uri())
        view.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
        for chooser in view.get_by_role("button", name="End 2").all():
            chooser.click()
        view.evaluate(script.read_text(encoding="utf-8"))
        found = view.evaluate("axe.run(document)")["violations"]
        context.close()
        assert [(item["id"], item["impact"]) for item in found] == []


@pytest.fixture(params=[(1280, "light"), (400, "dark")], ids=["desk", "phone"])
def shown(browser: Any, folder: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    """Yield the page in a browser; what it complains about fails the test."""
    width, scheme = request.param
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, reduced_motion="reduce"
    )
    view = context.new_page()
    complaints: list[str] = []
    view.on("console", lambda message: complaints.append(message.text))
    view.on("pageerror", lambda error: complaints.append(str(error)))
    view.on("request", lambda call: complaints.append(call.url))
    view.goto((folder / "index.html").as_uri())
    yield view
    context.close()
    assert [text for text in complaints if not text.startswith(("file:", "data:"))] == []


def test_nothing_overflows(shown: Any) -> None:
    width = shown.evaluate("document.documentElement.scrollWidth")
    assert width <= shown.viewport_size["width"]


def test_the_rays_turn_by_drag_and_by_keyboard(shown: Any) -> None:
    canvas = shown.locator(".turn canvas").first
    canvas.scroll_into_view_if_needed()
    picture = "canvas => canvas.toDataURL()"
    before = canvas.evaluate(picture)
    canvas.focus()
    shown.keyboard.press("ArrowLeft")
    turned = canvas.evaluate(picture)
    assert turned != before
    shown.keyboard.press("ArrowRight")
    box = canvas.bounding_box()
    shown.mouse.move(box["x"] + 50, box["y"] + 50)
    shown.mouse.down()
    shown.mouse.move(box["x"] + 90, box["y"] + 70)
    shown.mouse.up()
    assert canvas.evaluate(picture) != before
    shown.get_by_role("button", name="Reset").first.click()
    assert canvas.evaluate(picture) == before


def test_a_picture_opens_larger_and_closes(shown: Any) -> None:
    shown.locator("summary", has_text="test frames").first.click()
    shown.locator(".picture").first.click()
    viewer = shown.locator("#viewer")
    assert viewer.is_visible()
    assert viewer.locator("svg").count() == 1
    assert shown.locator("#viewer-title").inner_text().startswith("Frame ")
    shown.keyboard.press("Escape")
    assert not viewer.is_visible()


def test_a_worst_frame_leads_to_its_row(shown: Any) -> None:
    link = shown.locator(".strip a").first
    target = link.get_attribute("href")
    assert not shown.locator(f'[id="{target[1:]}"]').is_visible()
    link.click()
    shown.wait_for_function("document.querySelector('details:has(.audit)').open")
    assert shown.locator(f'[id="{target[1:]}"]').is_visible()
