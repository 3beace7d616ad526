"""Matching in time: exact where it can be, silent nowhere."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tooltip_cli.log.sync import bracket, interpolate, interpolate_poses, sorted_unique

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

EPOCHS = [0, 1_700_000_000_000_000_000, -5_000_000_000, 2_147_483_647_000_000_000]
GAP = 100_000_000
SECOND = 1_000_000_000


@st.composite
def clocks(draw: st.DrawFn) -> Stamps:
    """Draw strictly increasing stamps around zero, gaps from a nanosecond to a second."""
    gaps = draw(st.lists(st.integers(1, SECOND), min_size=0, max_size=20))
    return np.concatenate([[0], np.cumsum(gaps)]).astype(np.int64)


queries = st.lists(st.integers(-2 * SECOND, 22 * SECOND), max_size=20).map(
    lambda values: np.array(values, dtype=np.int64)
)


def naive(stamps: Stamps, values: Array, query: int, max_gap: int) -> float:
    """Interpolate one query in whole numbers as far as they go."""
    for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True):
        if stamp == query:
            return float(value)
    rows = list(zip(stamps.tolist(), values.tolist(), strict=True))
    for (t0, v0), (t1, v1) in itertools.pairwise(rows):
        if t0 < query < t1:
            return float("nan") if t1 - t0 > max_gap else v0 + (query - t0) / (t1 - t0) * (v1 - v0)
    return float("nan")


@settings(max_examples=200)
@given(stamps=clocks(), query=queries, data=st.data())
def test_interpolation_equals_the_definition(
    stamps: Stamps, query: Stamps, data: st.DataObject
) -> None:
    exact = data.draw(st.lists(st.sampled_from(stamps.tolist()), max_size=3))
    query = np.concatenate([query, np.array(exact, dtype=np.int64)])
    values = np.array(
        data.draw(st.lists(st.floats(-10, 10), min_size=len(stamps), max_size=len(stamps)))
    )
    found = interpolate(stamps, values, query, GAP)
    wanted = [naive(stamps, values, time, GAP) for time in query.tolist()]
    assert np.allclose(found, wanted, atol=1e-12, rtol=0, equal_nan=True)


@settings(max_examples=100)
@given(
    stamps=clocks(),
    query=queries,
    slope=st.floats(-5, 5),
    start=st.floats(-5, 5),
    epoch=st.sampled_from(EPOCHS),
)
def test_linear_signals_are_exact_at_any_epoch(
    stamps: Stamps, query: Stamps, slope: float, start: float, epoch: int
) -> None:
    values = start + slope * stamps / SECOND
    found = interpolate(stamps + epoch, values, query + epoch, 2 * SECOND)
    inside = (query >= stamps[0]) & (query <= stamps[-1])
    assert np.array_equal(np.isfinite(found), inside)
    wanted = start + slope * query[inside] / SECOND
    assert np.abs(found[inside] - wanted).max(initial=0) < 1e-12 * (1 + 100 * abs(slope))


@settings(max_examples=100)
@given(stamps=clocks(), query=queries, epoch=st.sampled_from(EPOCHS))
def test_the_epoch_changes_nothing_not_even_a_bit(
    stamps: Stamps, query: Stamps, epoch: int
) -> None:
    values = np.sin(np.arange(len(stamps), dtype=float))
    here = interpolate(stamps, values, query, GAP)
    there = interpolate(stamps + epoch, values, query + epoch, GAP)
    assert np.array_equal(here, there, equal_nan=True)


@pytest.mark.parametrize("epoch", EPOCHS)
def test_gaps_and_ends_are_unknown(epoch: int) -> None:
    stamps = epoch + np.array([0, 50, 150, 1150]) * 1_000_000
    times = np.array([-1, 0, 25, 50, 100, 150, 151, 600, 1149, 1150, 1151]) * 1_000_000
    found = interpolate(stamps, np.array([0.0, 1.0, 2.0, 3.0]), epoch + times, GAP)
    nan = np.nan
    expected = [nan, 0.0, 0.5, 1.0, 1.5, 2.0, nan, nan, nan, 3.0, nan]
    assert np.array_equal(found, expected, equal_nan=True)


def test_a_gap_is_bridged_up_to_its_limit_and_no_further() -> None:
    for gap, known in ((GAP, True), (GAP + 1, False)):
        found = interpolate(np.array([0, gap]), np.array([0.0, 1.0]), np.array([gap // 2]), GAP)
        assert np.isfinite(found[0]) == known


def test_a_nanosecond_is_told_apart_at_todays_epoch() -> None:
    stamps = np.array([0, 4]) + EPOCHS[1]
    found = interpolate(stamps, np.array([0.0, 1.0]), stamps[0] + np.arange(5), GAP)
    assert found.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]


def test_one_sample_is_known_at_its_own_time_alone() -> None:
    found = interpolate(np.array([5]), np.array([2.0]), np.array([4, 5, 6]), GAP)
    assert np.array_equal(found, [np.nan, 2.0, np.nan], equal_nan=True)


def test_no_samples_are_never_known() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert np.isnan(interpolate(none, np.zeros(0), np.array([1, 2]), GAP)).all()
    assert interpolate(none, np.zeros((0, 3)), np.array([1, 2]), GAP).shape == (2, 3)
    assert interpolate(np.array([1, 2]), np.zeros(2), none, GAP).shape == (0,)


def test_a_bad_neighbour_does_not_spoil_an_exact_hit() -> None:
    stamps, values = np.array([0, 10, 20]), np.array([np.nan, 1.0, np.nan])
    found = interpolate(stamps, values, np.array([0, 5, 10, 15, 20]), GAP)
    assert np.array_equal(found, [np.nan, np.nan, 1.0, np.nan, np.nan], equal_nan=True)


@settings(max_examples=100)
@given(stamps=clocks(), query=queries)
def test_brackets_surround_their_queries(stamps: Stamps, query: Stamps) -> None:
    before, fraction, valid = bracket(stamps, query, 2 * SECOND)
    assert ((fraction >= 0) & (fraction <= 1)).all()
    low, high = stamps[before], stamps[np.minimum(before + 1, len(stamps) - 1)]
    assert ((low <= query) & (query <= high))[valid].all()
    assert np.array_equal(valid, (query >= stamps[0]) & (query <= stamps[-1]))


@settings(max_examples=200)
@given(values=st.lists(st.integers(-20, 20), max_size=30))
def test_sorting_keeps_the_first_of_equal_stamps(values: list[int]) -> None:
    stamps = np.array(values, dtype=np.int64)
    order, reversals, duplicates = sorted_unique(stamps)
    assert stamps[order].tolist() == sorted(set(values))
    assert [values.index(values[i]) for i in order] == order.tolist()
    assert duplicates == len(values) - len(set(values))
    assert reversals == sum(b < a for a, b in itertools.pairwise(values))


def slerp(first: Array, second: Array, t: float) -> Array:
    """Return first * (first^-1 second)^t, by the relative rotation's axis and angle."""

    def product(a: Array, b: Array) -> Array:
        (av, aw), (bv, bw) = (a[:3], a[3]), (b[:3], b[3])
        return np.array([*(aw * bv + bw * av + np.cross(av, bv)), aw * bw - av @ bv])

    relative = product(np.array([*-first[:3], first[3]]), second)
    relative = relative if relative[3] >= 0 else -relative
    sine = float(np.linalg.norm(relative[:3]))
    if sine < 1e-12:
        return first
    angle = 2 * np.arctan2(sine, relative[3])
    part = np.array([*(np.sin(t * angle / 2) * relative[:3] / sine), np.cos(t * angle / 2)])
    return product(first, part)


components = st.floats(-1, 1)
quaternions = (
    st.tuples(components, components, components, components)
    .filter(lambda q: float(np.linalg.norm(q)) > 0.1)
    .map(lambda q: np.array(q) / np.linalg.norm(q))
)


@settings(max_examples=200)
@given(first=quaternions, second=quaternions, t=st.integers(0, 1000), negated=st.booleans())
def test_rotations_follow_the_great_arc(first: Array, second: Array, t: int, negated: bool) -> None:
    assume(abs(abs(first @ second)) > 1e-3)  # half a turn apart, the arc is not unique
    stamps = np.array([0, 1000]) + EPOCHS[1]
    ends = np.stack([first, -second if negated else second])
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    where, rotation = interpolate_poses(stamps, positions, ends, stamps[:1] + t, GAP)
    assert np.allclose(where[0], np.array([1, 2, 3]) * t / 1000, atol=1e-12)
    assert abs(np.linalg.norm(rotation[0]) - 1) < 1e-12
    # the same rotation, whichever the sign
    assert abs(abs(rotation[0] @ slerp(first, second, t / 1000)) - 1) < 1e-9


def test_a_turn_at_constant_speed_is_interpolated_at_constant_speed() -> None:
    angles = np.linspace(0.0, 3.0, 7)
    rotations = np.stack([0 * angles, np.sin(angles / 2), 0 * angles, np.cos(angles / 2)], axis=1)
    stamps = np.arange(7) * 30_000_000
    query = np.arange(0, 180_000_001, 7_000_000)
    _, found = interpolate_poses(stamps, np.zeros((7, 3)), rotations, query, GAP)
    assert np.allclose(2 * np.arctan2(found[:, 1], found[:, 3]), query / 60_000_000, atol=1e-12)


def test_poses_in_gaps_are_unknown() -> None:
    still = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    where, rotation = interpolate_poses(
        np.array([0, GAP + 1]), np.zeros((2, 3)), still, np.array([-1, 0, 5, GAP + 1]), GAP
    )
    assert np.isnan(where).all(axis=1).tolist() == [True, False, True, False]
    assert np.isnan(rotation).all(axis=1).tolist() == [True, False, True, False]
