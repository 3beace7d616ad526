"""The scene behind hand and tool, and outlines before it: exact discs before a textured wall."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tooltip_cli.method.voting.params import SilhouetteParams
from tooltip_cli.method.voting.silhouette import (
    _BLUR_PX,
    BACKGROUND,
    FOREGROUND,
    NOTHING_KNOWN,
    UNKNOWN,
    Backdrop,
    FrameSilhouette,
    _blurred,
    join_silhouettes,
    learn_backdrop,
    silhouette,
)

Image = npt.NDArray[np.uint8]

PARAMS = SilhouetteParams()
SIZE = (160, 120)  # width, height
RADIUS = 14.3
FINE = 16  # drawn at so many times the size, so that edges lie between pixels


def wall(channels: int = 3, size: tuple[int, int] = SIZE) -> npt.NDArray[np.float64]:
    rng = np.random.default_rng(0)
    coarse = rng.uniform(60, 160, (size[1] // 8, size[0] // 8, channels)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), float).reshape(
        size[1], size[0], channels
    )


def shot(
    seed: int,
    centre: tuple[float, float] | None = None,
    background: npt.NDArray[np.float64] | None = None,
    colour: float = 230.0,
    noise: float = 2.0,
) -> Image:
    """Return an image of a disc before a wall, with the sensor's noise."""
    background = wall() if background is None else background
    height, width, channels = background.shape
    image = background.copy()
    if centre is not None:
        cover = np.zeros((height * FINE, width * FINE), np.float32)
        at = tuple(round((value + 0.5) * FINE - 0.5) for value in centre)
        cv2.circle(cover, at, round(RADIUS * FINE), 1.0, -1)
        cover = cv2.resize(cover, (width, height), interpolation=cv2.INTER_AREA)
        image = image + (colour - image) * cover[..., None]
    noisy = image + np.random.default_rng(seed).normal(0, noise, (height, width, channels))
    return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8)


def places(count: int) -> list[tuple[float, float]]:
    rng = np.random.default_rng(5)
    return [(float(u), float(v)) for u, v in rng.uniform((30, 30), (130, 90), (count, 2))]


def learnt(channels: int = 3) -> Backdrop:
    background = wall(channels)
    samples = [shot(seed, place, background) for seed, place in enumerate(places(25))]
    return learn_backdrop(np.stack(samples), PARAMS)


@pytest.mark.parametrize("channels", [1, 3])
def test_an_outline_lies_on_the_disc(channels: int) -> None:
    backdrop = learnt(channels)
    off = []
    for seed, place in enumerate(places(12)):
        found = silhouette(shot(100 + seed, place, wall(channels)), backdrop, PARAMS)
        off.append(np.linalg.norm(found.contour - place, axis=1) - RADIUS)
        share = (found.mask == FOREGROUND).sum() / (np.pi * RADIUS**2)
        assert 0.95 < share < 1.35
    distances = np.concatenate(off)
    assert abs(np.median(distances)) < 0.15
    assert np.quantile(np.abs(distances), 0.95) < 0.8


def test_an_empty_scene_has_no_outline() -> None:
    found = silhouette(shot(7), learnt(), PARAMS)
    assert not (found.mask == FOREGROUND).any()
    assert (found.mask == BACKGROUND).mean() > 0.95
    assert len(found.contour) == 0


def test_nothing_is_known_where_something_mostly_stands() -> None:
    there = (80.0, 60.0)
    others = places(9)
    samples = [shot(seed, there) for seed in range(14)]
    samples += [shot(20 + seed, place) for seed, place in enumerate(others)]
    backdrop = learn_backdrop(np.stack(samples), PARAMS)
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    middle = np.hypot(columns - there[0], rows - there[1]) < RADIUS - 2
    # the background may be wrong there, but never where it was mostly seen
    assert (backdrop.tolerance[~middle] != NOTHING_KNOWN).mean() > 0.9
    moved = silhouette(shot(50), backdrop, replace(PARAMS, min_seen=0.9))
    assert moved.mask.shape == (SIZE[1], SIZE[0])
    strict = learn_backdrop(np.stack(samples), replace(PARAMS, min_seen=0.7))
    assert (strict.tolerance[middle] == NOTHING_KNOWN).mean() > 0.95


def test_a_pixel_that_flickers_is_not_foreground() -> None:
    samples = np.stack([shot(seed) for seed in range(25)])
    rng = np.random.default_rng(1)
    samples[:, 10:20, 10:20] = rng.integers(0, 256, (25, 1, 1, 3))
    backdrop = learn_backdrop(samples, PARAMS)
    image = shot(60)
    image[10:20, 10:20] = 255
    found = silhouette(image, backdrop, PARAMS)
    assert (found.mask[10:20, 10:20] == UNKNOWN).all()


def test_where_the_light_changed_nothing_is_known() -> None:
    brighter = np.clip(shot(3, (60.0, 50.0)).astype(int) + 60, 0, 255).astype(np.uint8)
    found = silhouette(brighter, learnt(), PARAMS)
    assert (found.mask == UNKNOWN).all()
    assert len(found.contour) == 0


def test_specks_are_left_out() -> None:
    image = shot(4, (60.0, 50.0))
    image[100:103, 140:143] = 255
    found = silhouette(image, learnt(), PARAMS)
    assert (found.mask[95:108, 135:148] != FOREGROUND).all()
    assert (found.mask == FOREGROUND).any()


def test_a_wide_image_has_a_small_mask_that_loses_nothing() -> None:
    size = (1000, 200)
    background = wall(3, size)
    backdrop = learn_backdrop(np.stack([shot(seed, None, background) for seed in range(9)]), PARAMS)
    image = shot(30, None, background)
    image[50:90, 400:402] = 255  # two pixels wide
    found = silhouette(image, backdrop, PARAMS)
    assert found.scale == 3
    assert found.mask.shape == (66, 333)
    assert (found.mask[17:29, 133] == FOREGROUND).all()


def test_images_are_blurred_as_by_all_weights() -> None:
    """The weights that are left out are 0."""
    image = np.random.default_rng(2).integers(0, 256, (60, 81, 3), np.uint8)
    np.testing.assert_array_equal(_blurred(image), cv2.GaussianBlur(image, (0, 0), _BLUR_PX))


def test_silhouettes_are_joined_and_chosen_from() -> None:
    parts = [
        FrameSilhouette(np.full((4, 5), row, np.uint8), 2, np.full((row, 2), row, np.float32))
        for row in range(4)
    ]
    joined = join_silhouettes(parts)
    assert joined is not None
    assert joined.row_of_point.tolist() == [1, 2, 2, 3, 3, 3]
    some = joined.select(np.array([False, True, False, True]))
    assert some.counts.tolist() == [1, 3]
    assert some.contours[:, 0].tolist() == [1, 3, 3, 3]
    assert some.masks[:, 0, 0].tolist() == [1, 3]
    assert join_silhouettes([*parts, None]) is None
    assert join_silhouettes([]) is None
