"""Which frames train and which test: never both, never more than there are, always said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tooltip_cli.errors import TooltipError
from tooltip_cli.method.evaluation import (
    Split,
    pixel_errors,
    split_by_labels,
    split_frames,
    summarize,
)

kinds = st.sampled_from(["random", "blocks"])
counts = st.integers(1, 700)
sizes = st.integers(1, 500)


def assert_sound(split: Split, count: int) -> None:
    assert not set(split.train) & set(split.test)
    for part in (split.train, split.test):
        assert (np.diff(part) > 0).all()
        assert ((part >= 0) & (part < count)).all()


@settings(max_examples=200)
@given(count=counts, train=sizes, test=sizes, seed=st.integers(0, 99), kind=kinds)
def test_splits_are_sound(count: int, train: int, test: int, seed: int, kind: str) -> None:
    split = split_frames(count, train, test, seed, kind)
    assert_sound(split, count)
    assert split.kind == kind
    assert split.seed == seed
    if count >= train + test:
        assert (len(split.train), len(split.test)) == (train, test)
        assert split.notes == ()
    else:
        assert len(split.train) + len(split.test) == count
        assert len(split.test) >= 1
        assert len(split.train) <= train
        assert len(split.test) <= test
        (note,) = split.notes
        assert f"asked for {train} training and {test} test frames" in note
        assert f"give {len(split.train)} and {len(split.test)}" in note


@pytest.mark.parametrize("kind", ["random", "blocks"])
def test_the_papers_split(kind: str) -> None:
    split = split_frames(500, kind=kind)
    assert (len(split.train), len(split.test)) == (400, 100)
    assert split.notes == ()


@pytest.mark.parametrize("kind", ["random", "blocks"])
def test_seeds_decide(kind: str) -> None:
    first, again, other = (split_frames(500, seed=seed, kind=kind) for seed in (0, 0, 1))
    assert np.array_equal(first.test, again.test)
    assert np.array_equal(first.train, again.train)
    assert not np.array_equal(first.test, other.test)


def test_a_random_split_is_spread_over_the_recording() -> None:
    test = split_frames(500).test
    assert len(np.flatnonzero(np.diff(test) == 1)) < 40
    assert test.min() < 25
    assert test.max() > 475


@settings(max_examples=100)
@given(count=st.integers(2, 600), test=st.integers(1, 120), seed=st.integers(0, 50))
def test_blocks_are_contiguous(count: int, test: int, seed: int) -> None:
    split = split_frames(count, 5 * test, test, seed, "blocks")
    runs = np.split(split.test, np.flatnonzero(np.diff(split.test) != 1) + 1)
    assert len(runs) <= 5
    assert min(len(run) for run in runs) >= len(split.test) // 5


def test_shrinking_keeps_the_proportion() -> None:
    split = split_frames(100)
    assert (len(split.train), len(split.test)) == (80, 20)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"kind": "halves"}, "unknown split 'halves'; known: blocks, random"),
        ({"train": 0}, "at least one frame on each side"),
        ({"test": 0}, "at least one frame on each side"),
        ({"test": -5}, "at least one frame on each side"),
    ],
)
def test_impossible_splits(arguments: dict[str, int | str], expected: str) -> None:
    with pytest.raises(TooltipError, match=expected):
        split_frames(100, **arguments)  # type: ignore[arg-type]  # on purpose


@settings(max_examples=100)
@given(
    count=st.integers(1, 300),
    labelled=st.lists(st.integers(0, 299), max_size=60),
    train=sizes,
    seed=st.integers(0, 20),
)
def test_labelled_frames_test_and_never_train(
    count: int, labelled: list[int], train: int, seed: int
) -> None:
    frames = np.array([frame for frame in labelled if frame < count], dtype=np.intp)
    split = split_by_labels(count, frames, train, seed)
    assert_sound(split, count)
    assert set(split.test) == set(frames.tolist())
    assert len(split.train) == min(train, count - len(split.test))
    assert split.kind == "labels"
    assert bool(split.notes) == (len(split.train) < train)


def test_training_beside_labels_is_drawn_by_the_seed() -> None:
    labelled = np.arange(0, 500, 5)
    first, again, other = (split_by_labels(500, labelled, 300, seed) for seed in (0, 0, 1))
    assert np.array_equal(first.train, again.train)
    assert not np.array_equal(first.train, other.train)


def test_pixel_errors_are_distances() -> None:
    predicted = np.array([[0.0, 0.0], [3.0, 4.0], [np.nan, 0.0]])
    found = pixel_errors(predicted, np.zeros((3, 2)))
    assert np.array_equal(found, [0.0, 5.0, np.nan], equal_nan=True)


def test_summaries_leave_out_what_is_unknown() -> None:
    errors = np.array([4.0, np.nan, 0.0, 2.0, np.inf])
    summary = summarize(errors)
    assert summary is not None
    assert (summary.count, summary.mean, summary.median) == (3, 2.0, 2.0)
    assert summary.maximum == 4.0
    assert abs(summary.rms - np.sqrt(20 / 3)) < 1e-12
    assert abs(summary.p95 - 3.8) < 1e-12
    assert summary.low is not None
    assert summary.high is not None
    assert 0.0 <= summary.low <= 2.0 <= summary.high <= 4.0
    assert summarize(np.array([np.nan])) is None
    alone = summarize(np.array([1.0]))
    assert alone is not None
    assert alone.low is None
