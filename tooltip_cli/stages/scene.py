"""The scene behind hand and tool, as every image of a recording sees it."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
import numpy.typing as npt

from tooltip_cli.log.views import Views
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.params import SilhouetteParams
from tooltip_cli.method.voting.silhouette import (
    NOTHING_KNOWN,
    Backdrop,
    FrameSilhouette,
    Image,
    learn_backdrop,
    silhouette,
)
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.stages.threads import in_order

Map = npt.NDArray[np.float32]

_MEMORY = 100_000_000  # bytes that all samples may take together
_FEWEST_SAMPLES = 9
_DECODED_AT_ONCE = 4
_STILL_PX = 2.0  # less is what joint encoders make up: turning images by it would blur the scene
_GRID = (33, 25)  # columns and rows at which a camera's turn is computed, the rest interpolated
_OUTSIDE = -1e4  # a pixel that no image has


class ColourImages(Protocol):
    """Images by their indices, such as a recording's."""

    def images(self, indices: Iterable[int]) -> Iterator[Image]:
        """Yield decoded images, (H, W, 3) BGR or (H, W) gray, uint8, of one size."""


class Scene:
    """The scene without hand and tool, learnt from images all over the recording.

    A camera that turns sees it turned: far things are where its rotation puts them. What its
    shift does to near things is not known, and shows as pixels that vary.
    """

    def __init__(
        self,
        pictures: ColourImages,
        views: Views,
        frames: Indices,
        params: SilhouetteParams,
        jobs: int = 1,
    ) -> None:
        """Learn the scene from some of the frames, image indices.

        Args:
            jobs: threads, each of which asks ``pictures`` for images; the scene does not depend
                on them.

        Raises:
            TooltipError: an image cannot be decoded.
        """
        self._pictures, self._views, self._params = pictures, views, params
        self._reference = views.root_from_camera[frames[len(frames) // 2]]
        count = int(_MEMORY / (3 * views.camera.width * views.camera.height))
        count = min(params.samples, max(count, _FEWEST_SAMPLES), len(frames))
        chosen = frames[np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]
        samples = np.empty(0, np.uint8)
        starts = range(0, len(chosen), _DECODED_AT_ONCE)
        seen = in_order(lambda start: self._seen(chosen[start:][:_DECODED_AT_ONCE]), starts, jobs)
        for row, image in enumerate(seen):
            if not row:  # filled in place, as a second copy of so much memory would count
                samples = np.empty((len(chosen), *image.shape), np.uint8)
            samples[row] = image
        self._backdrop = learn_backdrop(samples, params)

    def _seen(self, frames: Indices) -> list[Image]:
        """Return (H, W, C) images as the camera would see them from its reference pose."""
        seen = []
        for index, image in zip(frames, self._pictures.images(frames), strict=True):
            # pixels of the reference, looked up in this image
            turn = self._turn(self._views.root_from_camera[index], self._reference)
            seen.append(_channels(image if turn is None else _looked_up(image, turn)))
        return seen

    def silhouette(
        self, image: Image, root_from_camera: npt.NDArray[np.float64]
    ) -> FrameSilhouette:
        """Return what stands before the scene in an image (H, W, 3) or (H, W).

        Args:
            root_from_camera: (3, 3) how the camera was turned.
        """
        return silhouette(_channels(image), self._seen_from(root_from_camera), self._params)

    def _seen_from(self, root_from_camera: npt.NDArray[np.float64]) -> Backdrop:
        turn = self._turn(self._reference, root_from_camera)
        if turn is None:
            return self._backdrop
        import cv2

        colour = _channels(_looked_up(self._backdrop.colour, turn))
        tolerance = cv2.remap(
            self._backdrop.tolerance, turn, None, cv2.INTER_NEAREST, borderValue=NOTHING_KNOWN
        )
        return Backdrop(colour, np.asarray(tolerance, dtype=np.uint8))

    def _turn(
        self, root_from_there: npt.NDArray[np.float64], root_from_here: npt.NDArray[np.float64]
    ) -> Map | None:
        """Return (H, W, 2) where each pixel seen from here is in the image from there.

        None: where it is here.
        """
        return turn_map(self._views.camera, root_from_there.T @ root_from_here)


def turn_map(camera: CameraModel, there_from_here: npt.NDArray[np.float64]) -> Map | None:
    """Return (H, W, 2) pixels u, v of an image from a turned camera; None: nothing has moved.

    Args:
        there_from_here: (3, 3) rotation between the camera's two orientations.
    """
    here, directions = _grid(camera)
    there = camera.project(directions @ there_from_here.T)
    if np.nanmax(np.abs(there - here)) < _STILL_PX:
        return None
    coarse = np.nan_to_num(there, nan=_OUTSIDE).astype(np.float32)
    columns, rows = _GRID
    down, across = _linear(rows, camera.height), _linear(columns, camera.width)
    return np.stack([down @ coarse[..., axis] @ across.T for axis in (0, 1)], axis=-1)


@functools.lru_cache(maxsize=4)
def _grid(camera: CameraModel) -> tuple[Array, Array]:
    """Return (R, C, 2) pixels all over an image and (R, C, 3) their viewing directions."""
    columns, rows = _GRID
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    )
    pixels = np.stack([u, v], axis=-1)
    return pixels, camera.directions(pixels)


def _linear(count: int, size: int) -> Map:
    """Return (size, count) weights of so many evenly spread values at each of so many places."""
    place = np.linspace(0, count - 1, size, dtype=np.float32)
    return np.asarray(np.maximum(1 - np.abs(place[:, None] - np.arange(count)), 0), np.float32)


def _looked_up(image: Image, turn: Map) -> Image:
    import cv2

    return np.asarray(
        cv2.remap(image, turn, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def _channels(image: Image) -> Image:
    """Return (H, W, C)."""
    return image.reshape(*image.shape[:2], -1)
