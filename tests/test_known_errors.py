"""Known errors go in through files, and `tooltip evaluate` says exactly those, everywhere."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.cli import tooltip
from tests.helpers.logs import (
    angles,
    image_message,
    jpeg_of,
    stamp_of,
    true_pixels,
    wrist_parts,
    write_log,
)
from tests.helpers.robot import CAMERA, RIG, TIP, camera_from_hand
from tooltip_cli.labels.files import TipLabels, write_labels
from tooltip_cli.rig.rigfile import rig_files

Array = npt.NDArray[np.float64]

FRAMES = 60
LABELLED = tuple(range(2, FRAMES - 2, 3))
QUICK = ("--method", "kmeans", "--no-curve", "--json")


def truth() -> bytes:
    """Return the truth as a simulator attaches it."""
    stamps = [stamp_of(frame) for frame in range(FRAMES)]
    document = {"tip_in_hand_m": TIP.tolist(), "stamps_ns": stamps}
    return json.dumps({**document, "uv": true_pixels(FRAMES).tolist()}).encode()


def label(path: Path, offset_px: Array, late_ns: int = 0) -> None:
    """Write the true pixels, moved by a known offset, as a person's labels."""
    stamps = np.array([stamp_of(frame) + late_ns for frame in LABELLED], dtype=np.int64)
    pixels = np.asarray(true_pixels(FRAMES)[list(LABELLED)] + offset_px)
    count = len(LABELLED)
    write_labels(path, TipLabels(stamps, pixels, ("visible",) * count, ("me",) * count))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a recording, exact labels, and a report on it."""
    folder = tmp_path_factory.mktemp("known")
    write_log(folder / "wrist.mcap", wrist_parts(FRAMES), {"truth.json": truth()})
    label(folder / "wrist.labels.csv", np.zeros(2))
    assert tooltip("evaluate", folder / "wrist.mcap", *QUICK).code == 0
    return folder


@pytest.fixture
def folder(evaluated: Path, tmp_path: Path) -> Path:
    """Return a copy of that folder which a test may change."""
    place = tmp_path / "known"
    shutil.copytree(evaluated, place)
    shutil.rmtree(place / "report" / "parts")
    return place


def put(folder: Path, source: str, tip_m: Array) -> None:
    """Put an estimate of our choosing where the stage has stored its own."""
    path = folder / "report" / "tips" / source / "wrist.tip.json"
    document = json.loads(path.read_text())
    document["tip"]["position_m"] = tip_m.tolist()
    document["candidates"][0]["position_m"] = tip_m.tolist()
    path.write_text(json.dumps(document))


def evaluate(folder: Path, *options: object) -> dict[str, Any]:
    """Return the recording's row as the command prints it, which is what it writes."""
    done = tooltip("evaluate", folder / "wrist.mcap", *QUICK, *options)
    assert done.code == 0, done.err
    document = json.loads(done.out)
    assert document == json.loads((folder / "report" / "report.json").read_text())
    row: dict[str, Any] = document["recordings"][0]
    return row


def everywhere(folder: Path, px: float, mm: float) -> None:
    """Check that CSV, LaTeX and page say this error of the estimate from detections."""
    with (folder / "report" / "tools.csv").open(newline="") as file:
        line = next(csv.DictReader(file))
    assert float(line["detector_px_mean"]) == pytest.approx(px, abs=0.03)
    assert float(line["tip_error_mm"]) == pytest.approx(mm, abs=1e-3)
    page = (folder / "report" / "index.html").read_text()
    summary = page[page.index("<tbody>") : page.index("</tbody>")]
    assert f"<td>{mm:.1f}</td>" in summary
    shown = f"{float(line['detector_px_mean']):.2f}"
    assert f"<td>{shown} " in summary
    latex = (folder / "report" / "tools.tex").read_text()
    assert f"& {shown} [" in latex
    assert f"& {mm:.2f} &" in latex


@pytest.mark.parametrize("shift_mm", [(3.0, -4.0, 12.0), (0.0, 25.0, 0.0)])
def test_a_tip_off_by_known_millimetres(folder: Path, shift_mm: tuple[float, ...]) -> None:
    shift = np.array(shift_mm) / 1000
    put(folder, "detections", TIP + shift)
    put(folder, "labels", TIP)
    row = evaluate(folder)
    off = float(np.linalg.norm(shift_mm))
    assert row["detector"]["tip_error_mm"] == pytest.approx(off, abs=1e-9)
    assert row["apart_mm"] == pytest.approx(off, abs=1e-9)
    # the pixels by the robot written out by hand; joints are interpolated between samples
    points = [
        (camera_from_hand(*angles(stamp_of(frame))) @ [*(TIP + shift), 1.0])[:3]
        for frame in LABELLED
    ]
    expected = np.linalg.norm(
        CAMERA.project(np.array(points)) - true_pixels(FRAMES)[list(LABELLED)], axis=1
    )
    assert row["detector"]["error_px"]["mean"] == pytest.approx(expected.mean(), abs=0.03)
    assert row["detector"]["error_px"]["maximum"] == pytest.approx(expected.max(), abs=0.03)
    assert row["shares"]["detection_px"] == pytest.approx(expected.mean(), abs=0.03)
    everywhere(folder, float(expected.mean()), off)
    page = (folder / "report" / "index.html").read_text()
    share = row["shares"]["detection_px"]
    assert f"{share:.1f} px come from detection: they go when labels take the place" in page
    assert row["shares"]["clock_px"] == 0
    assert "The clocks have no share" in page


def test_labels_off_by_known_pixels(folder: Path) -> None:
    """The estimate stands at the true tip, so every frame is off by the labels' offset."""
    label(folder / "wrist.labels.csv", np.array([3.0, -4.0]))
    assert tooltip("evaluate", folder / "wrist.mcap", *QUICK).code == 0
    shutil.rmtree(folder / "report" / "parts")
    put(folder, "detections", TIP)
    put(folder, "labels", TIP)
    row = evaluate(folder)
    for name in ("mean", "median", "rms", "maximum"):
        assert row["detector"]["error_px"][name] == pytest.approx(5.0, abs=0.03)
    assert row["shares"]["label_noise_px"] == pytest.approx(5.0, abs=0.01)
    assert row["shares"]["detection_px"] == pytest.approx(0.0, abs=1e-9)
    with (folder / "report" / "frames.csv").open(newline="") as file:
        errors = [float(frame["prediction_error_px"]) for frame in csv.DictReader(file)]
    np.testing.assert_allclose(errors, 5.0, atol=0.05)
    everywhere(folder, 5.0, 0.0)
    page = (folder / "report" / "index.html").read_text()
    assert "5.0 px remain for calibration and the labels&#39; own noise" in page
    assert "the labels alone lie 5.0 px from the true pixel" in page


def test_two_annotators_apart_by_known_pixels(folder: Path) -> None:
    label(folder / "wrist.labels.other.csv", np.array([0.0, 2.5]))
    row = evaluate(folder)
    assert row["labels"]["annotator_px"]["mean"] == pytest.approx(2.5, abs=0.01)
    assert "differs by 2.5 px on average" in (folder / "report" / "index.html").read_text()


@pytest.mark.parametrize("late_ms", [40, -25])
def test_stamps_late_by_a_known_time(tmp_path: Path, late_ms: int) -> None:
    """The report says how late; the rig with that offset leaves nothing for the clocks."""
    late = late_ms * 1_000_000
    parts = wrist_parts(FRAMES)
    parts["images"] = [image_message(stamp_of(i) + late, jpeg_of(i)) for i in range(FRAMES)]
    write_log(tmp_path / "wrist.mcap", parts)
    label(tmp_path / "wrist.labels.csv", np.zeros(2), late)
    shares = evaluate(tmp_path)["shares"]
    assert shares["clock_offset_ms"] == pytest.approx(-late_ms, abs=0.2)
    assert shares["clock_shown"]
    # exact labels: whatever the baseline is off is the clocks'
    assert shares["clock_px"] > 0.95 * (shares["clock_px"] + shares["calibration_px"])
    page = (tmp_path / "report" / "index.html").read_text()
    assert f"{shares['clock_px']:.1f} px come from synchronisation" in page
    assert f"the labels fit best with {shares['clock_offset_ms']:+.1f} ±" in page
    for name, text in rig_files(replace(RIG, time_offset_s=-late_ms / 1000)).items():
        (tmp_path / name).write_text(text)
    put_right = evaluate(tmp_path, "--rig", tmp_path / "rig.yaml")
    assert put_right["shares"]["clock_offset_ms"] == pytest.approx(0.0, abs=0.2)
    assert put_right["baseline"]["error_px"]["mean"] < 0.1


def test_known_errors_of_all_kinds_add_up(tmp_path: Path) -> None:
    """A tip that is off, labels that are off and late stamps: each share is its own."""
    late, offset = 40_000_000, np.array([3.0, -4.0])
    parts = wrist_parts(FRAMES)
    parts["images"] = [image_message(stamp_of(i) + late, jpeg_of(i)) for i in range(FRAMES)]
    write_log(tmp_path / "wrist.mcap", parts)
    label(tmp_path / "wrist.labels.csv", np.zeros(2), late)
    assert tooltip("evaluate", tmp_path / "wrist.mcap", *QUICK).code == 0
    shutil.rmtree(tmp_path / "report" / "parts")
    tip = TIP + np.array([0.0, 0.025, 0.0])
    put(tmp_path, "detections", tip)
    put(tmp_path, "labels", TIP)
    late_only = evaluate(tmp_path)
    # what a late pose of the robot, written out by hand, is off
    rows = [angles(stamp_of(frame) + late) for frame in LABELLED]

    def pixels(place: Array) -> Array:
        points = [(camera_from_hand(*row) @ [*place, 1.0])[:3] for row in rows]
        return CAMERA.project(np.array(points))

    true = true_pixels(FRAMES)[list(LABELLED)]
    clock = float(np.linalg.norm(pixels(TIP) - true, axis=1).mean())
    total = float(np.linalg.norm(pixels(tip) - true, axis=1).mean())
    shares = late_only["shares"]
    assert shares["total_px"] == pytest.approx(total, abs=0.05)
    assert shares["clock_px"] == pytest.approx(clock, abs=0.1)
    assert shares["detection_px"] == pytest.approx(total - clock, abs=0.1)
    assert shares["calibration_px"] == pytest.approx(0.0, abs=0.1)
    label(tmp_path / "wrist.labels.csv", offset, late)
    shutil.rmtree(tmp_path / "report" / "tips")
    assert tooltip("evaluate", tmp_path / "wrist.mcap", *QUICK).code == 0
    shutil.rmtree(tmp_path / "report" / "parts")
    put(tmp_path, "detections", tip)
    put(tmp_path, "labels", TIP)
    shares = evaluate(tmp_path)["shares"]
    total = float(np.linalg.norm(pixels(tip) - true - offset, axis=1).mean())
    residual = float(np.linalg.norm(pixels(TIP) - true - offset, axis=1).mean())
    assert shares["total_px"] == pytest.approx(total, abs=0.05)
    assert shares["detection_px"] == pytest.approx(total - residual, abs=0.05)
    assert shares["clock_px"] + shares["calibration_px"] == pytest.approx(residual, abs=0.05)
    assert shares["clock_offset_ms"] == pytest.approx(-40, abs=4)
