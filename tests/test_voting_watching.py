"""The live verdict on the motion says what the estimate will say afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.helpers.robot import CAMERA, camera_from_hand
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.estimate import check_motion
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.watching import ENOUGH, SLOWER, TILT, WAITING, MotionWatch, Verdict
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.sources.sim import MOTIONS, SimParams
from tooltip_cli.stages.simulate import record_simulation
from tooltip_cli.stages.voting import pair_views

FOCAL = 600.0


def sweep(frames: int, speed: float, tilt: float) -> Array:
    """Return (N, 4, 4) poses that roll about the line of sight and tilt out of the image plane."""
    times = np.arange(frames) / 30
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for i, t in enumerate(times):
        a, b = np.sin(2 * np.pi * 0.3 * speed * t), tilt * np.sin(2 * np.pi * 0.17 * speed * t)
        roll = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        pitch = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        poses[i, :3, :3] = pitch @ roll
    poses[:, :3, 3] = (0.0, 0.0, 0.5)
    return poses


def watched(poses: Array) -> MotionWatch:
    watch = MotionWatch(FOCAL, VotingSettings())
    for i, pose in enumerate(poses):
        watch.add(pose, i / 30)
    return watch


def test_a_good_sweep_becomes_enough_and_stays_so() -> None:
    watch = watched(sweep(400, 0.5, 0.8))
    first = watch.judge()
    assert first.code == ENOUGH
    assert watch.ample
    for i, pose in enumerate(sweep(60, 20.0, 0.8)):
        watch.add(pose, 100 + i / 30)
    assert watch.judge().code == ENOUGH


def test_a_verdict_grows_with_the_motion() -> None:
    poses = sweep(400, 0.5, 0.8)
    watch = MotionWatch(FOCAL, VotingSettings())
    verdicts: list[Verdict] = []
    for i, pose in enumerate(poses):
        watch.add(pose, i / 30)
        if i % 30 == 0:
            verdicts.append(watch.judge())
    codes = [verdict.code for verdict in verdicts]
    assert codes[0] != ENOUGH
    assert codes[-1] == ENOUGH
    assert codes[codes.index(ENOUGH) :] == [ENOUGH] * (len(codes) - codes.index(ENOUGH))
    assert not np.any(np.diff([verdict.frames for verdict in verdicts]) < 0)


@pytest.mark.parametrize(
    ("speed", "tilt", "code"),
    [(0.5, 0.0, TILT), (8.0, 0.8, SLOWER), (0.001, 0.8, "keep_going")],
)
def test_advice_names_what_is_missing(speed: float, tilt: float, code: str) -> None:
    watch = watched(sweep(300, speed, tilt))
    assert watch.judge().code == code
    assert not watch.ample


def test_nothing_is_known_before_the_first_pose() -> None:
    watch = MotionWatch(FOCAL, VotingSettings())
    assert watch.judge().code == WAITING
    watch.add(np.full((4, 4), np.nan), 0.0)
    assert watch.judge().code == WAITING


def test_images_from_the_past_are_ignored() -> None:
    watch = watched(sweep(10, 1, 1))
    before = watch.judge()
    watch.add(np.eye(4), 0.0)
    assert watch.judge() == before


def test_memory_is_bounded() -> None:
    watch = MotionWatch(CAMERA.fx, VotingSettings())
    for i in range(10_000):
        watch.add(camera_from_hand(0.0, 0.0), i / 30)
    assert len(watch._poses) == len(watch._times) < 2000


@pytest.mark.parametrize("motion", MOTIONS)
def test_it_agrees_with_the_estimate_on_simulated_motions(motion: str, tmp_path: Path) -> None:
    out = tmp_path / "sim.mcap"
    record_simulation(SimParams(tool="pen", frames=150, size=(160, 120), motion=motion), out)
    recording = read_recording(out)
    views = resolve_views(recording, resolve_rig(recording, None))
    settings = VotingSettings()
    pairing, poses = pair_views(views, settings, views.known)
    refused = check_motion(pairing, poses, settings) is not None
    watch = MotionWatch(float(np.sqrt(views.camera.fx * views.camera.fy)), settings)
    for stamp_ns, pose in zip(
        views.stamps_ns, inverse_transform(views.hand_from_camera), strict=True
    ):
        watch.add(pose, int(stamp_ns) / 1e9)
    assert (watch.judge().code == ENOUGH) == (not refused)
