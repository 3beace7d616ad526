"""Moving edges on images whose motion is known, and the noise of images whose noise is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tooltip_cli.method.voting.moving import (
    FrameEdges,
    _Pair,
    halve,
    join,
    moving_edges,
    noise_level,
    smooth,
)
from tooltip_cli.method.voting.params import MovingParams

Image = npt.NDArray[np.uint8]
Step = tuple[int, int]

PARAMS = MovingParams()
SHAPE = (140, 180)
SQUARE = (70, 50, 40)  # left, top, side, pixels
MARGIN = 20  # pixels that a scene goes on outside the image, at least as far as anything moves
HAND = np.array([90.0, 70.0])
EVERYWHERE = 1000.0
NOISE = 1.5


def texture(shape: tuple[int, int], seed: int, grain: float = 2.0) -> Image:
    noise = np.random.default_rng(seed).uniform(0, 255, shape)
    blurred = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.asarray(cv2.normalize(blurred, None, 20, 235, cv2.NORM_MINMAX), dtype=np.uint8)


def noisy(image: Image, sigma: float, seed: int) -> Image:
    noise = np.random.default_rng(seed).normal(0, sigma, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def scene(
    square: Step, background: Step = (0, 0), second: Step | None = None, larger: int = 1
) -> Image:
    """Return a smoothed image whose square and background are shifted by (du, dv).

    Args:
        larger: times that image and square are larger than they are otherwise.
    """
    margin, height, width, left, top, side = (
        larger * pixels for pixels in (MARGIN, *SHAPE, *SQUARE)
    )
    whole = texture((height + 2 * margin, width + 2 * margin), 1)
    u, v = margin - background[0], margin - background[1]
    image: Image = whole[v : v + height, u : u + width].copy()
    u, v = left + square[0], top + square[1]
    image[v : v + side, u : u + side] = texture((side, side), 2)
    if second is not None:  # another one, in the upper left
        u, v = 15 + second[0], 15 + second[1]
        image[v : v + 20, u : u + 20] = texture((20, 20), 3)
    seed = hash((square, background)) % 1000
    return smooth(noisy(image, NOISE, seed), PARAMS)


def find(before: Image, image: Image, after: Image, radius: float = EVERYWHERE) -> FrameEdges:
    return moving_edges(image, (before, after), HAND, radius, NOISE, PARAMS)


def on_square(edges: FrameEdges, margin: int = 3, larger: int = 1) -> npt.NDArray[np.bool_]:
    left, top, side = (larger * pixels for pixels in SQUARE)
    pixels = edges.pixels.astype(int) - (left, top)
    return np.asarray(((pixels >= -margin) & (pixels < side + margin)).all(axis=1))


def assert_empty(edges: FrameEdges) -> None:
    assert edges.pixels.shape == (0, 2)
    assert edges.translations.shape == (0, 2, 2)
    assert edges.covariances.shape == (0, 2, 3)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.5, 6.0])
def test_the_noise_of_still_images_is_recovered(sigma: float) -> None:
    image = texture((120, 160), 4)
    pairs = [(noisy(image, sigma, 2 * i), noisy(image, sigma, 2 * i + 1)) for i in range(4)]
    assert noise_level(pairs) == pytest.approx(sigma, rel=0.15)


@pytest.mark.parametrize("sigma", [1.0, 3.0, 6.0])
def test_what_moves_in_a_third_of_the_image_is_not_noise(sigma: float) -> None:
    first = texture((120, 160), 4)
    second = first.copy()
    second[:, :50] = 255 - first[:, :50]
    # the median moves up with what moves, by less than half
    level = noise_level([(noisy(first, sigma, 1), noisy(second, sigma, 2))])
    assert sigma * 0.9 < level < 1.9 * sigma


def test_noise_is_at_least_the_rounding() -> None:
    image = texture((40, 40), 4)
    assert noise_level([(image, image)]) == 0.5
    assert noise_level([]) == 0.5


@pytest.mark.parametrize("background", [(0, 0), (2, -1), (-3, 2)])
@pytest.mark.parametrize("motion", [(3, 0), (-2, 3)])
def test_exactly_the_square_moves(background: Step, motion: Step) -> None:
    """Shifts of background and square are to the image before; to the one after, the opposite."""
    after, behind = ((-step[0], -step[1]) for step in (motion, background))
    edges = find(scene(motion, background), scene((0, 0)), scene(after, behind))
    # what the square hides in another image changes as well: that far from it, and half a block
    hidden = int(np.abs(np.subtract(motion, background)).max())
    assert on_square(edges, hidden + 3).mean() > 0.99
    inner = on_square(edges, -4)
    assert inner.sum() > 150
    expected = np.array([motion, after])
    exact = (edges.translations[inner] == expected).all(axis=(1, 2))
    assert exact.mean() > 0.95
    shifts = np.array([background, behind], dtype=float)
    corners = np.array([[20, 20, 1], [160, 120, 1]], dtype=float)
    carried = np.einsum("kij,cj->kci", edges.affines, corners)
    np.testing.assert_allclose(carried, corners[None, :, :2] + shifts[:, None], atol=0.25)
    assert (edges.covariances[:, :, [0, 2]] >= PARAMS.alpha - 1e-6).all()


@pytest.mark.parametrize(
    ("level", "motion", "background"),
    [
        (1, (9, -3), (0, 0)),
        (1, (-6, 8), (7, -4)),
        (1, (10, 10), (0, 0)),
        (2, (18, -7), (0, 0)),
        (2, (-5, 13), (15, -9)),  # a camera that turns fast as well
        (2, (-20, 17), (0, 0)),
        (2, (3, 15), (1, 2)),
    ],
)
def test_what_moves_far_is_followed_in_smaller_images(
    level: int, motion: Step, background: Step
) -> None:
    after, behind = ((-step[0], -step[1]) for step in (motion, background))
    image = scene((0, 0), larger=2)
    others = (scene(motion, background, larger=2), scene(after, behind, larger=2))
    edges = moving_edges(image, others, 2 * HAND, EVERYWHERE, NOISE, PARAMS, level)
    hidden = int(np.abs(np.subtract(motion, background)).max())
    assert on_square(edges, hidden + 3, 2).mean() > 0.99
    inner = on_square(edges, -4, 2)
    assert inner.sum() > 600
    exact = (edges.translations[inner] == np.array([motion, after])).all(axis=(1, 2))
    assert exact.mean() > 0.95
    corners = np.array([[40, 40, 1], [320, 240, 1]], dtype=float)
    carried = np.einsum("kij,cj->kci", edges.affines, corners)
    shifts = np.array([background, behind], dtype=float)
    np.testing.assert_allclose(carried, corners[None, :, :2] + shifts[:, None], atol=0.25)
    # whole images alone do not see so far
    lost = moving_edges(image, others, 2 * HAND, EVERYWHERE, NOISE, PARAMS)
    found = (lost.translations[on_square(lost, -4, 2)] == np.array([motion, after])).all((1, 2))
    assert found.mean() < 0.05 if len(found) else True


@pytest.mark.parametrize("level", [1, 2])
def test_what_small_images_cannot_tell_apart_stays_uncertain(level: int) -> None:
    """Along a straight edge a match may lie anywhere in the window, which halving widens."""
    image = np.full((160, 200), 60, dtype=np.uint8)
    image[:, 100:] = 180
    scale = 2**level
    edges = np.array([[100, 80], [100, 90]], dtype=np.int32)
    small = halve(image, level)
    matches = _Pair(image, image, small, small, scale, PARAMS).match(edges)
    assert (matches.translations == 0).all()
    window = np.arange(-(PARAMS.search // 2), PARAMS.search // 2 + 1)
    assert (matches.covariances[:, 2] >= PARAMS.alpha + scale**2 * np.mean(window**2)).all()
    np.testing.assert_allclose(matches.covariances[:, 1], 0, atol=1e-9)
    assert (matches.covariances[:, 0] < 1.5 * scale**2).all()


@pytest.mark.parametrize("shape", [(64, 96), (63, 97)])
def test_pixels_of_halved_images_lie_at_multiples(shape: Step) -> None:
    dot = np.zeros(shape, dtype=np.uint8)
    dot[32, 48] = 255
    image = np.asarray(cv2.GaussianBlur(dot, (0, 0), 2.0) * 20, dtype=np.uint8)
    for times in (0, 1, 2):
        small = halve(image, times)
        assert divmod(int(small.argmax()), small.shape[1]) == (32 >> times, 48 >> times)


def test_edges_count_only_where_the_image_changes() -> None:
    params = replace(PARAMS, change=250.0)
    images = [scene((step, 0)) for step in (3, 0, -3)]
    edges = moving_edges(images[1], (images[0], images[2]), HAND, EVERYWHERE, NOISE, params)
    assert_empty(edges)


def test_all_of_the_square_is_found() -> None:
    """Not only its outline: edges inside it count as well."""
    edges = find(scene((3, 0)), scene((0, 0)), scene((-3, 0)))
    left, top, side = SQUARE
    cells = (edges.pixels[on_square(edges, 0)].astype(int) - (left, top)) // (side // 4)
    assert len(np.unique(cells, axis=0)) == 16


def test_motion_to_one_partner_is_enough() -> None:
    still = scene((0, 0))
    edges = find(still, still, scene((3, 0)))
    inner = on_square(edges, -4)
    assert inner.sum() > 150
    assert (edges.translations[inner, 0] == 0).mean() > 0.95
    assert (edges.translations[inner, 1] == (3, 0)).all(axis=1).mean() > 0.95


@pytest.mark.parametrize("background", [(0, 0), (2, -1)])
def test_nothing_moves_against_the_background(background: Step) -> None:
    behind = (-background[0], -background[1])
    edges = find(scene(background, background), scene((0, 0)), scene(behind, behind))
    assert len(edges.pixels) < 10
    assert np.isfinite(edges.affines).all()


def test_only_what_the_hand_can_reach_counts() -> None:
    images = [scene((step, 0), (0, 0), (0, step)) for step in (3, 0, -3)]
    far = find(images[0], images[1], images[2])
    assert (~on_square(far, 6)).sum() > 40
    near = find(images[0], images[1], images[2], 45.0)
    assert on_square(near, 6).all()
    assert np.linalg.norm(near.pixels - HAND, axis=1).max() < 45
    assert on_square(near).sum() > 150
    assert_empty(find(images[0], images[1], images[2], 0.0))


@pytest.mark.parametrize("level", [0, 128, 255])
def test_darkness_and_flat_images_give_nothing(level: int) -> None:
    flat = np.full(SHAPE, level, dtype=np.uint8)
    edges = find(flat, flat, flat)
    assert_empty(edges)
    assert np.isnan(edges.affines).all()
    images = [smooth(noisy(flat, NOISE, seed), PARAMS) for seed in range(3)]
    assert len(find(images[0], images[1], images[2]).pixels) == 0


def test_a_partner_without_anything_gives_nothing_that_is_not_finite() -> None:
    image, flat = scene((0, 0)), np.full(SHAPE, 90, dtype=np.uint8)
    edges = find(flat, image, flat)
    assert np.isfinite(edges.covariances).all()
    assert np.isfinite(edges.affines).all() or len(edges.pixels) == 0


def test_frames_are_joined_in_order() -> None:
    parts = [find(scene((3, 0)), scene((0, 0)), scene((-3, 0)), radius) for radius in (20, 0, 40)]
    edges = join(np.array([4, 7, 9]), np.array([[1, 6], [2, 8], [3, 11]]), parts)
    assert edges.counts.tolist() == [len(part.pixels) for part in parts]
    assert edges.counts[0] > 0 == edges.counts[1]
    for row, part in enumerate(parts):
        mine = edges.frame_of_edge == row
        np.testing.assert_array_equal(edges.pixels[mine], part.pixels)
        np.testing.assert_array_equal(edges.translations[mine], part.translations)
        np.testing.assert_array_equal(edges.covariances[mine], part.covariances)
        np.testing.assert_array_equal(edges.affines[row], part.affines)
    none = join(np.zeros(0, np.intp), np.zeros((0, 2), np.intp), [])
    assert none.affines.shape == (0, 2, 2, 3)
    assert len(none.frame_of_edge) == 0
