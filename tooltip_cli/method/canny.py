"""Canny's edge points, the same as OpenCV's in half the time."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from tooltip_cli import machine_code

Image = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.int32]

_ARGUMENTS = "u8* i64 i64 f64 f64 i64 f32* u8* i64* i32* i32*"  # of `_canny_numba.edge_finder`


def edge_points(
    image: Image, low: float, high: float, margin: int = 0, use_numba: bool | None = None
) -> Pixels:
    """Return where ``cv2.Canny(image, low, high)`` is not zero, row by row.

    OpenCV makes an image of the edges, and listing what is not zero in it takes a third of the time
    that finding them takes. Here only what is listed is made.

    Args:
        image: (H, W) uint8.
        low: threshold of the gradient's L1 norm, by Sobel's operator of 3x3, that an edge point
            exceeds.
        high: the same that one point of each chain of them exceeds.
        margin: points nearer to the image's border than this are left out, pixels.
        use_numba: whether to run the compiled form; None takes it where there is one, and OpenCV
            otherwise. Both give exactly the same.

    Returns:
        (N, 2) int32, u, v, pixels.

    Raises:
        ImportError: `use_numba` is True and numba cannot be imported.
    """
    if min(image.shape) <= max(2 * margin, 2):  # too small for the compiled form, or for any point
        use_numba = False
    return machine_code.fast_or_slow(
        lambda: _points_compiled(image, low, high, margin),
        lambda: _points_of_opencv(image, low, high, margin),
        use_numba,
    )


def _points_compiled(image: Image, low: float, high: float, margin: int) -> Pixels:
    find = machine_code.kernel("tooltip_cli.method._canny_numba", "edge_finder", _ARGUMENTS)
    height, width = image.shape
    stride = (width + 9) // 8 * 8
    marks = np.zeros((height + 2) * stride + 8, np.uint8)
    inside = (height - 2 * margin) * (width - 2 * margin)
    points = np.empty((inside + 8, 2), np.int32)  # some are written beyond the last
    count = find(
        np.ascontiguousarray(image),
        height,
        width,
        math.floor(min(low, high)),  # as OpenCV does
        math.floor(max(low, high)),
        margin,
        np.zeros((3, 3, stride), np.float32),
        marks,
        marks.view(np.int64),
        np.empty(height * width + 8, np.int32),
        points,
    )
    return points[:count]


def _points_of_opencv(image: Image, low: float, high: float, margin: int) -> Pixels:
    import cv2

    found = np.asarray(cv2.Canny(image, low, high))
    v, u = np.nonzero(found[margin : len(found) - margin, margin : found.shape[1] - margin])
    points: Pixels = np.stack([u, v], axis=1).astype(np.int32) + np.int32(margin)
    return points
