"""What stands before the background, and its outline in every image.

The scene behind the hand hardly changes while the wrist turns, so the median of many images is the
scene without hand and tool, and what differs from it is hand or tool. Unlike moving edges,
silhouettes need neither texture nor motion from one image to the next.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.lighting import evened
from tooltip_cli.method.voting.params import SilhouetteParams

Image = npt.NDArray[np.uint8]

UNKNOWN, BACKGROUND, FOREGROUND = 0, 127, 255
"""Values of a mask, which can so be looked at."""

NOTHING_KNOWN = 255
"""The tolerance of a pixel at which the background was not seen."""

_MASK_WIDTH = 400  # pixels; masks of wider images are stored at half, a third, ... of the size
_BLUR_PX = 0.8  # standard deviation, of image and backdrop before they are compared
_BLUR_SIDE = 5  # pixels; further weights are 0, but would be looked at
_PIXELS_AT_ONCE = 1 << 14  # of all samples, so that they stay close to the processor
_FEW = 3  # samples that show what blurring takes of the noise
_THIN = 8  # rows that one is looked at of
_FAR_OUT = 0.8  # quantile of the differences that shows it
_NOISE_TAKEN = 0.25  # what blurring takes less of is no noise, but things that are displaced
_PLATEAU_PX = 7  # side of the square in which the contrast at an outline is looked up
_NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0))  # rows and columns
_GAUSSIAN_PER_MAD = 1.4826
_MAD_PER_TOLERANCE = 1.3  # a pixel is as it was within this many tolerances


@dataclass(frozen=True)
class Backdrop:
    """The scene without hand and tool, as it is seen from one pose of the camera."""

    colour: Image  # (H, W, C), blurred as images are before they are compared
    tolerance: Image  # (H, W) grey levels by which it may differ, or NOTHING_KNOWN


@dataclass(frozen=True)
class FrameSilhouette:
    """What stands before the background in one image."""

    mask: Image  # (h, w) UNKNOWN, BACKGROUND or FOREGROUND
    scale: int  # pixels of the image that one of the mask stands for, along a side
    contour: npt.NDArray[np.float32]  # (K, 2) u, v of points on its outline, pixels


@dataclass(frozen=True)
class Silhouettes:
    """The same for many images."""

    masks: Image  # (F, h, w)
    scale: int
    counts: npt.NDArray[np.int64]  # (F,) points on each outline
    contours: npt.NDArray[np.float32]  # (K, 2) u, v, frame by frame

    @property
    def row_of_point(self) -> Indices:
        """(K,) row of ``masks`` that each point belongs to."""
        return np.repeat(np.arange(len(self.masks)), self.counts)

    def select(self, rows: npt.NDArray[np.bool_]) -> Silhouettes:
        """Return some of them, (F,) of ``rows``."""
        points = self.contours[rows[self.row_of_point]]
        return Silhouettes(self.masks[rows], self.scale, self.counts[rows], points)


@dataclass(frozen=True)
class HandSilhouettes:
    """Silhouettes with all that is needed to see them from the hand; no lens distorts them."""

    camera_from_hand: Array  # (F, 4, 4) of the silhouettes' images
    masks: Image  # (F, h, w)
    view: Array  # (3, 3) from normalized coordinates to a mask's pixels
    points: Array  # (K, 2) normalized coordinates x/z, y/z of the outlines' points
    rows: Indices  # (K,) silhouette that each belongs to, ascending
    focal_px: float  # ideal pixels of an image per unit of normalized coordinates


def join_silhouettes(parts: Sequence[FrameSilhouette | None]) -> Silhouettes | None:
    """Put the silhouettes of images of one size together; None where one is missing."""
    known = [part for part in parts if part is not None]
    if not known or len(known) < len(parts):
        return None
    return Silhouettes(
        np.stack([part.mask for part in known]),
        known[0].scale,
        np.array([len(part.contour) for part in known], dtype=np.int64),
        np.concatenate([part.contour for part in known]),
    )


def learn_backdrop(samples: Image, params: SilhouetteParams) -> Backdrop:
    """Find the scene without hand and tool: the median of images, and how much each pixel varies.

    Where hand or tool stand in many of the images, or the scene itself changes, nothing is known.

    Args:
        samples: (S, H, W, C) images, all as seen from one pose of the camera; they are brought to
            one brightness in place.
    """
    import cv2

    for sample in samples:
        even = evened(sample, samples[0])
        if even is not sample:
            sample[:] = even
    middle = len(samples) // 2
    colour = _ranked(samples, middle)
    off = np.stack([_largest(cv2.absdiff(sample, colour)) for sample in samples])
    spread = _ranked(off, middle)
    noise = max(float(np.median(spread)), 1.0)
    tolerance = params.tolerance * _GAUSSIAN_PER_MAD * np.maximum(spread, noise)
    tolerance = np.clip(tolerance, params.least_contrast, 254.0)
    # whole numbers are below what their floor is below, and bytes are counted faster
    limit = np.minimum(_MAD_PER_TOLERANCE * tolerance, 255.0).astype(np.uint8)
    counter = np.min_scalar_type(len(off))
    seen = (off <= limit).view(np.uint8).sum(axis=0, dtype=counter) / len(off)
    unknown = (seen < params.min_seen) | (tolerance > params.most_contrast)
    smoothed = _blurred(colour)
    tolerance -= params.tolerance * _GAUSSIAN_PER_MAD * noise * _taken(samples, off, smoothed)
    tolerance = np.maximum(tolerance, params.least_contrast)
    tolerance = np.where(unknown, NOTHING_KNOWN, np.ceil(tolerance))
    return Backdrop(smoothed, tolerance.astype(np.uint8))


def _taken(samples: Image, off: Image, smoothed: Image) -> float:
    """Return the part of the noise that blurring takes, with which images are then compared.

    Args:
        off: (S, H, W) how far the samples (S, H, W, C) are from the scene.
        smoothed: (H, W, C) the scene, blurred.
    """
    import cv2

    few = slice(None, None, max(len(samples) // _FEW, 1))
    # far out, as noise that JPEG makes has long tails; hand and tool cover less than the rest
    left = [
        np.quantile(_largest(cv2.absdiff(_blurred(sample), smoothed))[::_THIN], _FAR_OUT)
        / max(np.quantile(raw[::_THIN], _FAR_OUT), 1.0)
        for sample, raw in zip(samples[few], off[few], strict=True)
    ]
    taken = 1.0 - float(np.median(left))
    return taken if taken > _NOISE_TAKEN else 0.0


def _ranked(samples: Image, rank: int) -> Image:
    """Return ``np.sort(samples, axis=0)[rank]``, bit by bit: counting takes a fifth of the time."""
    flat = samples.reshape(len(samples), -1)
    found = np.zeros(flat.shape[1], np.uint8)
    counter = np.min_scalar_type(len(samples))
    for start in range(0, len(found), _PIXELS_AT_ONCE):
        part, values = flat[:, start : start + _PIXELS_AT_ONCE], found[start:][:_PIXELS_AT_ONCE]
        for bit in (128, 64, 32, 16, 8, 4, 2, 1):
            more = values | np.uint8(bit)
            below = (part < more).view(np.uint8).sum(axis=0, dtype=counter)
            np.copyto(values, more, where=below <= rank)
    return found.reshape(samples.shape[1:])


def silhouette(image: Image, backdrop: Backdrop, params: SilhouetteParams) -> FrameSilhouette:
    """Find what stands before the background in one image.

    Where half of the image seems to, the light has changed, and nothing is known.

    Args:
        image: (H, W, C), from the pose that the backdrop is seen from.
    """
    import cv2

    image = evened(_blurred(image), backdrop.colour)
    contrast = _largest(cv2.absdiff(image, backdrop.colour))
    known = backdrop.tolerance != NOTHING_KNOWN
    stands = _without_specks((contrast > backdrop.tolerance) & known, params.min_area)
    if np.count_nonzero(stands) > params.max_share * stands.size:
        known, stands = np.zeros_like(known), np.zeros_like(stands)
    shown = known.view(np.uint8) * np.uint8(BACKGROUND)  # elsewhere UNKNOWN, which is 0
    mask, scale = _small(np.maximum(shown, stands.view(np.uint8) * np.uint8(FOREGROUND)))
    left, top, width, height = cv2.boundingRect(stands.view(np.uint8))
    if not width:
        return FrameSilhouette(mask, scale, np.zeros((0, 2), np.float32))
    across = slice(max(left - _PLATEAU_PX, 0), left + width + _PLATEAU_PX)
    down = slice(max(top - _PLATEAU_PX, 0), top + height + _PLATEAU_PX)
    contour = _outline(
        contrast[down, across], stands[down, across], known[down, across],
        backdrop.tolerance[down, across],
    )  # fmt: skip
    corner = np.array([across.start, down.start], dtype=np.float32)
    return FrameSilhouette(mask, scale, contour + corner)


def _small(mask: Image) -> tuple[Image, int]:
    """Return a mask of at most a fixed width, and its scale; what is foreground stays so."""
    height, width = mask.shape
    scale = -(-width // _MASK_WIDTH)
    rows, columns = height // scale * scale, width // scale * scale
    lines = functools.reduce(np.maximum, (mask[down:rows:scale] for down in range(scale)))
    parts = (lines[:, right:columns:scale] for right in range(scale))
    return np.ascontiguousarray(functools.reduce(np.maximum, parts)), scale


def _blurred(image: Image) -> Image:
    import cv2

    blurred = cv2.GaussianBlur(image, (_BLUR_SIDE, _BLUR_SIDE), _BLUR_PX)
    return np.asarray(blurred, np.uint8).reshape(image.shape)


def _largest(image: npt.ArrayLike) -> Image:
    """Return (H, W) the largest channel of an image (H, W, C) or (H, W)."""
    import cv2

    array = np.asarray(image, dtype=np.uint8)
    if array.ndim == 2 or array.shape[2] == 1:
        return array.reshape(array.shape[:2])
    first, *others = cv2.split(array)
    for other in others:
        first = cv2.max(first, other)
    return np.asarray(first, dtype=np.uint8)


def _without_specks(stands: npt.NDArray[np.bool_], least: int) -> npt.NDArray[np.bool_]:
    import cv2

    _, parts = cv2.connectedComponentsWithAlgorithm(
        stands.view(np.uint8),
        8,
        cv2.CV_32S,
        cv2.CCL_BBDT,  # the default takes three times as long
    )
    standing = np.flatnonzero(stands)
    part = parts.ravel()[standing]
    kept = np.zeros(stands.shape, dtype=bool)
    kept.ravel()[standing[(np.bincount(part) >= least)[part]]] = True
    return kept


def _outline(
    contrast: Image,
    stands: npt.NDArray[np.bool_],
    known: npt.NDArray[np.bool_],
    tolerance: Image,
) -> npt.NDArray[np.float32]:
    """Return (K, 2) points where the contrast falls to half of what it is inside.

    Between two neighbouring pixels, one inside and one outside, the place is interpolated.
    """
    import cv2

    square = np.ones((_PLATEAU_PX, _PLATEAU_PX), np.uint8)
    plateau = np.asarray(cv2.dilate(contrast, square), dtype=np.float32)
    half = np.maximum(0.5 * plateau, 0.75 * tolerance)
    inner = np.asarray(cv2.erode(stands.view(np.uint8), square)) > 0
    inside = (stands & (contrast > half)) | inner
    closed = cv2.morphologyEx(inside.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inside = np.asarray(closed) > 0
    level = contrast.astype(np.float32)
    height, width = inside.shape
    within, outside = (inside & known)[1:-1, 1:-1], known & ~inside
    crossing = np.stack(
        [
            within & outside[1 + down : height - 1 + down, 1 + right : width - 1 + right]
            for down, right in _NEIGHBOURS
        ]
    )
    # np.nonzero takes ten times as long in three dimensions
    side, v, u = np.unravel_index(np.flatnonzero(crossing), crossing.shape)
    v, u = v + 1, u + 1
    down, right = np.array(_NEIGHBOURS)[side].T
    here, there = level[v, u], level[v + down, u + right]
    part = np.clip((here - half[v, u]) / np.maximum(here - there, 1e-3), 0.0, 1.0)
    return np.stack([u + right * part, v + down * part], axis=1).astype(np.float32)
