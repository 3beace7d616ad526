"""Light that flickers, and exposure that the camera changes: one image brighter than another.

Mains lamps beat against the frame rate and automatic exposure follows the hand, so whole images
differ by some percent. What is compared is brought to one brightness first.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]

_STEADY = 0.01  # a gain that differs from one by less is left alone: nothing is lost to rounding
_MOST = 0.3  # one that differs by more is a lamp switched on, which makes all look otherwise
_SURE = 5.0  # nor by less than so many of its standard deviations: the scene may have moved
_ACROSS = 24  # pixels of each row that are looked at, and rows as far apart
_DARKEST, _BRIGHTEST = 16, 250  # grey levels; outside, the ratio of two says little
_FEWEST = 50  # pixels that tell a gain


def gain(image: Image, reference: Image) -> float:
    """Return how many times as bright an image is as another of the same scene; 1: the same.

    Most of both shows the same, so it is the median over pixels from all over.

    Args:
        image: (H, W) or (H, W, C), as ``reference``.
    """
    step = max(image.shape[1] // _ACROSS, 1)
    first, second = (it[step // 2 :: step, step // 2 :: step] for it in (image, reference))
    usable = (np.minimum(first, second) >= _DARKEST) & (np.maximum(first, second) <= _BRIGHTEST)
    ratios = np.divide(first[usable], second[usable], dtype=np.float32)
    count = len(ratios)
    if count < _FEWEST:
        return 1.0
    ranks = [2 * count // 5, count // 2, 3 * count // 5]
    low, middle, high = np.partition(ratios, ranks)[ranks].tolist()
    deviation = 2.5 * (high - low) / count**0.5  # of a median: 1 / (2 density sqrt(count))
    told = max(_STEADY, _SURE * deviation) < abs(middle - 1.0) < _MOST
    return float(middle) if told else 1.0


def evened(image: Image, reference: Image) -> Image:
    """Return an image as bright as another of the same scene; the image itself where it is."""
    return dimmed(image, gain(image, reference))


def dimmed(image: Image, factor: float) -> Image:
    """Return an image so many times darker; the image itself where that is once."""
    import cv2

    if factor == 1.0:
        return image
    return np.asarray(cv2.convertScaleAbs(image, alpha=1.0 / factor), np.uint8).reshape(image.shape)
