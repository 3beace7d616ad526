"""Clocks and cameras that are wrong by known amounts, found from outlines drawn exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.scenes import FOCAL, poses_of
from tests.test_voting_refine import AXIS, FRAMES, TIP, seen
from tooltip_cli.method.types import Correction, Refinement
from tooltip_cli.method.voting.calibrate import Seen, calibrate
from tooltip_cli.method.voting.params import CalibrationParams, RefineParams
from tooltip_cli.method.voting.sight import near_edges
from tooltip_cli.rig.kinematics import Mount

Array = npt.NDArray[np.float64]

PARAMS, REFINE = CalibrationParams(), RefineParams()
TURN, STEP = np.array([0.010, -0.012, 0.008]), np.array([0.003, -0.003, 0.002])


def poses_at(offset: float, seed: int) -> Array:
    """Return smooth motion at 15 Hz, some 60 degrees about each axis, shifted by an offset."""
    rng = np.random.default_rng(seed)
    times = np.arange(FRAMES) / 15 + offset
    angles = np.zeros((FRAMES, 3))
    for _ in range(3):
        rate, phase = rng.uniform(0.8, 2.5, 3), rng.uniform(0, 6, 3)
        angles += 0.35 * np.sin(rate * times[:, None] + phase)
    return poses_of(angles)


def recording(offset: float, correction: Correction, seed: int) -> Seen:
    """Return a bar seen by a camera that is off, with stamps that are late by an offset."""
    true_poses = correction.corrected_from_camera @ poses_at(offset, seed)
    hand, cloud = seen([(TIP, AXIS, 0.006, 0.006)], seed, views=true_poses)
    said = replace(hand, camera_from_hand=poses_at(0.0, seed))
    near = near_edges(said, cloud, TIP, REFINE)
    return Seen(near, lambda shift: poses_at(shift, seed), TIP, AXIS, 0.006)


def mean_error_px(one: Seen, found: Correction, truth: Correction, offset: float) -> float:
    """Return how far the true tip projects from where it is seen, by the found correction."""
    pixels = []
    for correction, shift in ((found, found.time_offset), (truth, offset)):
        at = correction.corrected_from_camera @ one.poses_at(shift) @ np.array([*TIP, 1.0])
        pixels.append(FOCAL * at[:, :2] / at[:, 2:3])
    return float(np.linalg.norm(pixels[0] - pixels[1], axis=1).mean())


@pytest.mark.parametrize("offset", [-0.03, 0.0, 0.012, 0.03])
def test_a_clock_offset_is_found(offset: float) -> None:
    found = calibrate([recording(offset, Correction(), 3)], False, PARAMS, REFINE)
    assert found is not None
    assert found.correction.time_offset == pytest.approx(offset, abs=0.0015)
    assert found.correction.rotation is None
    assert found.applied is (offset != 0.0)  # a plain bool: it goes into JSON
    assert 0 < found.deviations[0] < 0.002


def test_a_clock_offset_shared_by_two_recordings() -> None:
    both = [recording(0.02, Correction(), seed) for seed in (4, 5)]
    one = calibrate(both[:1], False, PARAMS, REFINE)
    two = calibrate(both, False, PARAMS, REFINE)
    assert one is not None
    assert two is not None
    assert two.correction.time_offset == pytest.approx(0.02, abs=0.001)
    assert two.deviations[0] < one.deviations[0]


def test_a_camera_that_is_off_is_put_right() -> None:
    truth = Correction(0.02, TURN, STEP)
    one = recording(0.02, truth, 6)
    found = calibrate([one], True, PARAMS, REFINE)
    assert found is not None
    assert found.applied
    assert found.correction.rotation is not None
    assert found.correction.time_offset == pytest.approx(0.02, abs=0.0015)
    assert found.support_after > found.support_before + PARAMS.camera_gain
    before = mean_error_px(one, Correction(), truth, 0.02)
    assert mean_error_px(one, found.correction, truth, 0.02) < 0.4 * before


def test_a_camera_that_is_right_is_left_alone() -> None:
    found = calibrate([recording(0.0, Correction(), 7)], True, PARAMS, REFINE)
    assert found is not None
    assert found.correction.rotation is None
    assert not found.applied


@pytest.mark.parametrize("camera", [False, True])
@pytest.mark.parametrize("off", [False, True])
def test_what_stays_unknown_of_the_rig_is_said_of_the_tip(camera: bool, off: bool) -> None:
    truth = Correction(0.02, TURN, STEP) if off and camera else Correction()
    one, other = (recording(truth.time_offset, truth, seed) for seed in (11, 12))
    found = calibrate([one, other], camera, PARAMS, REFINE)
    assert found is not None
    assert len(found.tip_covariances) == 2
    for covariance in found.tip_covariances:
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
        largest = float(np.linalg.eigvalsh(covariance)[-1] ** 0.5)
        # a camera that is a little farther off looks like a tool that is a little longer
        assert (1e-4 < largest < 1e-3) if camera else (largest < 5e-5)


@pytest.mark.parametrize(
    ("supports", "tried", "best"),
    [
        ([(0.3, 0.8)], 1, 0.8),
        ([(0.3, 0.6), (0.2, 0.5)], 2, 0.6),
        ([(0.3, 0.5), (0.2, 0.6)], 2, 0.6),
        ([(0.6, 0.59), (0.58, 0.57)], 2, 0.59),  # nothing to put right
        ([(0.3, 0.1), (0.2, 0.6)], 2, 0.6),
        ([(0.3, 0.2), (0.2, 0.1)], 2, 0.2),
        ([(0.6, 0.4), (0.2, 0.45)], 2, 0.45),  # but less than without any correction
        ([(0.3, 0.5), (0.6, 0.55)], 2, 0.5),  # the other one corrects nothing
        ([None, (0.2, 0.6)], 2, 0.6),
    ],
)
def test_wider_ends_are_tried_until_enough_fits(
    supports: list[tuple[float, float] | None],
    tried: int,
    best: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    radii: list[float] = []

    def solved(recordings: list[Seen], *_: object) -> Refinement | None:
        radii.append(recordings[0].radius)
        support = supports[len(radii) - 1]
        if support is None:
            return None
        return Refinement(Correction(), np.ones(1), support[1] > support[0], *support)

    monkeypatch.setattr("tooltip_cli.method.voting.calibrate._calibrated", solved)
    found = calibrate([recording(0.0, Correction(), 3)], False, PARAMS, REFINE)
    assert found is not None
    assert found.support_after == best
    solved_first = next(pair for pair in supports if pair is not None)
    assert found.support_before == solved_first[0]
    assert found.applied == (found.support_after > found.support_before)
    assert radii == [0.006, 0.012][:tried]


def test_no_end_is_no_calibration() -> None:
    one = recording(0.0, Correction(), 8)
    assert calibrate([replace(one, position=-TIP)], True, PARAMS, REFINE) is None


numbers = st.floats(-3.0, 3.0)


@given(st.lists(numbers, min_size=3, max_size=3), st.lists(numbers, min_size=3, max_size=3))
def test_a_correction_is_a_rigid_motion(rotation: list[float], translation: list[float]) -> None:
    forth = Correction(0.0, np.array(rotation), np.array(translation)).corrected_from_camera
    turned = forth[:3, :3]
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turned) == pytest.approx(1.0)
    angle = np.linalg.norm(rotation)
    assert np.trace(turned) == pytest.approx(1.0 + 2.0 * np.cos(angle), abs=1e-9)
    np.testing.assert_allclose(turned @ rotation, rotation, atol=1e-9)


@given(
    st.tuples(numbers, st.sampled_from([-np.pi / 2, np.pi / 2]) | st.floats(-1.5, 1.5), numbers),
    st.tuples(numbers, numbers, numbers),
)
def test_a_mount_at_a_pose_has_that_pose(
    rpy: tuple[float, float, float], xyz: tuple[float, float, float]
) -> None:
    pose = Mount("base", xyz, rpy).parent_from_camera
    again = Mount.at("base", pose).parent_from_camera
    np.testing.assert_allclose(again, pose, atol=1e-7)
