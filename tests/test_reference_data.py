"""The whole way on recordings that this project did not make: printed and rendered truth."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.cli import tooltip
from tooltip_cli.labels.files import match_labels, read_labels
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.rig.kinematics import inverse_transform

TOOLS = ("pen", "hammer", "bottle")


def from_labels(recording: Path, labels: Path, rig: Path, method: str, out: Path) -> Any:
    """Estimate through the command line; return the tip file."""
    found = tooltip(
        "estimate",
        recording,
        "--rig",
        rig,
        "--from-labels",
        labels,
        "--method",
        method,
        "--out",
        out,
        "--json",
    )
    assert found.code == 0, found.err
    return json.loads(found.out)


@pytest.mark.parametrize("method", ["map", "voting"])
def test_corners_of_a_printed_board(method: str, reference_data: Path, tmp_path: Path) -> None:
    """Four corners of a board on a real arm: their six distances are the printed ones."""
    folder = reference_data / "charuco_arm"
    printed = json.loads((folder / "charuco_arm.truth.json").read_text())["corners"]
    tips = {}
    for corner in printed:
        document = from_labels(
            folder / "charuco_arm.mcap",
            folder / f"charuco_arm.{corner}.labels.csv",
            folder / "charuco_arm.rig.yaml",
            method,
            tmp_path / corner,
        )
        tips[corner] = np.array(document["tip"]["position_m"])
        assert document["frames_used"] >= 10
    errors = [
        abs(np.linalg.norm(tips[a] - tips[b]) - np.linalg.norm(np.subtract(printed[a], printed[b])))
        for a, b in itertools.combinations(printed, 2)
    ]
    assert len(errors) == 6
    assert max(errors) < 0.001, [f"{1000 * error:.2f} mm" for error in errors]


@pytest.fixture(scope="module", params=TOOLS)
def reference(request: pytest.FixtureRequest, reference_data: Path) -> tuple[str, Path, Recording]:
    """Return a tool's name, its folder and the open recording."""
    folder = reference_data / "reference"
    return request.param, folder, read_recording(folder / f"{request.param}.mcap")


@pytest.mark.parametrize("method", ["kmeans", "map"])
def test_the_label_baseline_of_rendered_tools(
    method: str, reference: tuple[str, Path, Recording], tmp_path: Path
) -> None:
    tool, folder, recording = reference
    document = from_labels(
        folder / f"{tool}.mcap",
        folder / f"{tool}.labels.csv",
        folder / f"{tool}.rig.yaml",
        method,
        tmp_path,
    )
    tip = np.array(document["tip"]["position_m"])
    truth = json.loads((folder / f"{tool}.truth.json").read_text())
    assert np.linalg.norm(tip - truth["tip_in_hand_m"]) < 0.003
    views = resolve_views(recording, resolve_rig(recording, folder / f"{tool}.rig.yaml"))
    labels = match_labels(
        read_labels(folder / f"{tool}.labels.csv"), recording.image_stamps_ns, views.camera
    ).visible
    camera_from_hand = inverse_transform(views.hand_from_camera[labels.frames])
    predicted = views.camera.project(camera_from_hand[:, :3, :3] @ tip + camera_from_hand[:, :3, 3])
    assert np.linalg.norm(predicted - labels.pixels, axis=1).mean() < 2.5


def test_the_true_tip_projects_onto_the_true_pixels(
    reference: tuple[str, Path, Recording],
) -> None:
    """Kinematics, camera, interpolation and stamps together, against an independent renderer."""
    tool, folder, recording = reference
    truth = json.loads((folder / f"{tool}.truth.json").read_text())
    assert recording.image_stamps_ns.tolist() == truth["stamps_ns"]
    views = resolve_views(recording, resolve_rig(recording, folder / f"{tool}.rig.yaml"))
    camera_from_hand = inverse_transform(views.hand_from_camera)
    tips = camera_from_hand[:, :3, :3] @ truth["tip_in_hand_m"] + camera_from_hand[:, :3, 3]
    errors = views.camera.project(tips) - np.array(truth["uv"])
    assert views.known.all()
    # the joints carry an encoder's noise of a fifth of a pixel; a shift would be ours
    assert np.abs(errors.mean(axis=0)).max() < 0.03
    assert errors.std(axis=0).max() < 0.3
    assert np.linalg.norm(errors, axis=1).max() < 1.0
    assert recording.notes == ()


def test_a_real_arm_without_joints_is_not_asked_for_them(reference_data: Path) -> None:
    folder = reference_data / "charuco_arm"
    recording = read_recording(folder / "charuco_arm.mcap")
    assert recording.joints == {}
    views = resolve_views(recording, resolve_rig(recording, folder / "charuco_arm.rig.yaml"))
    assert views.known.all()
    assert len(views.known) == 15
