"""The far end of clouds of points that are drawn around known shapes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import erf

import numpy as np
import numpy.typing as npt
import pytest

from tooltip_cli.method.types import Indices
from tooltip_cli.method.voting.end import (
    Shape,
    _stop,
    end_along,
    far_voxels,
    locate_end,
    locate_hull_end,
    may_be_meant,
    tool_shape,
    unit_vector,
)
from tooltip_cli.method.voting.params import EndParams
from tooltip_cli.method.voting.volume import Cloud
from tooltip_cli.rig.kinematics import rotation_from_rpy

Array = npt.NDArray[np.float64]
Draw = Callable[[np.random.Generator], Array]

PARAMS = EndParams()
REACH = 0.35
FRAMES = 60
NOISE = 0.001  # metres
HAND = np.array([[0.0, 0.0, 0.0, 0.05]])


def round_bar(
    rng: np.random.Generator, start: float, stop: float, radii: tuple[float, float], density: int
) -> Array:
    """Return points on the side of a cone about z and, as many again, on the rim of its end."""
    side = int(density * (stop - start) / 0.1)
    rim = int(2 * np.pi * radii[1] / 0.002)
    z = np.concatenate([rng.uniform(start, stop, side), np.full(rim, stop)])
    turn = rng.uniform(0, 2 * np.pi, side + rim)
    radius = radii[0] + (radii[1] - radii[0]) * (z - start) / (stop - start)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def pen(rng: np.random.Generator) -> Array:
    return round_bar(rng, 0.04, 0.2, (0.004, 0.004), 60)


def thick(rng: np.random.Generator) -> Array:
    return round_bar(rng, 0.04, 0.18, (0.015, 0.015), 120)


def cone(rng: np.random.Generator) -> Array:
    return round_bar(rng, 0.04, 0.19, (0.014, 0.002), 90)


def knob(rng: np.random.Generator) -> Array:
    """Return a bar whose end is half a ball; its tip is at z = 0.18."""
    bar = round_bar(rng, 0.04, 0.17, (0.01, 0.01), 90)[:117]
    up = rng.uniform(0, 1, 40)
    turn = rng.uniform(0, 2 * np.pi, 40)
    across = np.sqrt(1 - up * up)
    ball = np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=1)
    return np.concatenate([bar, (0.0, 0.0, 0.17) + 0.01 * ball])


TOOLS: dict[str, tuple[Draw, float]] = {
    "pen": (pen, 0.2),
    "thick": (thick, 0.18),
    "cone": (cone, 0.19),
    "knob": (knob, 0.18),
}


def hammer(rng: np.random.Generator) -> Array:
    """Return a handle along z, and a head along x at its end that reaches farther on one side."""
    handle = round_bar(rng, 0.04, 0.18, (0.006, 0.006), 60)
    head = round_bar(rng, -0.055, 0.07, (0.01, 0.01), 100)
    other = round_bar(rng, -0.056, -0.055, (0.01, 0.01), 1)
    head = np.concatenate([head, other])
    return np.concatenate([handle, (0.0, 0.0, 0.18) + head[:, [2, 1, 0]]])


def any_turn(seed: int) -> Array:
    """Return a random rotation (3, 3)."""
    return rotation_from_rpy(np.random.default_rng(seed).uniform(-np.pi, np.pi, 3).tolist())


def cloud_of(draw: Draw, turn: Array, seed: int, frames: int = FRAMES) -> Cloud:
    """Return other points of a shape in each frame, with noise, the shape turned."""
    rng = np.random.default_rng(seed)
    parts = [draw(rng) for _ in range(frames)]
    points = np.concatenate(parts) @ turn.T
    rows = np.repeat(np.arange(frames), [len(part) for part in parts])
    return cloud(points + rng.normal(0, NOISE, points.shape), rows, frames)


def cloud(points: Array, rows: Indices, frames: int) -> Cloud:
    expected = np.full((3, 3, 3), frames, dtype=np.float32)
    return Cloud(
        points,
        rows,
        frames,
        expected,
        0.008,
        score=1.0,
        consistent=1.0,
        edges=np.zeros((0, 2)),
        edge_rows=np.zeros(0, dtype=np.intp),
        profiles=np.zeros((0, 2), dtype=np.float32),
        depths=np.zeros((frames, 3)),
    )


def turned(name: str, seed: int) -> tuple[Cloud, Array, Array, Array]:
    """Return a tool's cloud in a random orientation, its true tip and axis, and the hand."""
    draw, length = TOOLS[name]
    turn = any_turn(seed)
    axis = turn @ (0.0, 0.0, 1.0)
    return cloud_of(draw, turn, seed), length * axis, axis, HAND


def degrees_between(first: Array, second: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(first @ second, -1, 1))))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", TOOLS)
def test_the_end_is_found_in_any_orientation(name: str, seed: int) -> None:
    found, tip, axis, spheres = turned(name, seed)
    shape = tool_shape(found, spheres, REACH, PARAMS)
    first = far_voxels(shape, PARAMS)[0]
    end = locate_end(found, shape, shape.voxels[first], spheres, PARAMS)
    assert np.linalg.norm(end.position - tip) < 0.0025
    # half a ball has no face that its axis could stand on
    assert degrees_between(end.axis, axis) < (16 if name == "knob" else 10)
    assert np.linalg.norm(end.axis) == pytest.approx(1)
    assert 0 < end.support <= 1


def test_a_thicker_end_has_a_larger_radius() -> None:
    radii = {}
    for name in ("pen", "thick"):
        found, tip, _, spheres = turned(name, 1)
        shape = tool_shape(found, spheres, REACH, PARAMS)
        radii[name] = locate_end(found, shape, tip, spheres, PARAMS).radius
    # measured on smoothed voxels, which are about a voxel wider
    assert 0.004 <= radii["pen"] <= 0.004 + 1.5 * PARAMS.voxel
    assert 0.015 <= radii["thick"] <= 0.015 + 1.5 * PARAMS.voxel


def test_without_spheres_the_origin_is_the_grip() -> None:
    found, tip, _, _ = turned("pen", 1)
    none = np.zeros((0, 4))
    shape = tool_shape(found, none, REACH, PARAMS)
    first = far_voxels(shape, PARAMS)[0]
    end = locate_end(found, shape, shape.voxels[first], none, PARAMS)
    assert np.linalg.norm(end.position - tip) < 0.0025


def test_support_is_the_share_of_frames() -> None:
    whole, tip, _, spheres = turned("pen", 1)
    supports = []
    for share in (2, 4):
        found = replace(whole, frame_count=share * FRAMES)
        shape = tool_shape(found, spheres, REACH, PARAMS)
        supports.append(locate_end(found, shape, tip, spheres, PARAMS).support)
    assert 0.4 < supports[0] < 0.7
    assert supports[1] == pytest.approx(supports[0] / 2)


@pytest.mark.parametrize("seed", range(2))
def test_both_ends_of_a_hammer_are_reported_the_farther_first(seed: int) -> None:
    turn = any_turn(seed)
    found = cloud_of(hammer, turn, seed, 30)
    shape = tool_shape(found, HAND, REACH, PARAMS)
    far = shape.voxels[far_voxels(shape, PARAMS)]
    assert len(far) == 2
    tips = np.array([[0.07, 0.0, 0.18], [-0.056, 0.0, 0.18]]) @ turn.T
    for voxel, tip in zip(far, tips, strict=True):
        assert np.linalg.norm(voxel - tip) < 0.02  # on the rim of the end's face
        end = locate_end(found, shape, voxel, HAND, PARAMS)
        assert np.linalg.norm(end.position - tip) < 0.004
    assert (np.diff(np.linalg.norm(far, axis=1)) < 0).all()


def test_a_nearer_end_is_no_candidate() -> None:
    """An end counts from a share of the farthest one's distance on."""
    voxels = np.array([[0.0, 0.0, 0.2], [0.0, 0.17, 0.0], [0.15, 0.0, 0.0], [0.0, 0.02, 0.19]])
    shape = Shape(voxels, np.full(4, 9.0))
    assert far_voxels(shape, PARAMS).tolist() == [0, 1]
    assert far_voxels(shape, replace(PARAMS, far_share=0.7)).tolist() == [0, 1, 2]
    assert far_voxels(shape, replace(PARAMS, end_separation=0.01)).tolist() == [0, 3, 1]


def test_an_end_is_far_from_the_grip() -> None:
    """A tool held tilted towards the wrist: its handle's end is farther from that than its tip."""
    tip, handle = np.array([0.103, -0.019, -0.008]), np.array([-0.036, -0.035, 0.148])
    shape = Shape(np.stack([handle, tip]), np.full(2, 9.0))
    grip = np.array([0.0, -0.027, 0.061])
    assert far_voxels(shape, PARAMS).tolist() == [0]
    assert far_voxels(shape, PARAMS, grip).tolist() == [1]
    assert far_voxels(shape, replace(PARAMS, far_share=0.6), grip).tolist() == [1, 0]


def stick(first: float, other: float, widths: tuple[float, float]) -> tuple[Shape, Array, Array]:
    """Return what shows of a straight tool on both sides of a grip, and its ends, metres.

    Args:
        first: how far it reaches from the grip, upwards.
        other: how far downwards.
        widths: radius of each of these parts.
    """
    rng = np.random.default_rng(0)
    parts = []
    for length, width in zip((first, -other), widths, strict=True):
        along = length - np.sign(length) * rng.uniform(0, 0.04, 400)
        angle, radius = rng.uniform(0, 2 * np.pi, 400), width * np.sqrt(rng.uniform(0, 1, 400))
        parts.append(np.stack([radius * np.cos(angle), radius * np.sin(angle), along], axis=1))
    grip = np.array([0.06, 0.0, 0.0])
    voxels = grip + np.concatenate(parts)
    tips = grip + np.array([[0.0, 0.0, first], [0.0, 0.0, -other]])
    return Shape(voxels, np.full(len(voxels), 9.0)), tips, grip


def meant(shape: Shape, tips: Array, grip: Array, params: EndParams = PARAMS) -> bool:
    first, other = [(tip, unit_vector(tip - grip)) for tip in tips]
    return may_be_meant(shape, first, other, grip, params)


def test_an_end_that_is_about_as_far_out_may_be_meant() -> None:
    assert meant(*stick(0.15, 0.14, (0.005, 0.005)))
    assert not meant(*stick(0.15, 0.08, (0.005, 0.005)))
    assert meant(*stick(0.15, 0.08, (0.005, 0.005)), replace(PARAMS, other_end_share=0.2))


def test_nearer_to_the_wrist_but_farther_from_the_grip_may_be_meant() -> None:
    """A tool held tilted towards the wrist, whose handle's end is farther from that."""
    grip = np.array([0.0, -0.027, 0.061])
    handle, tip = np.array([-0.036, -0.035, 0.148]), np.array([0.103, -0.019, -0.008])
    assert np.linalg.norm(tip) < 0.7 * np.linalg.norm(handle)
    none = Shape(np.zeros((0, 3)), np.zeros(0))
    assert meant(none, np.stack([handle, tip]), grip)
    assert not meant(none, np.stack([handle, grip + 0.7 * (tip - grip)]), grip)


def test_a_thicker_end_beyond_the_hand_may_be_meant() -> None:
    """There is no telling a cord with a plug from a handle with a shaft."""
    assert meant(*stick(0.15, 0.09, (0.004, 0.012)))
    assert not meant(*stick(0.15, 0.09, (0.012, 0.004)))
    assert not meant(*stick(0.15, 0.06, (0.004, 0.012)))  # hardly comes out of the hand
    shape, tips, grip = stick(0.15, 0.09, (0.004, 0.012))
    sideways = grip + (shape.voxels[400:] - grip)[:, [2, 1, 0]] * np.array([-1, 1, 1])
    beside = Shape(np.concatenate([shape.voxels[:400], sideways]), shape.counts)
    butt = grip + np.array([0.09, 0.0, 0.0])
    assert not meant(beside, np.stack([tips[0], butt]), grip)  # not beyond the hand
    few = Shape(shape.voxels[:403], shape.counts[:403])
    assert not meant(few, tips, grip)


def test_of_voxels_that_are_equally_far_one_stands_for_the_end() -> None:
    voxels = 0.004 * np.array([[20.0, 21, 42], [21, 20, 42], [20, 20, 42], [-20, 21, -42]])
    assert far_voxels(Shape(voxels, np.ones(4)), PARAMS).tolist() == [0, 3]


def test_the_shape_is_where_the_points_are_and_outside_the_hand() -> None:
    found, _, axis, spheres = turned("pen", 2)
    shape = tool_shape(found, spheres, REACH, PARAMS)
    along = shape.voxels @ axis
    across = np.linalg.norm(shape.voxels - along[:, None] * axis, axis=1)
    assert across.max() < 0.004 + 2.5 * PARAMS.voxel
    assert 0.2 - PARAMS.voxel < along.max() < 0.2 + 2.5 * PARAMS.voxel
    assert np.linalg.norm(shape.voxels, axis=1).min() > spheres[0, 3]
    for place in np.arange(0.06, 0.2, 0.005):  # no gaps
        assert np.abs(along - place).min() < PARAMS.voxel
    free = tool_shape(found, np.zeros((0, 4)), REACH, PARAMS)
    assert np.linalg.norm(free.voxels, axis=1).min() < spheres[0, 3]


def test_specks_single_frames_and_far_points_are_no_shape() -> None:
    found, _, axis, spheres = turned("pen", 2)
    rng = np.random.default_rng(0)
    # everywhere, but nowhere in many frames
    clutter = rng.uniform(-0.3, 0.3, (FRAMES * 20, 3))
    rows = np.repeat(np.arange(FRAMES), 20)
    # in all frames, but small
    speck = rng.normal(-0.2 * axis, 0.0003, (FRAMES, 3))
    # in a single frame
    single = rng.normal(0.1, 0.005, (500, 3))
    beyond = rng.normal(0.4 * axis, 0.01, (FRAMES * 30, 3))
    spoilt = cloud(
        np.concatenate([found.points, clutter, speck, single, beyond]),
        np.concatenate(
            [
                found.frames,
                rows,
                np.arange(FRAMES),
                np.zeros(500, dtype=int),
                np.repeat(np.arange(FRAMES), 30),
            ]
        ),
        FRAMES,
    )
    params = replace(PARAMS, min_voxels=40)
    before = tool_shape(found, spheres, REACH, params)
    after = tool_shape(spoilt, spheres, REACH, params)
    assert len(after.voxels) == pytest.approx(len(before.voxels), rel=0.1)
    along = after.voxels @ axis
    assert along.min() > 0
    assert np.linalg.norm(after.voxels - along[:, None] * axis, axis=1).max() < 0.016


@pytest.mark.parametrize("points", [0, 5])
def test_next_to_no_points_are_no_shape(points: int) -> None:
    found = cloud(np.full((points, 3), 0.1), np.zeros(points, dtype=int), FRAMES)
    shape = tool_shape(found, HAND, REACH, PARAMS)
    assert shape.voxels.shape == (0, 3)
    assert shape.counts.shape == (0,)
    assert far_voxels(shape, PARAMS).shape == (0,)


def test_points_inside_the_hand_only_are_no_shape() -> None:
    rng = np.random.default_rng(0)
    found = cloud(rng.normal(0, 0.008, (50 * FRAMES, 3)), np.repeat(np.arange(FRAMES), 50), FRAMES)
    assert len(tool_shape(found, HAND, REACH, PARAMS).voxels) == 0
    assert len(tool_shape(found, np.zeros((0, 4)), REACH, PARAMS).voxels) > 0


def test_a_lonely_voxel_is_an_end_of_its_own() -> None:
    """Nothing to tell an axis from: it points away from the grip."""
    far = np.array([0.0, 0.1, 0.0])
    end = locate_end(
        cloud(far[None], np.zeros(1, dtype=int), 1), Shape(far[None], np.ones(1)), far, HAND, PARAMS
    )
    assert np.linalg.norm(end.position - far) < 0.02
    np.testing.assert_allclose(end.axis, [0, 1, 0])


def density(stop: float, blur: float, plateau: float, rim: float) -> Array:
    """Return what 101 bins hold when step and rim lie ``stop`` bins from the sixty-first."""
    place = (np.arange(101) - 60.0 - stop) / blur
    step = np.array([0.5 * (1 - erf(value / np.sqrt(2))) for value in place])
    return np.asarray(plateau * step + rim * np.exp(-0.5 * place * place))


@pytest.mark.parametrize("blur", [1.5, 2.0, 3.0])
@pytest.mark.parametrize(("plateau", "rim"), [(40.0, 0.0), (0.0, 60.0), (40.0, 60.0), (40.0, 15.0)])
@pytest.mark.parametrize("stop", [-7.3, 0.0, 5.6])
def test_where_a_blurred_step_and_rim_stop(
    stop: float, blur: float, plateau: float, rim: float
) -> None:
    assert _stop(density(stop, blur, plateau, rim)) == pytest.approx(stop, abs=0.5)


@pytest.mark.parametrize("blur", [1.7, 2.2, 2.7])
def test_a_blur_between_those_tried_moves_the_stop_little(blur: float) -> None:
    """A rim on a step looks much like the step a little farther out."""
    for plateau, rim in ((40.0, 0.0), (0.0, 60.0), (40.0, 60.0)):
        assert _stop(density(3.3, blur, plateau, rim)) == pytest.approx(3.3, abs=1.5)


@pytest.mark.parametrize("seed", range(5))
def test_where_a_noisy_density_stops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stop = rng.uniform(-10, 10)
    counts = rng.poisson(density(stop, 2.0, 40.0, 30.0)).astype(float)
    assert _stop(counts) == pytest.approx(stop, abs=1.5)


def test_where_a_tool_stops_along_its_axis() -> None:
    found, _, axis, _ = turned("pen", 0)
    for offset in (-0.01, 0.0, 0.01):
        place = end_along(found, (0.2 + offset) * axis, axis, 0.004)
        assert place == pytest.approx(-offset, abs=0.001)
    nothing = cloud(np.zeros((0, 3)), np.zeros(0, dtype=int), FRAMES)
    assert end_along(nothing, np.zeros(3), axis, 0.004) == 0


@pytest.mark.parametrize("count", [1, 2, 5])
def test_an_end_of_a_few_voxels_in_a_line_has_a_width(count: int) -> None:
    voxels = np.array([[0.0, 0.0, 0.1 + 0.004 * step] for step in range(count)])
    end = locate_hull_end(Shape(voxels, np.full(count, 9.0)), voxels[-1], HAND, PARAMS)
    assert end.radius > 0
    assert np.linalg.norm(end.position - voxels[-1]) < 0.004
