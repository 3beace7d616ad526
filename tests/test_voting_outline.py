"""The visual hull of exact solids, and their ends put right by outlines from far-off starts."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tooltip_cli.method.voting.end import (
    ToolEnd,
    far_voxels,
    locate_far_side,
    locate_hull_end,
)
from tooltip_cli.method.voting.hull import _where_the_hand_hides, missing, visual_hull
from tooltip_cli.method.voting.outline import fit_outlines
from tooltip_cli.method.voting.params import EndParams, HullParams, OutlineParams, RefineParams
from tooltip_cli.method.voting.refine import Fit
from tooltip_cli.method.voting.sight import across_axis
from tooltip_cli.method.voting.silhouette import BACKGROUND, FOREGROUND, HandSilhouettes

Array = npt.NDArray[np.float64]
Bar = tuple[Array, Array, float, float, float]  # end, axis, two radii, length

SIZE = (400, 300)  # of the masks
SCALE = 2
VIEW = np.array([[FOCAL / SCALE, 0, 200], [0, FOCAL / SCALE, 150], [0, 0, 1.0]])
FRAMES = 90
TIP = np.array([0.03, -0.05, 0.13])
AXIS = np.array([0.6, -0.48, 0.64])
GRIP = TIP - 0.1 * AXIS
REFINE, OUTLINE = RefineParams(), OutlineParams()


def points_of(bar: Bar) -> Array:
    """Return (P, 3) points on the surface of an elliptic bar."""
    end, axis, wide, high, length = bar
    basis = across_axis(axis)
    turns = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rim = (wide * np.cos(turns))[:, None] * basis[:, 0]
    rim = rim + (high * np.sin(turns))[:, None] * basis[:, 1]
    return np.concatenate([end + rim, end - length * axis + rim])


def ball(centre: Array, radius: float) -> Array:
    """Return (P, 3) points on the surface of a ball."""
    points = np.random.default_rng(0).normal(size=(2000, 3))
    return np.asarray(centre + radius * points / np.linalg.norm(points, axis=1, keepdims=True))


def seen(
    solids: list[Bar | Array], seed: int = 0, noise_px: float = 0.2, poses: Array | None = None
) -> HandSilhouettes:
    """Return exact silhouettes of bars and of convex points, their outlines with noise."""
    rng = np.random.default_rng(seed)
    if poses is None:
        poses = poses_of(rng.uniform(-0.9, 0.9, (FRAMES, 3)))
    masks = np.full((len(poses), SIZE[1], SIZE[0]), BACKGROUND, np.uint8)
    points, rows = [], []
    for row, pose in enumerate(poses):
        hulls = []
        for solid in solids:
            surface = solid if isinstance(solid, np.ndarray) else points_of(solid)
            camera = surface @ pose[:3, :3].T + pose[:3, 3]
            pixels = (camera @ VIEW.T)[:, :2] / camera[:, 2:]
            hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
            fine = np.round(hull * 16).astype(np.int32)
            cv2.fillConvexPoly(masks[row], fine, FOREGROUND, shift=4)
            hulls.append(hull)
        for index, hull in enumerate(hulls):
            along = np.concatenate(
                [
                    np.linspace(a, b, max(2, int(2 * np.linalg.norm(b - a))), endpoint=False)
                    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True)
                ]
            )
            hidden = np.zeros(len(along), dtype=bool)
            for other in hulls[:index] + hulls[index + 1 :]:
                hidden |= np.array(
                    [cv2.pointPolygonTest(other, (float(u), float(v)), False) > 0 for u, v in along]
                )
            kept = along[~hidden]
            points.append(kept + rng.normal(0, noise_px / SCALE, kept.shape))
            rows.append(np.full(len(kept), row, dtype=np.intp))
    normalized = (np.concatenate(points) - VIEW[:2, 2]) / VIEW[0, 0]
    return HandSilhouettes(poses, masks, VIEW, normalized, np.concatenate(rows), FOCAL)


def round_bar(radius: float = 0.01, length: float = 0.1) -> Bar:
    return TIP, AXIS, radius, radius, length


def start(step: float, turn_deg: float, radius: float, seed: int = 3) -> ToolEnd:
    """Return a rough end, a step and a turn away from the truth."""
    rng = np.random.default_rng(seed)
    direction, turn = rng.normal(size=3), rng.normal(size=2)
    turn *= np.tan(np.radians(turn_deg)) / np.linalg.norm(turn)
    axis = AXIS + across_axis(AXIS) @ turn
    axis = axis / np.linalg.norm(axis)
    return ToolEnd(TIP + step * direction / np.linalg.norm(direction), axis, radius, 0.0)


def fitted(silhouettes: HandSilhouettes, *starts: ToolEnd) -> Fit:
    found = fit_outlines(silhouettes, starts, GRIP, REFINE, OUTLINE)
    assert found is not None
    return found[0]


@pytest.mark.parametrize("radius", [0.004, 0.01, 0.025])
def test_the_hull_hugs_the_solid(radius: float) -> None:
    bar = round_bar(radius)
    hull = visual_hull(seen([bar]), np.zeros((0, 4)), 0.3, HullParams())
    about = hull.voxels - TIP
    along = about @ AXIS
    across = np.linalg.norm(about - along[:, None] * AXIS, axis=1)
    assert along.max() < 0.012
    assert along.min() > -0.1 - 0.012
    assert across.max() < radius + 0.012
    core = TIP - np.linspace(0.01, 0.09, 9)[:, None] * AXIS
    for point in core:
        assert np.linalg.norm(hull.voxels - point, axis=1).min() < 0.004


def test_the_hulls_far_end_is_the_bars_end() -> None:
    hull = visual_hull(seen([round_bar()]), np.zeros((0, 4)), 0.3, HullParams())
    ends = far_voxels(hull, EndParams())
    end = locate_hull_end(hull, hull.voxels[ends[0]], np.array([[*GRIP, 0.03]]), EndParams())
    assert np.linalg.norm(end.position - TIP) < 0.006
    assert end.axis @ AXIS > np.cos(np.radians(12))
    assert 0.005 < end.radius < 0.02


def test_the_spheres_are_no_tool() -> None:
    spheres = np.array([[*(TIP - 0.06 * AXIS), 0.045]])
    hull = visual_hull(seen([round_bar()]), spheres, 0.3, HullParams())
    assert (np.linalg.norm(hull.voxels - spheres[0, :3], axis=1) >= 0.045).all()


def test_where_the_hand_mostly_stands_the_background_carves_nothing() -> None:
    poses = poses_of(np.random.default_rng(0).uniform(-0.3, 0.3, (FRAMES, 3)))
    silhouettes, params = seen([round_bar()], poses=poses), HullParams()
    near, far = np.array([[*GRIP, 0.045]]), np.array([[*(GRIP + 10.0), 0.045]])
    hidden = _where_the_hand_hides(
        silhouettes.masks, silhouettes.camera_from_hand, VIEW, near, params
    )
    assert 0 < hidden.mean() < 0.5
    # as if the hand had been learnt as background there
    spoilt = replace(silhouettes, masks=np.where(hidden, np.uint8(BACKGROUND), silhouettes.masks))

    def left(spheres: Array) -> int:
        about = visual_hull(spoilt, spheres, 0.3, params).voxels - GRIP
        return int(((about @ AXIS > 0.05) & (about @ AXIS < 0.07)).sum())

    assert left(near) > 4 * left(far)


def test_nothing_that_moves_leaves_no_hull() -> None:
    silhouettes = seen([round_bar()])
    nothing = HandSilhouettes(
        silhouettes.camera_from_hand,
        np.full_like(silhouettes.masks, BACKGROUND),
        VIEW,
        np.zeros((0, 2)),
        np.zeros(0, dtype=np.intp),
        FOCAL,
    )
    hull = visual_hull(nothing, np.zeros((0, 4)), 0.3, HullParams())
    assert len(hull.voxels) == 0
    assert len(far_voxels(hull, EndParams())) == 0
    assert fit_outlines(nothing, [start(0.0, 0.0, 0.01)], GRIP, REFINE, OUTLINE) is None


def test_what_is_missing_tells_solid_from_empty() -> None:
    silhouettes = seen([round_bar()])
    inside, beside = TIP - 0.02 * AXIS, TIP + 0.03 * across_axis(AXIS)[:, 0]
    shares = missing(silhouettes, np.stack([inside, beside, TIP + 0.02 * AXIS]))
    assert shares[0] == 0.0
    assert shares[1:].min() > 0.5


@pytest.mark.parametrize("radius", [0.004, 0.01, 0.02])
@pytest.mark.parametrize("seed", range(3))
def test_a_far_off_start_is_put_right(radius: float, seed: int) -> None:
    silhouettes = seen([round_bar(radius)], seed)
    found = fitted(silhouettes, start(0.018, 25.0, 1.4 * radius, seed))
    assert np.linalg.norm(found.position - TIP) < 0.0008
    assert found.axis @ AXIS > np.cos(np.radians(1.5))
    assert found.agreement(REFINE) > 0.9


def test_the_best_of_several_starts_is_taken() -> None:
    silhouettes = seen([round_bar()])
    lost = ToolEnd(TIP + 0.028 * across_axis(AXIS)[:, 1], across_axis(AXIS)[:, 0], 0.03, 0.0)
    found = fitted(silhouettes, lost, start(0.004, 10.0, 0.01))
    assert np.linalg.norm(found.position - TIP) < 0.0006


def test_a_pin_that_stands_alone_is_the_end() -> None:
    aside = 0.007 * across_axis(AXIS)[:, 0]
    body = (TIP - 0.012 * AXIS - aside, AXIS, 0.012, 0.012, 0.08)
    pins = [
        (TIP, AXIS, 0.002, 0.002, 0.02),
        (TIP - 0.005 * AXIS - 2 * aside, AXIS, 0.002, 0.002, 0.02),
    ]
    found = fitted(seen([body, *pins]), start(0.008, 5.0, 0.01))
    assert found.pointed
    assert np.linalg.norm(found.position - TIP) < 0.0015


def test_the_corner_of_a_blade_is_not() -> None:
    basis = across_axis(AXIS)
    axis = AXIS + 0.05 * basis[:, 0]  # one corner reaches 2 mm farther than the other
    axis = axis / np.linalg.norm(axis)
    blade = (TIP, axis, 0.022, 0.003, 0.09)
    found = fitted(seen([blade]), start(0.006, 8.0, 0.02))
    assert np.linalg.norm(found.position - TIP) < 0.002


def test_of_a_balls_axes_the_one_that_leads_outwards_is_taken_and_the_doubt_is_said() -> None:
    radius = 0.02
    stick = (TIP - radius * AXIS, AXIS, 0.003, 0.003, 0.1)
    silhouettes = seen([ball(TIP - radius * AXIS, radius), stick])
    starts = [start(0.006, angle, 0.015, seed) for seed, angle in enumerate((15.0, 30.0, 45.0))]
    found = fit_outlines(silhouettes, starts, GRIP, REFINE, OUTLINE)
    assert found is not None
    fit, doubt = found
    error = float(np.linalg.norm(fit.position - TIP))
    assert fit.axis @ AXIS > np.cos(np.radians(15))
    assert error < 0.005
    assert error**2 < 7.8 * (doubt + 0.001**2)


def test_a_flat_end_leaves_no_doubt() -> None:
    found = fit_outlines(seen([round_bar()]), [start(0.01, 20.0, 0.01)], GRIP, REFINE, OUTLINE)
    assert found is not None
    assert found[1] < 0.002**2


def test_the_middle_of_a_wide_edge_is_a_start_where_its_corner_is_farthest() -> None:
    basis = across_axis(AXIS)
    axis = AXIS + 0.15 * basis[:, 0]
    blade = (TIP, axis / np.linalg.norm(axis), 0.0375, 0.003, 0.08)
    spheres = np.array([[*GRIP, 0.02]])
    hull = visual_hull(seen([blade]), spheres, 0.3, HullParams())
    far = hull.voxels[np.argmax(np.linalg.norm(hull.voxels - GRIP, axis=1))]
    assert np.linalg.norm(far - TIP) > 0.03
    found = locate_far_side(hull, far, spheres, EndParams())
    assert np.linalg.norm(found.position - TIP) < 0.018
    assert found.axis @ AXIS > np.cos(np.radians(12))
