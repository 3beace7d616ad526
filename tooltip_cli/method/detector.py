"""The tip's pixel by motion (paper, 3.1 and appendix A)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import BlockMatches, match_blocks, window_margin
from tooltip_cli.method.canny import edge_points
from tooltip_cli.method.types import Array, TipPixels

Image = npt.NDArray[np.uint8]
Edges = npt.NDArray[np.int32]

FEW_EDGES = "few_edges"  # darkness, fog, a lens cap: too little to match
SINGULAR = "singular_motion"  # the background's motion is not determined by its edges
NO_MOTION = "no_motion"  # nothing moves against the background


@dataclass(frozen=True)
class DetectorParams:
    """Constants of the detector; defaults are the paper's where it gives them."""

    block: int = 5  # pixels (3.1)
    search: int = 11  # pixels (3.1)
    tau: float = 200.0  # grey levels (3.1, footnote 1)
    alpha: float = 0.25  # px^2 (3.1)
    canny_low: float = 50.0  # not in the paper
    canny_high: float = 150.0  # not in the paper
    drop_iterations: int = 6  # not in the paper
    drop_fraction: float = 0.2  # of the remaining edges, each time; not in the paper
    min_edges: int = 20  # fewer are flagged; not in the paper
    min_weight: float = 2.0  # lighter winners are "no motion"; not in the paper


@dataclass(frozen=True)
class EdgeMotion:
    """The weighted edge map of a pair of images.

    The background is fitted to the same edges (B = N), or near the hand to a sample of all.
    """

    edges: Edges  # (N, 2) u, v in the first image, row-major order
    translations: npt.NDArray[np.int32]  # (N, 2) pixels
    covariances: Array  # (N, 3) C_uu, C_uv, C_vv, px^2
    weights: Array  # (N,) Mahalanobis distance to the background motion (it has no unit)
    background: npt.NDArray[np.bool_]  # (B,) edges that the model was fitted to: those it kept
    affine: Array  # (2, 3) A, first to second image


@dataclass(frozen=True)
class TipDetection:
    """The edge that moves most against the background, or why there is none."""

    pixel: Array  # (2,) u, v; NaN when flagged
    weight: float  # 0 when flagged as few_edges or singular_motion, or nothing was weighed
    affine: Array  # (2, 3); NaN when there is no model
    edges: int
    background_edges: int
    flags: tuple[str, ...]


@dataclass(frozen=True)
class Detections:
    """One row per pair of images; a detection belongs to the first image of its pair."""

    frames: npt.NDArray[np.intp]  # (M,) image index
    partners: npt.NDArray[np.intp]  # (M,) image index of the second image
    pixels: Array  # (M, 2); NaN when flagged
    weights: Array  # (M,)
    affines: Array  # (M, 2, 3)
    edges: npt.NDArray[np.int64]  # (M,)
    background_edges: npt.NDArray[np.int64]  # (M,)
    flags: tuple[tuple[str, ...], ...]  # (M,)

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """(M,) rows without a flag."""
        return np.array([not flags for flags in self.flags], dtype=bool)

    def tip_pixels(self) -> TipPixels:
        """Return the unflagged detections."""
        return TipPixels(self.frames, self.pixels, self.weights).select(self.valid)


def find_edges(image: Image, params: DetectorParams) -> Edges:
    """Return the (N, 2) Canny edge points (u, v) that can be matched, in row-major order.

    Args:
        image: (H, W) gray.
    """
    margin = window_margin(params.block, params.search)
    return edge_points(image, params.canny_low, params.canny_high, margin)


def match_edges(first: Image, second: Image, edges: Edges, params: DetectorParams) -> BlockMatches:
    """Find edges (N, 2) of one image (H, W), gray, again in the next."""
    return match_blocks(
        first,
        second,
        edges,
        block=params.block,
        search=params.search,
        tau=params.tau,
        alpha=params.alpha,
    )


def not_asked(step: str) -> None:
    """Nobody wants to know that a step has ended."""


def edge_motion(
    first: Image,
    second: Image,
    edges: Edges,
    params: DetectorParams,
    lap: Callable[[str], None] = not_asked,
) -> EdgeMotion | str:
    """Return the weighted edge map, or the flag that says why there is none.

    Args:
        first: (H, W) gray I_1; ``second``: I_2 of the same shape.
        edges: (N, 2) edge points of ``first``, see `find_edges`.
        lap: told the name of each step when it ends: ``match``, ``fit``.
    """
    if len(edges) < params.min_edges:
        return FEW_EDGES
    matches = match_edges(first, second, edges, params)
    lap("match")
    fit = fit_background(
        edges,
        matches.translations,
        matches.covariances,
        iterations=params.drop_iterations,
        drop_fraction=params.drop_fraction,
    )
    lap("fit")
    if fit is None:
        return SINGULAR
    return EdgeMotion(
        edges, matches.translations, matches.covariances, fit.distances, fit.inliers, fit.model
    )


def detect_tip(
    first: Image,
    second: Image,
    edges: Edges,
    params: DetectorParams,
    lap: Callable[[str], None] = not_asked,
) -> TipDetection:
    """Select the heaviest edge of a pair of images; the first in row-major order of equals.

    Args are those of `edge_motion`.
    """
    motion = edge_motion(first, second, edges, params, lap)
    return no_detection(motion, len(edges)) if isinstance(motion, str) else heaviest(motion, params)


def no_detection(flag: str, edges: int) -> TipDetection:
    """Return why a pair of images with so many edges has no weighted edge map."""
    return TipDetection(np.full(2, np.nan), 0.0, np.full((2, 3), np.nan), edges, 0, (flag,))


def heaviest(motion: EdgeMotion, params: DetectorParams) -> TipDetection:
    """Select the heaviest edge, the first of equals, if it is heavy enough to move."""
    place = int(np.argmax(motion.weights)) if len(motion.weights) else None
    weight = 0.0 if place is None else float(motion.weights[place])
    moving = place is not None and weight >= params.min_weight
    return TipDetection(
        motion.edges[place].astype(float) if moving else np.full(2, np.nan),
        weight,
        motion.affine,
        len(motion.edges),
        int(np.count_nonzero(motion.background)),
        () if moving else (NO_MOTION,),
    )
