"""The whole estimate from edges whose motion is exact, and every reason to refuse one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tests.test_voting_outline import seen as silhouettes_of
from tooltip_cli.method.types import Reason, TipEstimate, refused
from tooltip_cli.method.voting.estimate import (
    METHOD,
    check_motion,
    estimate_by_voting,
    estimate_or_doubt,
    less_sure,
)
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.pairing import pair_frames
from tooltip_cli.method.voting.params import PairingParams, VotingParams, VotingSettings
from tooltip_cli.method.voting.volume import HandEdges, reconstruct

Array = npt.NDArray[np.float64]

SETTINGS = VotingSettings(
    pairing=PairingParams(frames=40), voting=VotingParams(depths=48, coarse=0.01)
)
SPHERES = np.array([[0.0, 0.0, 0.0, 0.05]])
REACH = 0.25
WIDE = np.array([[-0.8, -0.8], [0.8, 0.8]])


def swinging(pitch: float = 0.6, yaw: float = 0.6, roll: float = 0.0, speed: float = 1.0) -> Array:
    phase = speed * np.arange(100) / 18
    angles = [pitch * np.sin(phase), yaw * np.sin(0.7 * phase + 1), roll * np.sin(phase)]
    return poses_of(np.stack(angles, axis=1))


def motion(poses: Array) -> Reason | None:
    return check_motion(pair_frames(poses, FOCAL, SETTINGS.pairing), poses, SETTINGS)


def stick(rng: np.random.Generator, tip: Array, count: int = 60) -> Array:
    """Return points of a stick, 8 mm thick, from inside the hand to the middle of its end."""
    axis = tip / np.linalg.norm(tip)
    along = np.linalg.norm(tip) - np.concatenate(
        [np.zeros(count // 4), rng.uniform(0, 0.16, count - count // 4)]
    )
    across = rng.normal(size=(count, 3))
    across -= (across @ axis)[:, None] * axis
    across *= 0.004 / np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(along[:, None] * axis + across)


def view(
    *tips: Array,
    extent: Array = WIDE,
    reach: float = REACH,
    wrong: float = 0.0,
    speed: float = 1.0,
) -> HandEdges:
    """Return what is seen of sticks, other points of them in each frame; a share moves anyhow."""
    rng = np.random.default_rng(6)
    poses = swinging(speed=speed)
    pairing = pair_frames(poses, FOCAL, SETTINGS.pairing)
    points, moved = [], []
    for frame, partners in zip(pairing.frames, pairing.partners, strict=True):
        there = np.concatenate([stick(rng, tip) for tip in tips])
        seen = [there @ pose[:3, :3].T + pose[:3, 3] for pose in poses[[frame, *partners]]]
        here, before, after = (point[:, :2] / point[:, 2:] for point in seen)
        step = np.stack([before, after], axis=1) + rng.normal(0, 0.2, (len(here), 2, 2)) / FOCAL
        anyhow = here[:, None] + rng.uniform(-5, 5, step.shape) / FOCAL
        points.append(here)
        moved.append(np.where(rng.uniform(size=(len(here), 1, 1)) < wrong, anyhow, step))
    counts = np.array([len(part) for part in points], dtype=np.int64)
    total = int(counts.sum())
    here = np.concatenate(points)
    moving = MovingEdges(
        pairing.frames,
        pairing.partners,
        np.zeros((len(counts), 2, 2, 3)),
        counts,
        np.zeros((total, 2), np.uint16),
        np.zeros((total, 2, 2), np.int8),
        np.tile(np.array([0.25, 0.0, 0.25], dtype=np.float32), (total, 2, 1)),
    )
    still = np.repeat(here[:, None], 2, axis=1)
    return HandEdges(moving, here, np.concatenate(moved), still, poses, FOCAL, extent, reach)


TIP = np.array([0.05, -0.07, 0.16])


def refusal_of(found: TipEstimate) -> str:
    assert found.status == "refused"
    assert found.position is None
    assert found.covariance is None
    assert found.method == METHOD
    assert found.frames_used == 40
    (reason,) = found.reasons
    return reason.code


def check_covariance(covariance: Array | None) -> None:
    assert covariance is not None
    np.testing.assert_array_equal(covariance, covariance.T)
    deviations = np.sqrt(np.linalg.eigvalsh(covariance))
    assert deviations.min() >= SETTINGS.trust.floor
    assert deviations.max() < 0.01


def test_a_hand_that_swings_about_two_axes_shows_the_tip() -> None:
    assert motion(swinging()) is None


@pytest.mark.parametrize(
    ("code", "poses"),
    [
        ("no_motion", swinging(0, 0)),
        ("no_motion", swinging()[:20]),
        ("too_fast", swinging(1.0, 1.0, speed=20)),
        ("depth_unobservable", swinging(0, 0, 1.0)),
        ("depth_unobservable", swinging(0.06, 0.06, 1.0)),
    ],
)
def test_motion_that_cannot_show_the_tip(code: str, poses: Array) -> None:
    reason = motion(poses)
    assert reason is not None
    assert reason.code == code


def test_what_is_too_fast_is_told_how_fast_it_may_be() -> None:
    reason = motion(swinging(1.0, 1.0, speed=20))
    assert reason is not None
    limit = 4 * SETTINGS.pairing.max_displacement_px
    assert f"at most {limit:.0f} can be followed, which only 10 frames keep to" in reason.text
    one_size = replace(SETTINGS, pairing=replace(SETTINGS.pairing, levels=1))
    poses = swinging(1.0, 1.0, speed=5)
    slower = check_motion(pair_frames(poses, FOCAL, one_size.pairing), poses, one_size)
    assert slower is not None
    assert "at most 7 can be followed" in slower.text
    assert motion(poses) is None


@pytest.fixture(scope="module")
def found() -> TipEstimate:
    return estimate_by_voting(view(TIP), SPHERES, SETTINGS)


def test_the_tip_of_a_stick(found: TipEstimate) -> None:
    assert found.status == "ok"
    assert found.reasons == ()
    assert found.frames_used == 40
    assert found.position is not None
    assert np.linalg.norm(found.position - TIP) < 0.005
    (only,) = found.candidates
    assert only.position is found.position
    assert only.support > 0.8
    assert only.axis is not None
    assert only.axis @ TIP / np.linalg.norm(TIP) > np.cos(np.radians(12))


def test_the_covariance_is_one_and_covers_the_error(found: TipEstimate) -> None:
    check_covariance(found.covariance)
    assert found.position is not None
    assert found.covariance is not None
    error = found.position - TIP
    assert error @ np.linalg.inv(found.covariance) @ error < 16  # 0.999 of three dimensions


def test_the_same_again(found: TipEstimate) -> None:
    again = estimate_by_voting(view(TIP), SPHERES, SETTINGS)
    np.testing.assert_array_equal(again.position, found.position)
    np.testing.assert_array_equal(again.covariance, found.covariance)


def test_what_is_unknown_of_the_rig_is_stated_and_said(found: TipEstimate) -> None:
    little, much = 0.001**2 * np.eye(3), np.diag([0.0, 0.0, 0.02**2])
    trust = SETTINGS.trust
    again = less_sure(found, little, trust)
    assert found.covariance is not None
    for covariance in (again.covariance, again.candidates[0].covariance):
        np.testing.assert_allclose(np.asarray(covariance, float), found.covariance + little)
    assert again.reasons == found.reasons == ()
    (reason,) = less_sure(found, much, trust).reasons
    assert reason.code == "uncertain_end"
    assert "20 mm" in reason.text
    assert "clocks and camera" in reason.text
    twice = less_sure(less_sure(found, much, trust), much, trust)
    assert [reason.code for reason in twice.reasons] == ["uncertain_end"]
    nowhere = refused("voting", 3, Reason("no_motion", "still"))
    assert less_sure(nowhere, much, trust) == nowhere


def test_two_ends_are_told_and_the_farther_is_given() -> None:
    other = np.array([-0.09, 0.06, 0.125])
    found = estimate_by_voting(view(other, TIP), SPHERES, SETTINGS)
    assert found.status == "ok"
    (reason,) = found.reasons
    assert reason.code == "ambiguous_end"
    assert len(found.candidates) == 2
    for candidate, tip in zip(found.candidates, (TIP, other), strict=True):
        assert np.linalg.norm(candidate.position - tip) < 0.005
        check_covariance(candidate.covariance)
    assert found.position is found.candidates[0].position
    millimetres = "(" + ", ".join(f"{1000 * x:.0f}" for x in found.candidates[1].position) + ")"
    assert millimetres in reason.text


def test_of_two_ends_the_preferred_one_is_given() -> None:
    second = np.array([-0.08, 0.06, 0.11])
    both = estimate_by_voting(view(TIP, second), SPHERES, SETTINGS)
    assert len(both.candidates) == 2
    for candidate in both.candidates:
        towards = replace(SETTINGS, prefer=tuple(candidate.position))
        found = estimate_by_voting(view(TIP, second), SPHERES, towards)
        np.testing.assert_array_equal(found.position, candidate.position)
        assert len(found.candidates) == 1
        assert found.reasons == ()


def test_an_end_too_short_to_be_named_can_be_preferred() -> None:
    short = np.array([-0.05, 0.03, 0.05])
    edges = view(TIP, short)
    (only,) = estimate_by_voting(edges, SPHERES, SETTINGS).candidates
    assert np.linalg.norm(only.position - TIP) < 0.005
    wanted = estimate_by_voting(edges, SPHERES, replace(SETTINGS, prefer=tuple(short)))
    assert wanted.position is not None
    assert np.linalg.norm(wanted.position - short) < 0.005
    assert wanted.reasons == ()


def test_a_tip_outside_the_image_is_refused() -> None:
    edges = view(TIP)
    poses = edges.camera_from_hand[edges.moving.frames]
    tips = poses[:, :3, :3] @ TIP + poses[:, :3, 3]
    highest = float(np.quantile(tips[:, 1] / tips[:, 2], 0.9))
    # the lower border of the image hides nothing yet, but most tips are above the upper one
    extent = np.array([[-0.8, highest], [0.8, 0.8]])
    assert refusal_of(estimate_by_voting(view(TIP, extent=extent), SPHERES, SETTINGS)) in (
        "out_of_view",
        "inconsistent_views",
    )
    settings = replace(SETTINGS, trust=replace(SETTINGS.trust, min_score=0.0))
    mostly = replace(edges, extent=np.array([[-0.8, highest - 0.03], [0.8, 0.8]]))
    assert refusal_of(estimate_by_voting(mostly, SPHERES, settings)) == "out_of_view"


def test_a_tool_that_reaches_beyond_the_search_is_refused() -> None:
    far = TIP / np.linalg.norm(TIP) * 0.24
    assert refusal_of(estimate_by_voting(view(far, reach=0.2), SPHERES, SETTINGS)) == (
        "beyond_reach"
    )


def test_edges_that_move_anyhow_are_refused() -> None:
    found = estimate_by_voting(view(TIP, wrong=1.0), SPHERES, SETTINGS)
    assert refusal_of(found) == "inconsistent_views"


@pytest.mark.parametrize(("speed", "trusted"), [(1.0, True), (5.0, False)])
def test_fast_motion_must_be_more_consistent(speed: float, trusted: bool) -> None:
    edges = view(TIP, wrong=0.3, speed=speed)
    share = reconstruct(edges, SETTINGS.voting).consistent
    assert share > SETTINGS.trust.min_consistent
    never = replace(SETTINGS.trust, convincing_agreement=1.01)
    for limit, accepted in ((share + 0.05, trusted), (share - 0.05, True)):
        settings = replace(SETTINGS, trust=replace(never, fast_consistent=limit))
        found = estimate_by_voting(edges, SPHERES, settings)
        assert (found.status == "ok") == accepted
        assert accepted or refusal_of(found) == "inconsistent_views"


def test_an_end_on_which_the_images_agree_is_no_clutter() -> None:
    """A camera that turns fast makes much move that is not on the hand, and the end is as sharp."""
    edges = view(TIP, wrong=0.3, speed=5.0)
    strict = replace(SETTINGS.trust, fast_consistent=1.0)
    found = estimate_by_voting(edges, SPHERES, replace(SETTINGS, trust=strict))
    assert found.status == "ok"
    assert found.position is not None
    assert np.linalg.norm(found.position - TIP) < 0.003


def test_silhouettes_show_what_noise_hides_from_votes() -> None:
    edges = view(TIP, wrong=0.8)
    assert reconstruct(edges, SETTINGS.voting).score < SETTINGS.trust.min_score
    assert refusal_of(estimate_by_voting(edges, SPHERES, SETTINGS)) == "inconsistent_views"
    axis = TIP / np.linalg.norm(TIP)
    poses = edges.camera_from_hand[edges.moving.frames]
    outlines = silhouettes_of([(TIP, axis, 0.004, 0.004, 0.16)], poses=poses)
    found = estimate_by_voting(replace(edges, silhouettes=outlines), SPHERES, SETTINGS)
    assert found.status == "ok"
    assert found.position is not None
    assert np.linalg.norm(found.position - TIP) < 0.002


def test_poses_of_other_images_are_refused() -> None:
    edges = view(TIP)
    shifted = replace(edges, camera_from_hand=np.roll(edges.camera_from_hand, 30, axis=0))
    assert refusal_of(estimate_by_voting(shifted, SPHERES, SETTINGS)) == "inconsistent_views"


def test_it_is_said_when_the_images_agree_little() -> None:
    assert not estimate_by_voting(view(TIP), SPHERES, SETTINGS).reasons
    demanding = replace(SETTINGS, trust=replace(SETTINGS.trust, doubtful_agreement=1.01))
    found = estimate_by_voting(view(TIP), SPHERES, demanding)
    assert found.status == "ok"
    assert [reason.code for reason in found.reasons] == ["images_disagree"]
    assert "tooltip calibrate" in found.reasons[0].text


def test_an_end_is_in_doubt_where_the_images_disagree() -> None:
    assert estimate_or_doubt(view(TIP), SPHERES, SETTINGS)[1] is None
    demanding = replace(SETTINGS, trust=replace(SETTINGS.trust, full_agreement=1.01))
    found, doubt = estimate_or_doubt(view(TIP), SPHERES, demanding)
    assert doubt is not None
    assert found.position is not None
    part = doubt.part
    np.testing.assert_array_equal(part.position, found.position)
    np.testing.assert_array_equal(part.axis, found.candidates[0].axis)
    assert part.radius > 0
    only_hand = np.array([[0.0, 0.0, 0.0, 0.2]])
    refusal, nothing = estimate_or_doubt(view(TIP / 4), only_hand, demanding)
    assert refusal.position is None
    assert nothing is None


def test_a_cloud_by_poses_that_are_nearly_right_will_do() -> None:
    demanding = replace(SETTINGS, trust=replace(SETTINGS.trust, full_agreement=1.01))
    edges = view(TIP)
    shifted = edges.camera_from_hand.copy()
    shifted[:, 0, 3] += 0.005
    first, doubt = estimate_or_doubt(replace(edges, camera_from_hand=shifted), SPHERES, demanding)
    assert doubt is not None
    right, again = (estimate_by_voting(edges, SPHERES, SETTINGS, by) for by in (None, doubt.cloud))
    assert first.position is not None
    assert right.position is not None
    assert again.position is not None
    assert np.linalg.norm(again.position - right.position) < 5e-4
    assert np.linalg.norm(first.position - right.position) > 2e-3


def test_it_is_said_when_the_end_is_uncertain() -> None:
    demanding = replace(SETTINGS, trust=replace(SETTINGS.trust, doubtful_std=1e-5))
    found = estimate_by_voting(view(TIP), SPHERES, demanding)
    assert found.status == "ok"
    (reason,) = found.reasons
    assert reason.code == "uncertain_end"
    assert found.covariance is not None
    std = 1000 * np.linalg.eigvalsh(found.covariance)[-1] ** 0.5
    assert f"{std:.0f} mm" in reason.text


def test_no_edges_are_refused() -> None:
    edges = view(TIP)
    empty = replace(
        edges,
        moving=replace(
            edges.moving,
            counts=np.zeros(40, dtype=np.int64),
            pixels=edges.moving.pixels[:0],
            translations=edges.moving.translations[:0],
            covariances=edges.moving.covariances[:0],
        ),
        points=edges.points[:0],
        moved=edges.moved[:0],
        background=edges.background[:0],
    )
    assert refusal_of(estimate_by_voting(empty, SPHERES, SETTINGS)) == "inconsistent_views"


def test_a_hand_without_a_tool_is_refused() -> None:
    found = estimate_by_voting(view(TIP / 4), np.array([[0.0, 0.0, 0.0, 0.2]]), SETTINGS)
    assert refusal_of(found) == "nothing_beyond_the_hand"
