"""The scene behind the hand, seen by a camera that stands and by one that turns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.helpers.cli import tooltip
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.voting.params import SilhouetteParams
from tooltip_cli.method.voting.silhouette import FOREGROUND, UNKNOWN
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import rotation_from_rpy
from tooltip_cli.stages.moving import hand_in_image
from tooltip_cli.stages.scene import Scene, turn_map

FRAMES = 60
CAMERAS = {
    "plain": CameraModel(320, 240, 300.0, 310.0, 158.0, 121.0, "plumb_bob", (0.0,) * 5),
    "distorted": CameraModel(
        320, 240, 300.0, 310.0, 158.0, 121.0, "plumb_bob", (-0.3, 0.1, 0.001, -0.002, 0.0)
    ),
    "fisheye": CameraModel(
        320, 240, 150.0, 150.0, 160.0, 120.0, "equidistant", (0.02, -0.01, 0.0, 0.0)
    ),
}


@pytest.mark.parametrize("name", list(CAMERAS))
def test_a_far_point_is_looked_up_where_it_is(name: str) -> None:
    camera = CAMERAS[name]
    rng = np.random.default_rng(2)
    for angles in np.radians(rng.uniform(-4, 4, (5, 3))):
        there_from_here = rotation_from_rpy(angles)
        turn = turn_map(camera, there_from_here)
        assert turn is not None
        pixels = rng.integers((40, 40), (280, 200), (50, 2))
        there = camera.project(camera.directions(pixels) @ there_from_here.T)
        found = turn[pixels[:, 1], pixels[:, 0]]
        assert np.abs(found - there).max() < 0.1


def test_a_camera_that_turns_by_encoder_noise_looks_nothing_up() -> None:
    assert turn_map(CAMERAS["distorted"], rotation_from_rpy((1e-3, 0.0, -1e-3))) is None


def simulated(path: Path, *options: object) -> tuple[Recording, Views]:
    done = tooltip(
        "record", "sim", path, "--tool", "screwdriver", "--frames", FRAMES, "--size", "320x240",
        *options,
    )  # fmt: skip
    assert done.code == 0, done.err
    recording = read_recording(path)
    return recording, resolve_views(recording, resolve_rig(recording, None))


@pytest.mark.parametrize("head_deg", [0, 2])
def test_only_hand_and_tool_stand_out(tmp_path: Path, head_deg: int) -> None:
    recording, views = simulated(tmp_path / "a.mcap", "--head-motion", head_deg)
    frames = np.arange(FRAMES)
    turned = views.root_from_camera[0].T @ views.root_from_camera
    angles = np.degrees(np.arccos(np.clip((np.trace(turned.transpose(1, 2, 0)) - 1) / 2, -1, 1)))
    assert (angles.max() > 1.0) == (head_deg > 0)
    scene = Scene(recording, views, frames, SilhouetteParams())
    seen = zip(recording.images(frames), views.root_from_camera, strict=True)
    found = [scene.silhouette(image, turned) for image, turned in seen]
    hand, _ = hand_in_image(views, frames, 0.1)
    v, u = np.mgrid[:240, :320]
    near = [np.hypot(u - x, v - y) < 0.35 * 320 for x, y in hand]
    inside = [(item.mask == FOREGROUND)[at].mean() for item, at in zip(found, near, strict=True)]
    outside = [(item.mask == FOREGROUND)[~at].mean() for item, at in zip(found, near, strict=True)]
    assert np.median(inside) > 0.005
    assert np.median(outside) < 0.003
    unknown = np.mean([(item.mask == UNKNOWN).mean() for item in found])
    assert unknown < 0.2
    (image,) = recording.images([7])
    scene = Scene(recording, views, frames, SilhouetteParams())
    again = scene.silhouette(image, views.root_from_camera[7])
    np.testing.assert_array_equal(again.mask, found[7].mask)
    np.testing.assert_array_equal(again.contour, found[7].contour)
