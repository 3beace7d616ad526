"""Edge points against those of OpenCV, which they must equal point by point."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tooltip_cli.log.recording import read_recording
from tooltip_cli.method.canny import edge_points

Image = npt.NDArray[np.uint8]

try:
    import numba  # noqa: F401  (whether this works is the question)

    FORMS = [False, True]
except ImportError:
    FORMS = [False]

KINDS = ["noise", "smooth", "squares", "soft noise", "ramps", "one level"]


def image_of(kind: str, rng: np.random.Generator, height: int, width: int) -> Image:
    noise = rng.integers(0, 256, (height, width), np.uint8)
    if kind == "noise":
        return noise
    if kind == "smooth":
        coarse = rng.integers(0, 256, (height // 5 + 2, width // 5 + 2), np.uint8)
        return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))
    if kind == "squares":
        squares = rng.integers(0, 2, (height // 7 + 1, width // 7 + 1), np.uint8) * np.uint8(255)
        return np.ascontiguousarray(squares.repeat(7, 0).repeat(7, 1)[:height, :width])
    if kind == "soft noise":
        return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5), np.uint8)
    if kind == "ramps":  # every direction of gradient, at the borders between the directions too
        steps = np.add.outer(
            np.arange(height) * rng.integers(0, 9), np.arange(width) * rng.integers(0, 9)
        )
        return (steps % 256).astype(np.uint8)
    return np.full((height, width), noise[0, 0])


def of_opencv(image: Image, low: float, high: float, margin: int) -> npt.NDArray[np.intp]:
    v, u = np.nonzero(cv2.Canny(image, low, high))
    points = np.stack([u, v], axis=1)
    limit = np.array(image.shape[::-1]) - margin
    return points[((points >= margin) & (points < limit)).all(axis=1)]


@settings(max_examples=300, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 60),
    width=st.integers(1, 90),
    low=st.floats(-10, 300),
    high=st.floats(0, 500),
    margin=st.integers(0, 9),
)
def test_the_points_are_those_of_opencv(
    kind: str, seed: int, height: int, width: int, low: float, high: float, margin: int
) -> None:
    image = image_of(kind, np.random.default_rng(seed), height, width)
    expected = of_opencv(image, low, high, margin)
    for use_numba in FORMS:
        found = edge_points(image, low, high, margin, use_numba=use_numba)
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == np.int32
        assert found.flags.c_contiguous


@pytest.mark.parametrize("use_numba", FORMS)
def test_one_strong_point_keeps_a_long_weak_chain(use_numba: bool) -> None:
    """A winding line, bright at one end only, is followed to the other."""
    image = np.full((99, 99), 100, np.uint8)
    turns = [(x, y) for y in range(8, 92, 12) for x in ((8, 90) if y // 4 % 2 == 0 else (90, 8))]
    cv2.polylines(image, [np.array(turns, np.int32)], False, 120, 3)
    weak = edge_points(image, 40, 400, use_numba=use_numba)
    assert len(weak) == 0
    image[6:9, 4:9] = 255
    chain = edge_points(image, 40, 400, use_numba=use_numba)
    np.testing.assert_array_equal(chain, of_opencv(image, 40, 400, 0))
    assert len(chain) > 500


@pytest.mark.parametrize("use_numba", FORMS)
def test_a_view_into_an_image_is_taken(use_numba: bool) -> None:
    whole = image_of("smooth", np.random.default_rng(3), 50, 120)
    view = whole[5:45, ::2]
    expected = of_opencv(np.ascontiguousarray(view), 50, 100, 2)
    np.testing.assert_array_equal(edge_points(view, 50, 100, 2, use_numba=use_numba), expected)
    assert len(expected) > 50


def test_the_points_of_a_real_recording_are_those_of_opencv(reference_data: Path) -> None:
    recording = read_recording(reference_data / "reference" / "pen.mcap")
    for image in recording.images([0, 250], gray=True):
        for low, high in ((50.0, 150.0), (20.5, 51.25)):
            expected = of_opencv(image, low, high, 7)
            np.testing.assert_array_equal(edge_points(image, low, high, 7), expected)
            assert len(expected) > 1000
