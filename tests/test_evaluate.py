"""Evaluation: known errors come out as what they are, and nothing is measured on what trained."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import refusal
from tests.helpers.cli import tooltip
from tests.helpers.logs import (
    image_message,
    jpeg_of,
    stamp_of,
    true_pixels,
    wrist_parts,
    write_log,
    write_true_labels,
)
from tests.helpers.robot import TIP, tip_in_camera
from tooltip_cli.labels.files import TipLabels, match_labels, read_labels, write_labels
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.evaluation import (
    bootstrap_interval,
    bootstrap_means,
    fit_clock,
    split_by_labels,
    summarize,
)
from tooltip_cli.method.types import Candidate, Reason, TipEstimate, refused
from tooltip_cli.report.model import (
    EvaluationReport,
    FrameTable,
    RecordingReport,
    from_plain,
    table_from_plain,
)
from tooltip_cli.report.scoring import Truth, describe_labels, project_tip, read_truth
from tooltip_cli.stages.artifacts import plain
from tooltip_cli.stages.compare import BETTER, NOT_COMPARED, SAME, WORSE, compare
from tooltip_cli.stages.detect import detect_in
from tooltip_cli.stages.estimate import Estimated, estimate_from_labels, tip_document
from tooltip_cli.stages.evaluate import evaluate
from tooltip_cli.stages.measure import Case, Labelled, Protocol, measure

Array = npt.NDArray[np.float64]

FRAMES = 40
PAPER = EstimatorParams(method="kmeans")
LABELLED = tuple(range(1, FRAMES, 3))
TRUTH = json.dumps({"tip_in_hand_m": TIP.tolist()}).encode()


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a recording, its true labels and its truth, evaluated once."""
    folder = tmp_path_factory.mktemp("shelf")
    write_log(folder / "wrist.mcap", wrist_parts(FRAMES), {"truth.json": TRUTH})
    write_true_labels(folder / "wrist.labels.csv", LABELLED)
    evaluate([folder / "wrist.mcap"], out=folder / "report", params=PAPER, curve=False)
    return folder


def labels_at(path: Path, pixels: Array, labeler: str = "me", hidden: int = 0) -> Path:
    """Write labels of the labelled frames; the first ``hidden`` are occluded."""
    states = tuple("occluded" if row < hidden else "visible" for row in range(len(LABELLED)))
    chosen = pixels.copy()
    chosen[:hidden] = np.nan
    stamps = np.array([stamp_of(frame) for frame in LABELLED], dtype=np.int64)
    write_labels(path, TipLabels(stamps, chosen, states, (labeler,) * len(LABELLED)))
    return path


def labelled_pixels() -> Array:
    return np.asarray(true_pixels(FRAMES)[list(LABELLED)])


def estimated(position: Array | None, source: str) -> Estimated:
    """Return an estimate as its stage would, at a place of our choosing."""
    if position is None:
        found = refused("kmeans", 9, Reason("no_motion", "nothing moves"))
    else:
        covariance = np.diag([1e-6, 4e-6, 9e-6])
        candidates = (Candidate(position, 0.8), Candidate(position + 0.05, 0.2))
        found = TipEstimate("kmeans", position, covariance, candidates, (), 30)
    document = tip_document(found, {"key": source})
    return Estimated(Path(f"{source}.tip.json"), source, False, found, document, None)


def measured(
    shelf: Path, detector: Array | None, baseline: Array | None, labels: Path | None = None
) -> tuple[RecordingReport, FrameTable]:
    """Measure two given estimates against the labels of the shelf's recording."""
    recording = read_recording(shelf / "wrist.mcap")
    rig = resolve_rig(recording, None)
    views = resolve_views(recording, rig)
    path = labels or shelf / "wrist.labels.csv"
    rows = read_labels(path)
    matched = match_labels(rows, recording.image_stamps_ns, views.camera)
    states = dict(zip(map(int, matched.frames), rows.states, strict=True))
    detected = detect_in(recording, out=shelf / "report")
    return measure(
        Case(
            recording,
            rig,
            views,
            rig,
            views,
            Labelled(path, matched, states, describe_labels(path, "", matched, None)),
            split_by_labels(FRAMES, matched.frames),
            detected,
            {
                "detections": estimated(detector, "detections"),
                "labels": estimated(baseline, "labels"),
            },
            Truth(TIP, true_pixels(FRAMES)),
            Protocol(params=PAPER, curve=False),
            "key",
        ),
        shelf,
    )


# Known errors in, the same errors out.


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-0.02, 0.02)] * 3))
def test_a_tip_shifted_by_known_millimetres(
    shelf: Path, offset: tuple[float, float, float]
) -> None:
    shift = np.array(offset)
    row, table = measured(shelf, TIP + shift, TIP)
    assert row.detector is not None
    assert row.tip_error_mm == pytest.approx(1000 * np.linalg.norm(shift), abs=1e-9)
    assert row.apart_mm == pytest.approx(row.tip_error_mm, abs=1e-9)
    # the errors in pixels from the kinematics written out by hand
    recording = read_recording(shelf / "wrist.mcap")
    views = resolve_views(recording, resolve_rig(recording, None))
    expected = np.linalg.norm(project_tip(views, TIP + shift, table.frames) - table.label, axis=1)
    assert row.detector_px is not None
    assert row.detector_px.mean == pytest.approx(expected.mean(), abs=1e-9)
    inside = (shift**2 / np.array([1e-6, 4e-6, 9e-6])).sum() <= 7.814727903251179
    assert row.detector.inside_region == inside


def test_the_projection_is_that_of_the_robot_written_out_by_hand(shelf: Path) -> None:
    recording = read_recording(shelf / "wrist.mcap")
    views = resolve_views(recording, resolve_rig(recording, None))
    projected = project_tip(views, TIP, np.arange(FRAMES))
    # joints are interpolated between samples 10 ms apart
    np.testing.assert_allclose(projected, true_pixels(FRAMES), atol=0.02)


@settings(max_examples=20, deadline=None)
@given(st.floats(-6, 6), st.floats(-6, 6))
def test_labels_shifted_by_known_pixels(
    shelf: Path, tmp_path_factory: pytest.TempPathFactory, right: float, down: float
) -> None:
    path = tmp_path_factory.mktemp("labels") / "wrist.labels.csv"
    right, down = round(right, 2), round(down, 2)  # what a label file holds
    row, _ = measured(shelf, TIP, TIP, labels_at(path, labelled_pixels() + np.array([right, down])))
    distance = np.hypot(right, down)
    assert row.detector_px is not None
    assert row.detector_px.mean == pytest.approx(distance, abs=0.03)  # file rounding, joints
    assert row.shares is not None
    assert row.shares.label_noise_px == pytest.approx(distance, abs=0.01)
    assert row.shares.detection_px == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("late_ms", [-20, 0, 35])
def test_stamps_late_by_a_known_time(tmp_path: Path, late_ms: int) -> None:
    frames, late = 90, late_ms * 1_000_000
    parts = wrist_parts(frames)
    parts["images"] = [image_message(stamp_of(i) + late, jpeg_of(i)) for i in range(frames)]
    path = write_log(tmp_path / "wrist.mcap", parts)
    chosen = list(range(2, frames - 2, 3))
    stamps = np.array([stamp_of(frame) + late for frame in chosen], dtype=np.int64)
    pixels = np.asarray(true_pixels(frames)[chosen])
    count = len(chosen)
    rows = TipLabels(stamps, pixels, ("visible",) * count, ("me",) * count)
    write_labels(tmp_path / "wrist.labels.csv", rows)
    shares = (
        evaluate([path], out=tmp_path / "report", params=PAPER, curve=False).recordings[0].shares
    )
    assert shares is not None
    assert shares.clock_offset_ms == pytest.approx(-late_ms, abs=0.2)
    assert shares.clock_shown == (late_ms != 0)
    parts_px = shares.detection_px + shares.clock_px + shares.calibration_px
    assert parts_px == pytest.approx(shares.total_px)
    if late_ms:  # the baseline's error is the clocks' alone
        assert shares.clock_px > 0.9 * (shares.clock_px + shares.calibration_px)
        assert shares.clock_px > 0.5


def test_a_refused_estimate_has_no_error(shelf: Path) -> None:
    row, table = measured(shelf, None, TIP)
    assert (row.status, [reason.code for reason in row.reasons]) == ("refused", ["no_motion"])
    assert row.detector_px is None
    assert row.tip_error_mm is None
    assert row.shares is None
    assert not np.isfinite(table.prediction).any()
    assert row.baseline_px is not None


def test_a_baseline_that_is_refused_is_said_to_be(shelf: Path, tmp_path: Path) -> None:
    """One label is one ray."""
    stamps, pixels = np.array([stamp_of(LABELLED[0])], dtype=np.int64), labelled_pixels()[:1]
    path = tmp_path / "wrist.labels.csv"
    write_labels(path, TipLabels(stamps, pixels, ("visible",), ("me",)))
    report = evaluate(
        [shelf / "wrist.mcap"], labels=path, out=tmp_path / "r", params=PAPER, curve=False
    )
    row = report.recordings[0]
    assert row.baseline_px is None
    assert row.detector_px is not None
    assert (row.detector_px.count, row.detector_px.low) == (1, None)
    (note,) = [note for note in row.notes if note.startswith("no baseline")]
    assert "the labels alone do not give the tip (" in note
    page = (tmp_path / "r" / "index.html").read_text()
    assert "No baseline: the labels alone" in page


def test_candidates_are_scored_too(shelf: Path) -> None:
    row, _ = measured(shelf, TIP, TIP)
    assert row.detector is not None
    first, second = row.detector.candidates
    assert row.detector_px is not None
    assert first.error_px == pytest.approx(row.detector_px.mean)
    assert second.tip_error_mm == pytest.approx(1000 * np.sqrt(3) * 0.05)
    assert second.error_px is not None
    assert second.error_px > 10


def test_hidden_labels_train_nothing_and_score_nothing(shelf: Path, tmp_path: Path) -> None:
    path = labels_at(tmp_path / "wrist.labels.csv", labelled_pixels(), hidden=4)
    report = evaluate(
        [shelf / "wrist.mcap"], labels=path, out=tmp_path / "r", params=PAPER, curve=False
    )
    row = report.recordings[0]
    assert row.labels is not None
    assert (row.labels.visible, row.labels.hidden) == (len(LABELLED) - 4, 4)
    assert row.scored == len(LABELLED) - 4
    assert row.split is not None
    assert row.split.test == len(LABELLED)
    assert row.split.train == FRAMES - len(LABELLED)


@pytest.mark.parametrize("method", ["voting", "map"])
def test_every_method_is_evaluated_alike(tmp_path: Path, method: str) -> None:
    frames = 200
    path = write_log(tmp_path / "wrist.mcap", wrist_parts(frames), {"truth.json": TRUTH})
    write_true_labels(tmp_path / "wrist.labels.csv", range(2, frames, 8))
    params = EstimatorParams(method=method)
    report = evaluate([path], out=tmp_path / "r", params=params, train=150, curve=True)
    row = report.recordings[0]
    assert row.detector is not None
    assert row.detector.method == method
    assert row.detector_px is not None
    assert row.detector_px.mean < 4
    assert row.tip_error_mm is not None
    assert row.tip_error_mm < 15
    sizes = [point.frames for point in row.training]
    assert sizes == sorted(sizes)
    assert sizes[0] == {"voting": 30, "map": 10}[method]
    assert sizes[-1] <= 150  # no labelled frame, and no more than was asked for
    assert row.training[-1].error_px == pytest.approx(row.detector_px.mean)


def test_what_voting_saw_is_kept_and_new_labels_cost_no_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = 120
    path = write_log(tmp_path / "wrist.mcap", wrist_parts(frames))
    write_true_labels(tmp_path / "wrist.labels.csv", range(2, frames, 8))
    first = evaluate([path], out=tmp_path / "r").recordings[0]
    assert first.detector is not None
    assert first.detector.position_m is not None
    assert [point.frames for point in first.training][:1] == [50]
    seen = json.loads((tmp_path / "r" / "tips" / "shape" / "wrist.shape.json").read_text())
    # the tool is a stick whose other end lies 2 cm beside the hand's origin
    along = np.array(seen["points"]) @ TIP / np.linalg.norm(TIP)
    away = np.linalg.norm(
        np.array(seen["points"]) - along[:, None] * TIP / np.linalg.norm(TIP), axis=1
    )
    assert np.median(away) < 0.015
    assert along.max() == pytest.approx(np.linalg.norm(TIP), abs=0.02)

    def never(*_: object) -> None:
        raise AssertionError("estimated again")

    rows = read_labels(tmp_path / "wrist.labels.csv")
    moved = TipLabels(rows.stamps_ns, rows.pixels + 1.0, rows.states, rows.labelers)
    write_labels(tmp_path / "wrist.labels.csv", moved)
    with monkeypatch.context() as patch:
        patch.setattr("tooltip_cli.stages.curve.estimate_by_voting", never)
        patch.setattr("tooltip_cli.stages.shape.reconstruct", never)
        again = evaluate([path], out=tmp_path / "r").recordings[0]
    assert [point.shift_mm for point in again.training] == [
        point.shift_mm for point in first.training
    ]
    assert again.training[0].error_px != first.training[0].error_px
    for place in (tmp_path / "r" / "tips").glob("*/wrist.*.json"):
        if place.parent.name in ("curve", "shape"):
            place.write_text(place.read_text()[:-20])  # damaged: made anew
    shutil.rmtree(tmp_path / "r" / "parts")
    once_more = evaluate([path], out=tmp_path / "r").recordings[0]
    assert once_more.training == again.training


# What depends on what.


def test_a_second_run_reuses_everything_and_a_changed_parameter_only_what_it_must(
    shelf: Path,
) -> None:
    def steps(**options: object) -> dict[str, str]:
        said: dict[str, str] = {}

        def note(path: Path, text: str) -> None:
            how, place = text.split(" ", 1)
            said["/".join(Path(place).parts[-2:])] = how

        evaluate(
            [shelf / "wrist.mcap"],
            out=shelf / "again",
            params=PAPER,
            curve=False,
            on_step=note,
            **options,  # type: ignore[arg-type]
        )
        return said

    names = [
        "again/wrist.detections.mcap",
        "detections/wrist.tip.json",
        "labels/wrist.tip.json",
        "parts/wrist.json",
    ]
    assert steps() == dict.fromkeys(names, "computed")
    assert steps() == dict.fromkeys(names, "reused")
    fewer = steps(train=10)
    assert fewer == dict(zip(names, ["reused", "computed", "reused", "computed"], strict=True))
    forced = steps(train=10, force=True)
    assert forced == dict(zip(names, ["reused", "computed", "computed", "computed"], strict=True))


def test_equal_inputs_give_equal_reports(shelf: Path, tmp_path: Path) -> None:
    def numbers(out: Path) -> str:
        report = evaluate([shelf / "wrist.mcap"], out=out, params=PAPER)
        document = json.loads(Path(report.page).with_name("report.json").read_text())
        for item in (document, document["recordings"][0]["provenance"]):
            del item["created"]
        del document["page"]
        return json.dumps(document)

    assert numbers(tmp_path / "one") == numbers(tmp_path / "two")


def test_the_stored_report_is_the_returned_one(shelf: Path) -> None:
    report = evaluate([shelf / "wrist.mcap"], out=shelf / "report", params=PAPER, curve=False)
    document = json.loads((shelf / "report" / "report.json").read_text())
    assert from_plain(EvaluationReport, document) == report


# Inputs that lack something.


def test_without_labels_it_says_what_cannot_be_told(shelf: Path, tmp_path: Path) -> None:
    path = tmp_path / "alone.mcap"
    path.write_bytes((shelf / "wrist.mcap").read_bytes())
    report = evaluate([path], test=10, train=30, split="blocks", params=PAPER, curve=False)
    row = report.recordings[0]
    assert report.page == str(tmp_path / "report" / "index.html")
    assert (tmp_path / "alone.detections.mcap").exists()
    assert row.status == "ok"
    assert row.split is not None
    assert (row.split.kind, row.split.train, row.split.test) == ("blocks", 30, 10)
    assert (row.detector_px, row.baseline, row.shares) == (None, None, None)
    assert row.detection is not None
    assert row.detection.consistency_px is not None
    assert any("tooltip label alone.mcap" in note for note in row.notes)
    assert row.tip_error_mm is not None  # the truth is there all the same


def test_truth_beside_the_recording_counts_and_another_kind_of_truth_does_not(
    shelf: Path, tmp_path: Path
) -> None:
    path = write_log(tmp_path / "wrist.mcap", wrist_parts(FRAMES))
    recording = read_recording(path)
    assert read_truth(recording) is None
    beside = tmp_path / "wrist.truth.json"
    beside.write_text('{"corners": {}}')
    assert read_truth(recording) is None
    stamps = [stamp_of(1), stamp_of(0) + 5]
    pixels = [[3.0, 4.0], [5.0, 6.0]]
    beside.write_text(
        json.dumps({"tip_in_hand_m": TIP.tolist(), "stamps_ns": stamps, "uv": pixels})
    )
    truth = read_truth(recording)
    assert truth is not None
    np.testing.assert_array_equal(truth.tip_hand, TIP)
    assert np.flatnonzero(np.isfinite(truth.pixels[:, 0])).tolist() == [1]
    for text in ("{", '{"tip_in_hand_m": [1, 2]}', '{"tip_in_hand_m": null}'):
        beside.write_text(text)
        message = refusal(lambda: read_truth(recording))
        assert message is not None
        assert message.startswith(str(beside))


def test_two_annotators_give_a_floor(shelf: Path, tmp_path: Path) -> None:
    first = labels_at(tmp_path / "wrist.labels.csv", labelled_pixels())
    other = tmp_path / "wrist.labels.B.csv"
    labels_at(other, labelled_pixels() + np.array([0.6, 0.8]), "B", hidden=2)
    report = evaluate(
        [shelf / "wrist.mcap"], labels=first, out=tmp_path / "r", params=PAPER, curve=False
    )
    labels = report.recordings[0].labels
    assert labels is not None
    assert labels.second == "wrist.labels.B.csv"
    assert labels.annotator_px is not None
    assert labels.annotator_px.count == len(LABELLED) - 2
    assert labels.annotator_px.mean == pytest.approx(1.0, abs=0.01)
    assert labels.disagreements == 2


def test_simulated_labels_are_called_so(shelf: Path, tmp_path: Path) -> None:
    path = labels_at(tmp_path / "wrist.labels.csv", labelled_pixels(), "sim")
    report = evaluate(
        [shelf / "wrist.mcap"], labels=path, out=tmp_path / "r", params=PAPER, curve=False
    )
    labels = report.recordings[0].labels
    assert labels is not None
    assert labels.simulated
    page = Path(report.page).read_text()
    assert "The labels are simulated, not placed by a person." in page


def test_one_bad_recording_among_good_ones_is_a_row(shelf: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"not a log")
    report = evaluate([bad, shelf / "wrist.mcap"], out=tmp_path / "r", params=PAPER, curve=False)
    assert [row.status for row in report.recordings] == ["failed", "ok"]
    assert str(bad) in report.recordings[0].reasons[0].text
    assert report.status == "ok"
    assert "bad" in Path(report.page).read_text()


def test_bad_input_is_one_line_and_leaves_nothing(shelf: Path, tmp_path: Path) -> None:
    wrist, out = shelf / "wrist.mcap", tmp_path / "r"
    foreign = tmp_path / "foreign.csv"
    foreign.write_text("stamp_ns,u,v,state,labeler\n5,1,1,visible,me\n")
    cases = {
        "no recording": refusal(lambda: evaluate([], out=out)),
        "cannot be opened": refusal(lambda: evaluate([tmp_path / "none.mcap"], out=out)),
        "several recordings are called 'wrist'": refusal(
            lambda: evaluate([wrist, tmp_path / "wrist.mcap"], out=out)
        ),
        "another recording": refusal(lambda: evaluate([wrist], labels=foreign, out=out)),
        "labels cannot be read": refusal(
            lambda: evaluate([wrist], labels=tmp_path / "none.csv", out=out)
        ),
        "unknown split": refusal(lambda: evaluate([wrist], split="odd", out=out)),
        "at least one frame": refusal(lambda: evaluate([wrist], train=0, out=out)),
        "none of the 2 recordings": refusal(
            lambda: evaluate([tmp_path / "a.mcap", tmp_path / "b.mcap"], out=out)
        ),
    }
    for expected, message in cases.items():
        assert message is not None, expected
        assert expected in message
        assert "\n" not in message
    assert not out.exists()


def test_an_unwritable_place_is_one_line(shelf: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    message = refusal(lambda: evaluate([shelf / "wrist.mcap"], out=tmp_path / "file" / "r"))
    assert message is not None
    assert "cannot be" in message


# The command line.


def test_the_terminal_summary_and_the_json_agree(shelf: Path) -> None:
    arguments = (
        "evaluate",
        shelf / "wrist.mcap",
        "--out",
        shelf / "report",
        "--method",
        "kmeans",
        "--no-curve",
    )
    shown = tooltip(*arguments)
    assert shown.code == 0
    header, line, last = shown.out.splitlines()
    assert header.split()[0] == "tool"
    assert last == str(shelf / "report" / "index.html")
    document = json.loads(tooltip(*arguments, "--json").out)
    assert (
        document["recordings"]
        == json.loads((shelf / "report" / "report.json").read_text())["recordings"]
    )
    row = document["recordings"][0]
    means = [row[kind]["error_px"]["mean"] for kind in ("detector", "baseline")]
    assert line.split()[0] == "wrist"
    for number in (*(f"{mean:.2f}" for mean in means), f"{row['detector']['tip_error_mm']:.1f}"):
        assert number in line.split()
    assert "\x1b" not in shown.out


def test_a_refusal_exits_with_3(tmp_path: Path) -> None:
    parts = wrist_parts(12)
    parts["images"] = [image_message(stamp_of(i), jpeg_of(0)) for i in range(12)]
    path = write_log(tmp_path / "still.mcap", parts)
    done = tooltip("evaluate", path, "--train", 8, "--test", 4, "--method", "kmeans")
    assert done.code == 3
    assert "refused (no_motion)" in done.out
    assert (tmp_path / "report" / "index.html").exists()


def test_nothing_that_could_be_evaluated_exits_with_1(tmp_path: Path) -> None:
    done = tooltip("evaluate", tmp_path / "none.mcap")
    assert done.code == 1
    assert str(tmp_path / "none.mcap") in done.error


# Statistics.


@settings(deadline=None)
@given(st.lists(st.floats(0, 100), min_size=2, max_size=60), st.integers(0, 5))
def test_the_bootstrap_interval_lies_within_the_errors(errors: list[float], seed: int) -> None:
    interval = bootstrap_interval(np.array(errors), seed, draws=200)
    assert interval is not None
    low, high = interval
    slack = 1e-9 * max(errors)
    assert min(errors) - slack <= low <= high <= max(errors) + slack
    assert bootstrap_interval(np.array([*errors, np.nan]), seed, draws=200) == interval


def test_the_bootstrap_has_the_spread_of_independent_errors() -> None:
    errors = np.random.default_rng(0).normal(10, 3, size=400)
    means = bootstrap_means(errors)
    assert means.mean() == pytest.approx(errors.mean(), abs=0.02)
    assert means.std() == pytest.approx(3 / 20, rel=0.2)


def test_the_bootstrap_knows_that_neighbours_err_alike() -> None:
    alike = np.repeat(np.random.default_rng(1).normal(10, 3, size=50), 8)
    mixed = np.random.default_rng(2).permutation(alike)
    assert bootstrap_means(alike).std() > 1.8 * bootstrap_means(mixed).std()


def test_one_error_has_no_interval_and_none_no_summary() -> None:
    one = summarize(np.array([2.0, np.nan]))
    assert one is not None
    assert (one.count, one.mean, one.low, one.high) == (1, 2.0, None, None)
    assert summarize(np.array([np.nan])) is None


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.08, 0.08), st.integers(0, 50))
def test_the_clock_is_found_among_noisy_labels_with_blunders(offset: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0, 6, 60))

    def project(tip: Array, shift: float) -> Array:
        t = times + shift
        points = np.array([tip_in_camera(0.6 * np.sin(3 * s), 0.5 * np.sin(2 * s + 1)) for s in t])
        return np.asarray(400 * (points + (tip - TIP))[:, :2] / (points + (tip - TIP))[:, 2:])

    labels = project(TIP, offset) + rng.normal(0, 0.3, (60, 2))
    labels[:4] += 40
    fit = fit_clock(project, labels, TIP + 0.004)
    assert fit is not None
    assert fit.offset_s == pytest.approx(offset, abs=max(5 * fit.deviation_s, 1e-3))
    assert fit.error_px <= fit.error_without_px + 1e-3  # distances below 0.1 px weigh alike


def test_the_clock_cannot_be_found_from_nothing() -> None:
    assert fit_clock(lambda tip, shift: np.full((5, 2), np.nan), np.zeros((5, 2)), TIP) is None
    fixed = np.ones((9, 2))
    assert fit_clock(lambda tip, shift: fixed, np.zeros((9, 2)), TIP) is None


# Comparing.


def variant(report: Path, place: Path, scale: float, drop: int = 0) -> Path:
    """Write a copy of a report whose prediction errors are scaled, without some frames."""
    place.mkdir()
    document = json.loads((report / "report.json").read_text())
    (place / "report.json").write_text(json.dumps(document))
    header, *rows = (report / "frames.csv").read_text().splitlines()
    column = header.split(",").index("prediction_error_px")
    changed = [header]
    for row in rows[drop:]:
        cells = row.split(",")
        cells[column] = f"{float(cells[column]) * scale:.4f}"
        changed.append(",".join(cells))
    (place / "frames.csv").write_text("\n".join(changed) + "\n")
    return place


def test_a_change_is_better_worse_or_not_shown(shelf: Path, tmp_path: Path) -> None:
    report = shelf / "report"
    for name, scale, expected in (
        ("half", 0.5, BETTER),
        ("double", 2.0, WORSE),
        ("same", 1.0, SAME),
    ):
        (found,) = compare([report, variant(report, tmp_path / name, scale)])
        (tool,) = found.tools
        assert found.overall is not None
        assert (tool.verdict, found.overall.verdict) == (expected, expected)
        assert tool.before_px is not None
        assert tool.after_px is not None
        assert tool.after_px == pytest.approx(scale * tool.before_px, abs=1e-3)
        assert tool.change_px == pytest.approx(tool.after_px - tool.before_px)
        assert tool.before_mm is not None
        assert (found.overall.before_mm, found.overall.after_mm) == (tool.before_mm, tool.after_mm)


def test_what_cannot_be_paired_is_not_compared(shelf: Path, tmp_path: Path) -> None:
    report = shelf / "report"
    few = variant(report, tmp_path / "few", 0.5, drop=len(LABELLED) - 5)
    (found,) = compare([report, few])
    assert found.tools[0].verdict == NOT_COMPARED
    assert "only 5 frames" in found.tools[0].remark
    assert found.overall is None


def test_compare_names_what_is_wrong(shelf: Path, tmp_path: Path) -> None:
    report = shelf / "report"
    other = tmp_path / "other"
    other.mkdir()
    assert "at least two" in (refusal(lambda: compare([report])) or "")
    assert "no report" in (refusal(lambda: compare([report, other])) or "")
    for text, expected in (("{", "not a report"), ('{"schema": "x"}', "expected the schema")):
        (other / "report.json").write_text(text)
        assert expected in (refusal(lambda: compare([report, other])) or "")
    (other / "report.json").write_text('{"schema": "tooltip-report/1"}')
    assert "make it anew" in (refusal(lambda: compare([report, other])) or "")


def test_the_compare_command_prints_the_same_as_its_json(shelf: Path, tmp_path: Path) -> None:
    pair = [str(shelf / "report"), str(variant(shelf / "report", tmp_path / "half", 0.5))]
    shown = tooltip("compare", *pair)
    document = json.loads(tooltip("compare", *pair, "--json").out)
    assert shown.code == 0
    tool = document[0]["tools"][0]
    line = next(line for line in shown.out.splitlines() if line.startswith("wrist"))
    assert line.endswith(BETTER)
    assert f"{tool['change_px']:+.2f} [{tool['low_px']:+.2f}, {tool['high_px']:+.2f}]" in line


def test_reference_recordings_have_the_baselines_known_for_them(
    reference_data: Path, tmp_path: Path
) -> None:
    """Estimating from labels is below 2.5 px and 3 mm on all three."""
    folder = reference_data / "reference"
    for name in ("pen", "hammer", "bottle"):
        recording = read_recording(folder / f"{name}.mcap")
        views = resolve_views(recording, resolve_rig(recording, folder / f"{name}.rig.yaml"))
        path = folder / f"{name}.labels.csv"
        labels = match_labels(read_labels(path), recording.image_stamps_ns, views.camera)
        found = estimate_from_labels(
            recording, views, labels, EstimatorParams(), out=tmp_path
        ).estimate.position
        truth = read_truth(recording)
        assert found is not None
        assert truth is not None
        tips = project_tip(views, found, labels.visible.frames)
        error = np.linalg.norm(tips - labels.visible.pixels, axis=1)
        assert error.mean() < 2.5
        assert np.linalg.norm(found - truth.tip_hand) < 0.003


def test_a_frame_table_survives_its_file(shelf: Path) -> None:
    _, table = measured(shelf, TIP, None)
    again = table_from_plain(json.loads(json.dumps(plain(table))))
    for name, column in vars(table).items():
        np.testing.assert_array_equal(getattr(again, name), column)
    assert again.stamps_ns.dtype == np.int64
    assert refusal(lambda: table_from_plain({**plain(table), "states": 3})) is not None
