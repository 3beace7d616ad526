"""The tip's pixel by motion, looked for near the hand alone (3.1 but for which edges are weighed).

The paper weighs every edge of an image. Where the hand is known, those that the tool cannot reach,
or about which nothing changed, need not be matched; the background's motion shows in a sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tooltip_cli.method.affine import fit_background, mahalanobis
from tooltip_cli.method.blocks import matchable, window_margin
from tooltip_cli.method.detector import (
    FEW_EDGES,
    SINGULAR,
    DetectorParams,
    EdgeMotion,
    Edges,
    Image,
    TipDetection,
    heaviest,
    match_edges,
    no_detection,
    not_asked,
)
from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.lighting import dimmed, gain
from tooltip_cli.method.voting.moving import changed, every_so_many, on_mask, within
from tooltip_cli.method.voting.params import MovingParams


@dataclass(frozen=True)
class NearParams:
    """Constants of detection near the hand."""

    detector: DetectorParams  # but for its Canny
    moving: MovingParams  # edges and changes are found as moving edges are
    background_edges: int = 500  # about so many, row by row, that the background is fitted to


@dataclass(frozen=True)
class Shown:
    """One image as it was, and smoothed."""

    gray: Image  # (H, W)
    smoothed: Image  # (H, W)

    def lit_as(self, other: Shown) -> Shown:
        """Return the same as bright as another image of the same scene."""
        factor = gain(self.smoothed, other.smoothed)
        return Shown(dimmed(self.gray, factor), dimmed(self.smoothed, factor))


def near_motion(
    first: Shown,
    second: Shown,
    edges: Edges,
    hand: Array,
    noise: float,
    params: NearParams,
    lap: Callable[[str], None] = not_asked,
    steady: bool = False,
) -> EdgeMotion | str:
    """Return the weighted map of the edges that may be the tip, or the flag that says why not.

    Blocks are compared as in the paper, in the images as they were, but equally bright. Smoothed
    are those in which edges and changes are found, so that noise makes up neither.

    Args:
        edges: (N, 2) of ``first``, smoothed, row by row.
        hand: (3,) u and v of the hand's origin and how far from there the tool can reach, pixels;
            NaN: it can be anywhere.
        noise: of the images as they were, grey levels.
        lap: told the name of each step when it ends: ``match``, ``fit``, ``changes``.
        steady: whether the images are known to be equally bright.
    """
    detector = params.detector
    if len(edges) < detector.min_edges:
        return FEW_EDGES
    if not steady:
        second = second.lit_as(first)
    sample = _with_room(every_so_many(edges, params.background_edges), first, params)
    matches = match_edges(first.gray, second.gray, sample, detector)
    lap("match")
    fit = fit_background(
        sample,
        matches.translations,
        matches.covariances,
        iterations=detector.drop_iterations,
        drop_fraction=detector.drop_fraction,
    )
    lap("fit")
    if fit is None:
        return SINGULAR
    differs = changed(first.smoothed, second.smoothed, fit.model, noise, params.moving)
    near = on_mask(differs, edges)
    if np.isfinite(hand).all():
        near = within(near, hand[:2], hand[2])
    near = _with_room(near, first, params)
    lap("changes")
    matches = match_edges(first.gray, second.gray, near, detector)
    weights = mahalanobis(fit.model, near, matches.translations, matches.covariances)
    lap("match")
    return EdgeMotion(
        near, matches.translations, matches.covariances, weights, fit.inliers, fit.model
    )


def _with_room(edges: Edges, image: Shown, params: NearParams) -> Edges:
    """Leave out edges too close to the border for blocks larger than those of moving edges."""
    block, search = params.detector.block, params.detector.search
    if window_margin(block, search) <= window_margin(params.moving.block, params.moving.search):
        return edges
    height, width = image.gray.shape
    return np.compress(matchable(edges, (height, width), block, search), edges, axis=0)


def detect_near(
    first: Shown,
    second: Shown,
    edges: Edges,
    hand: Array,
    noise: float,
    params: NearParams,
    lap: Callable[[str], None] = not_asked,
    steady: bool = False,
) -> TipDetection:
    """Select the heaviest of those edges; the first in row-major order of equals.

    Args are those of `near_motion`.
    """
    motion = near_motion(first, second, edges, hand, noise, params, lap, steady)
    if isinstance(motion, str):
        return no_detection(motion, len(edges))
    return heaviest(motion, params.detector)
