"""The estimate stage of the voting method: pair, detect, reconstruct, find the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.rays import sphere_array
from tooltip_cli.method.types import Array, Reason, TipEstimate, refused
from tooltip_cli.method.voting.estimate import METHOD, check_motion
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.pairing import Pairing, pair_frames
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.silhouette import UNKNOWN, HandSilhouettes
from tooltip_cli.method.voting.volume import HandEdges
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.memory import give_back_freed
from tooltip_cli.stages.moving import (
    DetectedEdges,
    PendingEdges,
    detect_edges_in,
    image_extent,
    known_edges,
)


def pair_views(
    views: Views, settings: VotingSettings, allowed: npt.NDArray[np.bool_]
) -> tuple[Pairing, Array]:
    """Return the pairing of a recording's images and (N, 4, 4) camera_from_hand."""
    camera_from_hand = inverse_transform(views.hand_from_camera)
    return pair_frames(camera_from_hand, focal_px(views.camera), settings.pairing, allowed), (
        camera_from_hand
    )


@dataclass(frozen=True)
class Votes:
    """What an estimate by voting is made from."""

    pairing: Pairing
    detected: DetectedEdges
    spheres: Array  # (S, 4) centre and radius of hand and wrist, metres

    def known_to(self, views: Views) -> MovingEdges:
        """Return the edges of frames whose pose is known: by other clocks joints may be missing."""
        edges = self.detected.edges
        known = views.known[edges.frames]
        return edges if known.all() else edges.of_frames(edges.frames[known])

    def seen_by(
        self, views: Views, settings: VotingSettings, edges: MovingEdges | None = None
    ) -> HandEdges:
        """Return the edges as a rig sees them, be it the one that they were paired by or a better.

        They take a tenth of a gigabyte, so they are made where they are needed.

        Args:
            edges: some of those that are known to the views; default: all.
        """
        poses = inverse_transform(views.hand_from_camera)
        return hand_edges(views, self.known_to(views) if edges is None else edges, poses, settings)

    def moved(self, seen: HandEdges, views: Views) -> HandEdges | None:
        """Return edges that were seen by one rig as another sees them, without undistorting again.

        None: the rigs know the poses of different images.
        """
        frames, detected = seen.moving.frames, self.detected.edges.frames
        if not np.array_equal(frames, detected[views.known[detected]]):
            return None
        poses, outlines = inverse_transform(views.hand_from_camera), seen.silhouettes
        if outlines is not None:
            outlines = replace(outlines, camera_from_hand=poses[frames])
        return replace(seen, camera_from_hand=poses, silhouettes=outlines)


def gather_votes(
    recording: Recording,
    views: Views,
    settings: VotingSettings,
    allowed: npt.NDArray[np.bool_],
    *,
    out: Path | None,
    jobs: int,
    on_frame: Callable[[], None] = lambda: None,
) -> Votes | TipEstimate:
    """Find what moves in the allowed images (N,), or refuse where the motion shows nothing.

    Raises:
        TooltipError: an image cannot be decoded, or the edges not written.
    """
    pairing, camera_from_hand = pair_views(views, settings, allowed)
    reason = check_motion(pairing, camera_from_hand, settings)
    if reason is not None:
        return refused(METHOD, len(pairing.frames), reason)
    detected = detect_edges_in(
        recording, views, pairing, settings, out=out, jobs=jobs, on_frame=on_frame
    )
    give_back_freed()  # voting is where the most is held
    spheres = sphere_array([(sphere.center, sphere.radius) for sphere in views.spheres])
    return Votes(pairing, detected, spheres)


def edges_for_voting(
    recording: Recording,
    views: Views,
    settings: VotingSettings,
    *,
    out: Path | None = None,
    force: bool = False,
    jobs: int = 1,
) -> DetectedEdges | PendingEdges | Reason:
    """Return the moving edges that the estimate will ask for, or what will find them.

    A reason: the motion shows nothing.

    Raises:
        TooltipError: an image cannot be decoded.
    """
    allowed = unlabelled(recording, views.camera, out)
    pairing, camera_from_hand = pair_views(views, settings, allowed)
    reason = check_motion(pairing, camera_from_hand, settings)
    if reason is not None:
        return reason
    return known_edges(recording, views, pairing, settings, out=out, force=force, jobs=jobs)


def hand_edges(
    views: Views, moving: MovingEdges, camera_from_hand: Array, settings: VotingSettings
) -> HandEdges:
    """Undo the lens distortion of moving edges, their matches and the background's motion."""
    camera, moving = views.camera, moving.in_order()
    pixels = moving.pixels.astype(float)
    affines = moving.affines[moving.frame_of_edge]
    carried = np.einsum("ekij,ej->eki", affines[..., :2], pixels) + affines[..., 2]
    return HandEdges(
        moving,
        _normalized(camera, pixels),
        _normalized(camera, pixels[:, None] + moving.translations),
        _normalized(camera, carried),
        camera_from_hand,
        focal_px(camera),
        image_extent(camera),
        settings.moving.reach,
        _hand_silhouettes(camera, moving, camera_from_hand),
    )


def _hand_silhouettes(
    camera: CameraModel, moving: MovingEdges, camera_from_hand: Array
) -> HandSilhouettes | None:
    """Undo the lens distortion of silhouettes."""
    found = moving.silhouettes
    if found is None:
        return None
    view = np.diag([1 / found.scale, 1 / found.scale, 1.0]) @ camera.matrix
    return HandSilhouettes(
        camera_from_hand[moving.frames],
        _undistorted(found.masks, view, found.scale, camera),
        view,
        _normalized(camera, found.contours.astype(float)),
        found.row_of_point,
        focal_px(camera),
    )


def _undistorted(
    masks: npt.NDArray[np.uint8], view: Array, scale: int, camera: CameraModel
) -> npt.NDArray[np.uint8]:
    """Return masks as a camera without distortion sees them."""
    import cv2

    if not any(camera.distortion):
        return masks
    height, width = masks.shape[1:]
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(view).T
    at = np.nan_to_num(camera.project(rays) / scale, nan=-1e4).astype(np.float32)
    return np.stack(
        [
            np.asarray(cv2.remap(mask, at, None, cv2.INTER_NEAREST, borderValue=UNKNOWN), np.uint8)
            for mask in masks
        ]
    )


def _normalized(camera: CameraModel, pixels: Array) -> Array:
    rays = camera.directions(pixels)
    return np.asarray(rays[..., :2] / rays[..., 2:])


def focal_px(camera: CameraModel) -> float:
    """Return ideal pixels per unit of normalized coordinates."""
    return float(np.sqrt(camera.fx * camera.fy))
