"""Edges that move against the background, near the hand (3.1, applied to every edge)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.affine import fit_background, mahalanobis
from tooltip_cli.method.blocks import BlockMatches, match_blocks, window_margin
from tooltip_cli.method.canny import edge_points
from tooltip_cli.method.types import Array, Indices, Mask
from tooltip_cli.method.voting.lighting import evened
from tooltip_cli.method.voting.params import MovingParams
from tooltip_cli.method.voting.silhouette import FrameSilhouette, Silhouettes, join_silhouettes

Image = npt.NDArray[np.uint8]

_FLAT = 20  # fewer edges than this cannot tell the background's motion
_CHANGE_REACH = 5  # pixels around a change within which its edge lies


@dataclass(frozen=True)
class MovingEdges:
    """Moving edges of many frames, frame by frame, with their motion to two partners."""

    frames: Indices  # (F,) image indices
    partners: Indices  # (F, 2) image indices
    affines: Array  # (F, 2, 2, 3) background motion to each partner; NaN: no model
    counts: npt.NDArray[np.int64]  # (F,) edges of each frame
    pixels: npt.NDArray[np.uint16]  # (E, 2) u, v
    translations: npt.NDArray[np.int8]  # (E, 2, 2) du, dv to each partner, pixels
    covariances: npt.NDArray[np.float32]  # (E, 2, 3) C_uu, C_uv, C_vv to each partner, px^2
    silhouettes: Silhouettes | None = None  # of the same frames; None: the scene behind is unknown

    def of_frames(self, frames: Indices) -> MovingEdges:
        """Return the edges of some of the frames, image indices."""
        kept = np.isin(self.frames, frames)
        edge = kept[self.frame_of_edge]
        return MovingEdges(
            self.frames[kept],
            self.partners[kept],
            self.affines[kept],
            self.counts[kept],
            self.pixels[edge],
            self.translations[edge],
            self.covariances[edge],
            None if self.silhouettes is None else self.silhouettes.select(kept),
        )

    def in_order(self) -> MovingEdges:
        """Return the same with each frame's edges row by row: sums of them come out the same."""
        rows, columns = self.pixels[:, 1].astype(np.int64), self.pixels[:, 0]
        place = self.frame_of_edge << 32 | rows << 16 | columns
        if (place[1:] > place[:-1]).all():  # as they are found
            return self
        edge = np.argsort(place, kind="stable")
        return replace(
            self,
            pixels=self.pixels[edge],
            translations=self.translations[edge],
            covariances=self.covariances[edge],
        )

    @property
    def frame_of_edge(self) -> Indices:
        """(E,) row of ``frames`` that each edge belongs to."""
        return np.repeat(np.arange(len(self.frames)), self.counts)


@dataclass(frozen=True)
class FrameEdges:
    """The same for one frame."""

    affines: Array  # (2, 2, 3)
    pixels: npt.NDArray[np.uint16]
    translations: npt.NDArray[np.int8]
    covariances: npt.NDArray[np.float32]
    silhouette: FrameSilhouette | None = None


def join(frames: Indices, partners: Indices, parts: list[FrameEdges]) -> MovingEdges:
    """Put the frames' edges together."""
    return MovingEdges(
        frames,
        partners.reshape(-1, 2),
        np.array([part.affines for part in parts], dtype=float).reshape(-1, 2, 2, 3),
        np.array([len(part.pixels) for part in parts], dtype=np.int64),
        np.concatenate([np.zeros((0, 2), np.uint16), *(part.pixels for part in parts)]),
        np.concatenate([np.zeros((0, 2, 2), np.int8), *(part.translations for part in parts)]),
        np.concatenate([np.zeros((0, 2, 3), np.float32), *(part.covariances for part in parts)]),
        join_silhouettes([part.silhouette for part in parts]),
    )


def noise_level(pairs: list[tuple[Image, Image]]) -> float:
    """Estimate the standard deviation of the sensor noise from pairs of neighbouring images.

    Most pixels of a pair show the same thing, so the median absolute difference is noise.

    Returns:
        Grey levels; at least half of one, which is rounding.
    """
    import cv2

    levels = []
    for first, second in pairs:
        difference = np.asarray(cv2.absdiff(first, evened(second, first)))
        # the median of integers is too coarse at low noise: interpolate its histogram
        share = np.cumsum(np.bincount(difference.ravel(), minlength=2)) / difference.size
        level = int(np.searchsorted(share, 0.5))
        below = share[level - 1] if level else 0.0
        median = level - 0.5 + (0.5 - below) / max(share[level] - below, 1e-12)
        levels.append(1.4826 * max(median, 0.0) / np.sqrt(2))
    return float(max(np.median(levels), 0.5)) if levels else 0.5


def smooth(image: Image, params: MovingParams) -> Image:
    """Return the image blurred against noise."""
    import cv2

    return np.asarray(cv2.GaussianBlur(image, (0, 0), params.blur_px), dtype=np.uint8)


def halve(image: Image, times: int) -> Image:
    """Return the image halved so often; pixel (u, v) lies at 2^times (u, v) in what is given."""
    import cv2

    for _ in range(times):
        image = np.asarray(cv2.pyrDown(image), dtype=np.uint8)
    return image


def canny_thresholds(noise: float, params: MovingParams) -> tuple[int, int]:
    """Return the thresholds of edges in smoothed images; Canny takes whole numbers.

    Args:
        noise: of the raw images, grey levels.
    """
    low = params.canny_low * max(noise, 1.0)
    return math.floor(low), math.floor(low * params.canny_ratio)


def image_edges(
    image: Image, thresholds: tuple[int, int], params: MovingParams
) -> npt.NDArray[np.int32]:
    """Find the edges of one image (H, W) gray, smoothed; (N, 2) u, v, row by row."""
    margin = window_margin(params.block, params.search)
    return np.array(edge_points(image, *thresholds, margin))  # without the room for more


def moving_edges(
    image: Image,
    others: tuple[Image, Image],
    hand_pixel: Array,
    hand_radius_px: float,
    noise: float,
    params: MovingParams,
    level: int = 0,
    edges: npt.NDArray[np.int32] | None = None,
    steady: bool = False,
) -> FrameEdges:
    """Find the edges of one image that move against the background to either partner.

    Args:
        image: (H, W) gray, smoothed; ``others``: its partners, likewise.
        hand_pixel: (2,) where the hand's origin projects.
        hand_radius_px: how far from there the tool can reach.
        noise: of the raw images, grey levels.
        level: how often images are halved for the motion to fit the search window; matches that
            are found there are made exact on the whole images.
        edges: (N, 2) u, v, where they are known, see `image_edges`.
        steady: whether the images are known to be equally bright.
    """
    if edges is None:
        edges = image_edges(image, canny_thresholds(noise, params), params)
    scale = 2**level
    if level:
        edges = _inside(
            edges, scale * window_margin(params.block, params.search) + scale // 2, image
        )
    affines = np.full((2, 2, 3), np.nan)
    if len(edges) < _FLAT:
        return _nothing(affines)
    differs = np.zeros(image.shape, dtype=bool)
    sample = every_so_many(edges, params.background_edges)
    if not steady:
        others = (evened(others[0], image), evened(others[1], image))
    small = halve(image, level)
    pairs = [_Pair(image, other, small, halve(other, level), scale, params) for other in others]
    for side, (other, pair) in enumerate(zip(others, pairs, strict=True)):
        matches = pair.match(sample)
        fit = fit_background(sample, matches.translations, matches.covariances)
        if fit is None:
            return _nothing(affines)
        affines[side] = fit.model
        differs |= changed(image, other, fit.model, noise, params)
    edges = within(on_mask(differs, edges), hand_pixel, hand_radius_px)
    found = [pair.match(edges) for pair in pairs]
    weights = [
        mahalanobis(model, edges, match.translations, match.covariances)
        for model, match in zip(affines, found, strict=True)
    ]
    moving = np.maximum(*weights) > params.min_weight
    return FrameEdges(
        affines,
        edges[moving].astype(np.uint16),
        np.stack([match.translations[moving] for match in found], axis=1).astype(np.int8),
        np.stack([match.covariances[moving] for match in found], axis=1).astype(np.float32),
    )


def _inside(edges: npt.NDArray[np.int32], margin: int, image: Image) -> npt.NDArray[np.int32]:
    """Return the edges (N, 2) that are at least so many pixels inside an image's border."""
    height, width = image.shape
    least, most = edges.min(axis=1), np.array([width, height]) - margin
    return np.compress((least >= margin) & (edges < most).all(axis=1), edges, axis=0)


def on_mask(mask: Mask, edges: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Return the edges (N, 2) at which a mask (H, W) is true."""
    place = edges[:, 1] * mask.shape[1] + edges[:, 0]  # in all pixels, row by row
    # a mask as an index takes ten times as long with rows of two
    return np.compress(mask.ravel().take(place), edges, axis=0)


def within(edges: npt.NDArray[np.int32], pixel: Array, radius_px: float) -> npt.NDArray[np.int32]:
    """Return the edges (N, 2) that are less than so far from a pixel (2,)."""
    du, dv = edges[:, 0] - pixel[0], edges[:, 1] - pixel[1]
    return np.compress(du * du + dv * dv < radius_px**2, edges, axis=0)


def every_so_many(edges: npt.NDArray[np.int32], count: int) -> npt.NDArray[np.int32]:
    """Return about ``count`` of the edges (N, 2), evenly spread over their order."""
    return np.ascontiguousarray(edges[:: max(len(edges) // count, 1)])


@dataclass(frozen=True)
class _Pair:
    """An image and a partner, whole and so small that the motion fits the search window."""

    image: Image
    other: Image
    small_image: Image
    small_other: Image
    scale: int  # of the whole ones to the small ones
    params: MovingParams

    def match(self, edges: npt.NDArray[np.int32]) -> BlockMatches:
        """Find the edges again: roughly in the small images, and about there in the whole ones.

        Of several matches that the small images could not tell apart, the whole ones see one only.
        So its covariance is that of both, but for the part that all matches have.
        """
        scale, alpha = self.scale, self.params.alpha
        at = (edges + scale // 2) // scale
        rough = self._match(self.small_image, self.small_other, at, self.params.search)
        if scale == 1:
            return rough
        about = scale * rough.translations
        exact = self._match(self.image, self.other, edges, 2 * scale + 1, about)
        unsure = scale**2 * (rough.covariances - alpha * np.array([1.0, 0.0, 1.0]))
        return replace(exact, covariances=exact.covariances + unsure)

    def _match(
        self,
        image: Image,
        other: Image,
        edges: npt.NDArray[np.int32],
        search: int,
        offsets: npt.NDArray[np.int32] | None = None,
    ) -> BlockMatches:
        params = self.params
        return match_blocks(
            image,
            other,
            edges,
            block=params.block,
            search=search,
            tau=params.tau,
            alpha=params.alpha,
            offsets=offsets,
        )


def changed(
    image: Image, other: Image, model: Array, noise: float, params: MovingParams
) -> npt.NDArray[np.bool_]:
    """Return (H, W) where smoothed images differ after the background's motion is undone."""
    import cv2

    height, width = image.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=float)
    shift = corners @ model.T - corners[:, :2]
    if np.abs(shift).max() > 0.25:  # a still background needs no resampling, which blurs
        other = np.asarray(
            cv2.warpAffine(
                other,
                model,
                (width, height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            ),
            dtype=np.uint8,
        )
    difference = cv2.blur(cv2.absdiff(image, other), (3, 3))
    spread = cv2.dilate(difference, np.ones((_CHANGE_REACH, _CHANGE_REACH), np.uint8))
    least = min(max(params.change, 2.0 * noise), 255.0)
    return np.asarray(spread > np.uint8(least))  # whole numbers exceed it as they do its floor


def _nothing(affines: Array) -> FrameEdges:
    return FrameEdges(
        affines,
        np.zeros((0, 2), np.uint16),
        np.zeros((0, 2, 2), np.int8),
        np.zeros((0, 2, 3), np.float32),
    )
