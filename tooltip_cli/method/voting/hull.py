"""The volume that stands before the background in all images: the visual hull of hand and tool.

A voxel of hand or tool never shows the background; one beside them does in some image. Seen from
the hand the camera goes round it, so what no image carves away hugs the tool.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.rays import plausible
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.end import Shape
from tooltip_cli.method.voting.loops import run
from tooltip_cli.method.voting.params import HullParams
from tooltip_cli.method.voting.silhouette import FOREGROUND, UNKNOWN, HandSilhouettes, Image
from tooltip_cli.method.voting.volume import grid_axis

_CARVER = "f64* i64 f64* u8* i64* i64 i64 i64 i64 i32* i32*"
_MIN_VOXELS = 8  # smaller pieces are specks
_CHILDREN = np.array(np.meshgrid(*[[-0.25, 0.25]] * 3)).reshape(3, -1).T


def visual_hull(
    silhouettes: HandSilhouettes, spheres: Array, reach: float, params: HullParams
) -> Shape:
    """Return the voxels outside the hand's spheres that hardly any image carves away.

    Args:
        spheres: (S, 4) centre and radius of hand and wrist, metres.
        reach: metres from the hand's origin.
    """
    camera, view = silhouettes.camera_from_hand, silhouettes.view
    masks = silhouettes.masks
    hidden = _where_the_hand_hides(masks, camera, view, spheres, params)
    cameras = np.ascontiguousarray(view @ camera[:, :3])
    voxels = _ball(reach, params.coarse)
    kept, _ = _uncarved(voxels, cameras, masks, hidden, params.coarse, params)
    voxels = (voxels[kept][:, None] + params.coarse * _CHILDREN).reshape(-1, 3)
    kept, frames = _uncarved(voxels, cameras, masks, hidden, params.fine, params)
    return _pieces(voxels[kept], frames[kept], spheres, params.fine)


def _ball(reach: float, step: float) -> Array:
    """Return (V, 3) the voxels of a ball, without ever holding those of its cube."""
    axis = grid_axis(reach, step)
    squares = np.square(axis)
    inside = squares[:, None, None] + squares[:, None] + squares < reach * reach
    return axis[np.argwhere(inside)]


def missing(silhouettes: HandSilhouettes, points: Array) -> Array:
    """Return (P,) the share of the images that show the background at points (P, 3), hand frame."""
    cameras = np.ascontiguousarray(silhouettes.view @ silhouettes.camera_from_hand[:, :3])
    masks = np.ascontiguousarray(silhouettes.masks)
    inside, carved = _carve(points, cameras, masks, np.arange(len(masks)), len(masks))
    return np.asarray(carved / np.maximum(inside + carved, 1))


def _where_the_hand_hides(
    masks: Image, camera_from_hand: Array, view: Array, spheres: Array, params: HullParams
) -> npt.NDArray[np.bool_]:
    """Return (H, W) pixels that the hand stands before most of the time.

    The background learnt there may be the hand.
    """
    import cv2

    covered = np.zeros(masks.shape[1:], dtype=np.float32)
    for pose in camera_from_hand:
        hand = np.zeros(masks.shape[1:], dtype=np.uint8)
        for *centre, radius in spheres:
            at = pose[:3, :3] @ np.array(centre) + pose[:3, 3]
            if at[2] > radius:
                u, v = (view @ at)[:2] / at[2]
                size = view[0, 0] * radius / at[2]
                if abs(u) < 1e4 and abs(v) < 1e4:
                    cv2.circle(hand, (round(u), round(v)), round(size), 1, -1)
        covered += hand
    return np.asarray(covered > params.max_cover * len(camera_from_hand))


def _uncarved(
    voxels: Array,
    cameras: Array,
    masks: Image,
    hidden: npt.NDArray[np.bool_],
    size: float,
    params: HullParams,
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int32]]:
    """Return (V,) which voxels stay, and (V,) how many silhouettes each lies in."""
    import cv2

    ahead = cameras[:, 2, 3]
    scale = float(np.median(cameras[:, 0, 0] ** 2 + cameras[:, 0, 1] ** 2 + cameras[:, 0, 2] ** 2))
    pixels = scale**0.5 / float(np.median(ahead)) * size
    side = 2 * max(1, round(params.margin * pixels)) + 1
    square = np.ones((side, side), np.uint8)
    wide = np.empty_like(masks)
    for whole, wider in zip(masks, wide, strict=True):
        mask = np.where(hidden, np.uint8(UNKNOWN), whole)
        np.maximum(mask, cv2.dilate((mask == FOREGROUND) * mask, square), out=wider)
    order = np.random.default_rng(0).permutation(len(wide))  # unlike views carve soonest
    limit = int(params.max_missing * len(wide))
    inside, carved = _carve(voxels, cameras, wide, order, limit)
    said = inside + carved
    kept = (said >= params.min_seen * len(wide)) & (carved <= params.max_missing * said)
    return kept, inside


def _carve(
    voxels: Array, cameras: Array, masks: Image, order: Indices, limit: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return (V,) the masks in which each voxel is foreground and in which it is background.

    They are looked at in this order, until more than ``limit`` show background.
    """
    inside, carved = np.zeros((2, len(voxels)), dtype=np.int32)
    run(
        "carver",
        _CARVER,
        np.ascontiguousarray(voxels),
        len(voxels),
        cameras,
        masks,
        order,
        *masks.shape,
        limit,
        inside,
        carved,
    )
    return inside, carved


def _pieces(voxels: Array, frames: npt.NDArray[np.int32], spheres: Array, size: float) -> Shape:
    """Return what lies outside the hand, without specks."""
    from scipy import ndimage

    if not len(voxels):
        return Shape(np.zeros((0, 3)), np.zeros(0))
    index = np.round((voxels - voxels.min(axis=0)) / size).astype(int)
    occupied = np.zeros(index.max(axis=0) + 1, dtype=bool)
    occupied[tuple(index.T)] = True
    parts, count = ndimage.label(occupied, structure=np.ones((3, 3, 3)))
    part = parts[tuple(index.T)]
    large = np.bincount(part, minlength=count + 1)[part] >= _MIN_VOXELS
    kept = large & plausible(voxels, spheres, np.inf)
    return Shape(voxels[kept], frames[kept].astype(float))
