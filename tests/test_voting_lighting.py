"""Images that differ in brightness alone are compared as if they did not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import test_near as near_hand
from tests import test_voting_moving as square
from tests.test_voting_silhouette import PARAMS, learnt, places, shot
from tooltip_cli.method.voting.lighting import Image, dimmed, evened, gain
from tooltip_cli.method.voting.moving import noise_level, smooth
from tooltip_cli.method.voting.silhouette import learn_backdrop, silhouette

GAINS = (0.85, 0.93, 1.08, 1.2)


def brighter(image: Image, factor: float) -> Image:
    return np.clip(np.round(image * factor), 0, 255).astype(np.uint8)


@given(factor=st.floats(0.75, 1.25), seed=st.integers(0, 50), sigma=st.floats(0, 4))
def test_a_gain_is_recovered_whatever_moves_in_a_fifth_of_the_image(
    factor: float, seed: int, sigma: float
) -> None:
    first = square.texture((120, 160), seed) // 2 + 30
    second = first.copy()
    second[:, :32] = 255 - first[:, :32]
    found = gain(square.noisy(brighter(first, factor), sigma, seed), second)
    assert found == pytest.approx(factor, rel=0.03) or abs(factor - 1) < 0.03


@given(seed=st.integers(0, 50), sigma=st.floats(0, 8), step=st.integers(0, 40))
def test_images_that_are_as_bright_stay_as_they_are(seed: int, sigma: float, step: int) -> None:
    whole = square.texture((160, 200), seed)
    first, second = whole[:120, :160], whole[step:, step:][:120, :160]
    first = square.noisy(first, sigma, seed)
    assert evened(first, second) is first


@pytest.mark.parametrize("level", [0, 5, 255])
def test_dark_and_white_images_tell_nothing(level: int) -> None:
    image = np.full((60, 80, 3), level, np.uint8)
    assert gain(image, np.full_like(image, 128)) == 1.0
    assert gain(np.full_like(image, 128), image) == 1.0
    small = image[:4, :4]
    assert evened(small, small // 2) is small


@given(factor=st.floats(0.5, 2.0))
def test_dimming_divides(factor: float) -> None:
    image = np.arange(128, dtype=np.uint8).reshape(8, 16)
    assert np.abs(dimmed(image, factor) - np.minimum(image / factor, 255)).max() <= 0.51
    assert dimmed(image, 1.0) is image


@pytest.mark.parametrize("factor", GAINS)
def test_flicker_is_no_noise(factor: float) -> None:
    image = square.texture((120, 160), 4) // 2 + 30
    pair = square.noisy(image, 2.0, 1), square.noisy(brighter(image, factor), 2.0, 2)
    assert noise_level([pair]) == pytest.approx(2.0, rel=0.3)


@pytest.mark.parametrize("factor", GAINS)
def test_the_square_moves_alone_in_light_that_flickers(factor: float) -> None:
    before, image, after = (square.scene(step) for step in ((-3, 0), (0, 0), (3, 1)))
    steady = square.find(before, image, after)
    found = square.find(brighter(before, factor), image, brighter(after, 1 / factor))
    assert square.on_square(found).mean() > 0.9
    assert len(found.pixels) > 0.8 * len(steady.pixels)


@pytest.mark.parametrize("factor", GAINS)
def test_near_the_hand_as_well(factor: float) -> None:
    first, second = near_hand.scene(), near_hand.scene(slow=(2, 1))
    found = near_hand.near(first, brighter(second, factor), near_hand.AT_SLOW)
    assert near_hand.on(near_hand.SLOW, found)


@pytest.mark.parametrize("factor", GAINS)
def test_outlines_do_not_depend_on_the_light(factor: float) -> None:
    place = (70.0, 60.0)
    steady = silhouette(shot(7, place), learnt(), PARAMS)
    found = silhouette(brighter(shot(7, place), factor), learnt(), PARAMS)
    differs = (found.mask != steady.mask).mean()
    assert differs < 0.02
    assert len(found.contour) == pytest.approx(len(steady.contour), rel=0.2)


def test_a_backdrop_is_learnt_in_light_that_flickers() -> None:
    gains = np.random.default_rng(3).uniform(0.85, 1.15, 25)
    samples = [
        brighter(shot(seed, place), factor)
        for seed, (place, factor) in enumerate(zip(places(25), gains, strict=True))
    ]
    backdrop = learn_backdrop(np.stack(samples), PARAMS)
    assert np.median(backdrop.tolerance) <= np.median(learnt().tolerance) + 2


def test_smoothing_leaves_a_gain_as_it_is() -> None:
    image = square.texture((120, 160), 4) // 2 + 30
    smoothed = [smooth(it, square.PARAMS) for it in (brighter(image, 1.1), image)]
    assert gain(*smoothed) == pytest.approx(1.1, abs=0.01)
