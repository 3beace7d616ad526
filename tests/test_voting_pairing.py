"""Frames and partners by the hand's motion, against displacements computed longhand."""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.helpers.scenes import FOCAL, HAND, poses_of
from tooltip_cli.method.voting.pairing import Pairing, farthest_points, pair_frames
from tooltip_cli.method.voting.params import PairingParams

Array = npt.NDArray[np.float64]

PARAMS = PairingParams(frames=40)


def swinging(count: int = 160, speed: float = 1.0) -> Array:
    """Return (count, 4, 4) camera_from_hand of a hand that swings about two axes."""
    phase = speed * np.arange(count) / 25
    angles = np.stack([0.5 * np.sin(phase), 0.5 * np.sin(0.7 * phase + 1), 0 * phase], axis=1)
    return poses_of(angles)


def displacement(first: Array, second: Array) -> float:
    """Return the upper quartile of the probes' motion between two (4, 4) poses, pixels."""
    lengths = []
    for step in product((-1, 0, 1), repeat=3):
        if np.count_nonzero(step) not in (1, 3):
            continue
        probe = PARAMS.probe_radius * np.array(step) / np.linalg.norm(step)
        a, b = (pose[:3, :3] @ probe + pose[:3, 3] for pose in (first, second))
        lengths.append(FOCAL * np.linalg.norm(a[:2] / a[2] - b[:2] / b[2]))
    assert len(lengths) == 14
    return float(np.quantile(lengths, 0.75))


def pair(poses: Array, allowed: npt.NDArray[np.bool_] | None = None) -> Pairing:
    return pair_frames(poses, FOCAL, PARAMS, allowed)


def images_of(pairing: Pairing) -> set[int]:
    return {*pairing.frames.tolist(), *pairing.partners.ravel().tolist()}


@st.composite
def choices(draw: st.DrawFn) -> tuple[Array, npt.NDArray[np.bool_], int]:
    count = draw(st.integers(1, 25))
    whole = st.integers(-3, 3).map(float)  # exact distances, and many of them the same
    features = draw(arrays(np.float64, (count, 3), elements=whole))
    return features, draw(arrays(np.bool_, count)), draw(st.integers(1, 30))


@given(choices())
@settings(max_examples=150, deadline=None)
def test_chosen_points_are_usable_distinct_and_ascending(
    choice: tuple[Array, npt.NDArray[np.bool_], int],
) -> None:
    features, usable, count = choice
    chosen = farthest_points(features, usable, count)
    assert len(chosen) == min(count, int(usable.sum()))
    assert (np.diff(chosen) > 0).all()
    assert usable[chosen].all()


@given(choices())
@settings(max_examples=150, deadline=None)
def test_nothing_left_out_is_farther_than_what_was_chosen_is_apart(
    choice: tuple[Array, npt.NDArray[np.bool_], int],
) -> None:
    features, usable, count = choice
    chosen = farthest_points(features, usable, count)
    others = np.setdiff1d(np.flatnonzero(usable), chosen)
    if len(chosen) < 2 or not len(others):
        return
    points = features[chosen]
    apart = np.linalg.norm(points[:, None] - points, axis=2)[~np.eye(len(points), dtype=bool)]
    gaps = np.linalg.norm(features[others][:, None] - points, axis=2).min(axis=1)
    assert gaps.max() <= apart.min()


@given(choices(), st.integers(0, 30))
@settings(max_examples=100, deadline=None)
def test_what_was_chosen_before_stays_chosen(
    choice: tuple[Array, npt.NDArray[np.bool_], int], some: int
) -> None:
    features, usable, count = choice
    before = farthest_points(features, usable, min(some, count))
    after = farthest_points(features, usable, count, before)
    assert len(after) == min(count, int(usable.sum()))
    assert (np.diff(after) > 0).all()
    assert np.isin(before, after).all()


@given(choices(), st.permutations([0, 1, 2]))
@settings(max_examples=50, deadline=None)
def test_the_order_of_the_features_does_not_matter(
    choice: tuple[Array, npt.NDArray[np.bool_], int], order: list[int]
) -> None:
    features, usable, count = choice
    turned = farthest_points(features[:, order], usable, count)
    assert turned.tolist() == farthest_points(features, usable, count).tolist()


def test_no_partner_moves_nearer_to_the_wanted_displacement() -> None:
    poses = swinging()
    pairing = pair(poses)
    assert len(pairing.frames) == PARAMS.frames
    for frame, partners, moved in zip(
        pairing.frames, pairing.partners, pairing.displacements, strict=True
    ):
        assert partners[0] < frame < partners[1]
        for side, partner, found in zip((-1, 1), partners, moved, strict=True):
            assert abs(partner - frame) <= PARAMS.max_gap
            assert found == pytest.approx(displacement(poses[frame], poses[partner]))
            assert PARAMS.min_displacement_px <= found <= PARAMS.max_displacement_px
            gaps = range(1, PARAMS.max_gap + 1)
            others = [frame + side * gap for gap in gaps if 0 <= frame + side * gap < len(poses)]
            costs = [
                abs(np.log(displacement(poses[frame], poses[other]) / PARAMS.displacement_px))
                for other in others
            ]
            assert abs(np.log(found / PARAMS.displacement_px)) == pytest.approx(min(costs))


def test_the_chosen_frames_cover_the_hands_orientations() -> None:
    poses = swinging()
    every = pair_frames(poses, FOCAL, PairingParams(frames=len(poses))).frames
    few = pair_frames(poses, FOCAL, PairingParams(frames=8)).frames
    assert len(few) == 8
    assert len(every) > 100
    turns = poses[:, :3, :3].reshape(-1, 9)
    reach = np.linalg.norm(turns[every][:, None] - turns[few], axis=2).min(axis=1).max()
    first = np.linalg.norm(turns[every][:, None] - turns[every[:8]], axis=2).min(axis=1).max()
    assert reach < 0.5 * first


def test_images_that_may_not_be_used_are_neither_frames_nor_partners() -> None:
    poses = swinging()
    free = pair(poses)
    allowed = np.ones(len(poses), dtype=bool)
    allowed[[*free.frames[:10], *free.partners[10:20].ravel()]] = False
    pairing = pair(poses, allowed)
    assert len(pairing.frames) == PARAMS.frames
    assert not images_of(pairing) & set(np.flatnonzero(~allowed).tolist())
    assert len(pair(poses, np.zeros(len(poses), dtype=bool)).frames) == 0


def test_images_of_unknown_pose_are_neither_frames_nor_partners() -> None:
    poses = swinging()
    poses[50:70] = np.nan
    poses[100, 0, 3] = np.nan
    pairing = pair(poses)
    assert len(pairing.frames) == PARAMS.frames
    assert not images_of(pairing) & {*range(50, 70), 100}
    assert np.isfinite(pairing.displacements).all()
    assert pairing.fastest_px > 0


def test_a_still_hand_gives_no_frames() -> None:
    pairing = pair(poses_of(np.zeros((60, 3))))
    assert len(pairing.frames) == 0
    assert pairing.partners.shape == (0, 2)
    assert pairing.fastest_px == 0


def test_a_hand_that_is_too_fast_gives_no_frames_and_says_how_fast() -> None:
    angles = np.zeros((60, 3))
    angles[:, 0] = 0.45 * np.arange(60)  # never the same orientation within the longest gap
    poses = poses_of(angles)
    pairing = pair(poses)
    assert len(pairing.frames) == 0
    steps = [displacement(poses[i], poses[i + 1]) for i in range(59)]
    assert pairing.fastest_px == pytest.approx(np.median(steps))
    assert pairing.fastest_px > PARAMS.fastest_px == 4 * PARAMS.max_displacement_px


def both_sides(poses: Array, frame: int, scale: int) -> list[list[float]]:
    """Return the usable displacements to images before and after, longhand, pixels."""
    sides = []
    for step in (-1, 1):
        others = [frame + step * gap for gap in range(1, PARAMS.max_gap + 1)]
        moved = [displacement(poses[frame], poses[i]) for i in others if 0 <= i < len(poses)]
        low, high = scale * PARAMS.min_displacement_px, scale * PARAMS.max_displacement_px
        sides.append([pixels for pixels in moved if low <= pixels <= high])
    return sides


@pytest.mark.parametrize("speed", [2.0, 4.0, 8.0])
def test_images_are_halved_as_often_as_the_motion_needs(speed: float) -> None:
    poses = swinging(80, speed)
    every = PairingParams(frames=len(poses))
    pairing = pair_frames(poses, FOCAL, every)
    assert len(pairing.frames) > 20
    for frame, moved, level in zip(
        pairing.frames, pairing.displacements, pairing.levels, strict=True
    ):
        for lower in range(level):
            assert not all(both_sides(poses, frame, 2**lower))
        scale = 2**level
        for found, usable in zip(moved, both_sides(poses, frame, scale), strict=True):
            costs = [abs(np.log(pixels / (scale * PARAMS.displacement_px))) for pixels in usable]
            assert abs(np.log(found / (scale * PARAMS.displacement_px))) == pytest.approx(
                min(costs)
            )
    left = np.setdiff1d(np.arange(len(poses)), pairing.frames)
    assert not any(all(both_sides(poses, i, 2**level)) for i in left for level in range(3))


def test_twenty_pixels_an_image_are_followed() -> None:
    angles = np.zeros((60, 3))
    angles[:, 0] = 0.22 * np.arange(60)
    pairing = pair(poses_of(angles))
    assert 18 < pairing.fastest_px < 22
    assert len(pairing.frames) == PARAMS.frames
    assert (pairing.levels == 2).all()


def test_where_whole_images_do_smaller_ones_change_nothing() -> None:
    poses = swinging(200, 4.0)
    few, many = PARAMS, PairingParams(frames=len(poses))
    at_most = pair_frames(poses, FOCAL, many)
    assert (at_most.levels > 0).any()  # there are some that only smaller images show
    whole = pair_frames(poses, FOCAL, PairingParams(frames=few.frames, levels=1))
    pairing = pair_frames(poses, FOCAL, few)
    for name in ("frames", "partners", "displacements", "levels"):
        np.testing.assert_array_equal(getattr(pairing, name), getattr(whole, name))
    assert not pairing.levels.any()


def test_frames_of_whole_images_are_kept_before_those_of_smaller_ones() -> None:
    poses = swinging(200, 6.0)
    whole = pair_frames(poses, FOCAL, PairingParams(frames=60, levels=1))
    assert 0 < len(whole.frames) < 60
    pairing = pair_frames(poses, FOCAL, PairingParams(frames=60))
    assert len(pairing.frames) == 60
    assert pairing.frames[pairing.levels == 0].tolist() == whole.frames.tolist()
    assert pairing.levels.max() == 1  # halved once, there are enough


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_images_give_no_frames(count: int) -> None:
    assert len(pair(swinging(count)).frames) == 0


def test_a_hand_behind_the_camera_gives_no_frames() -> None:
    poses = swinging()
    poses[:, 2, 3] = -HAND[2]
    assert len(pair(poses).frames) == 0


def test_a_hand_that_only_shifts_gives_every_frame_once() -> None:
    poses = poses_of(np.zeros((160, 3)))
    poses[:, 0, 3] += 0.1 * np.sin(np.arange(160) / 15)
    pairing = pair(poses)
    assert len(np.unique(pairing.frames)) == len(pairing.frames) == PARAMS.frames
