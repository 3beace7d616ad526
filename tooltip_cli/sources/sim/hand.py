"""The robot's hand, wrist and arm: the shapes that the camera sees besides the tool."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tooltip_cli.sources.sim.mesh import (
    Floats,
    Mesh,
    box,
    capsule,
    circle,
    loft,
    merged,
    moved,
    revolve,
    rotation,
    spline,
    superellipse,
)

COVER, FINGER, JOINT, METAL, PAD, SCREW = range(6)
"""Materials of the robot, the first of every scene's list."""

PALM_Y = -0.016  # surface of the palm, hand frame (the palm faces -y)
GRIP_Z = 0.078  # where a gripped handle crosses the hand, hand frame
_FINGER_X = (0.0345, 0.0115, -0.0115, -0.0345)  # index to little finger
_FINGER_RADIUS = 0.0088


@dataclass(frozen=True)
class Grip:
    """What the fingers close round: a handle along ``axis`` through ``centre``, hand frame."""

    centre: Floats  # (3,) m
    axis: Floats  # (3,) unit
    half_depth: float  # half thickness of the handle across the palm (y), m
    half_width: float  # half thickness of the handle along the fingers (z), m


def hand_mesh(grip: Grip | None) -> Mesh:
    """Return palm, fingers and thumb in the hand frame, m.

    Args:
        grip: what is held; None makes a fist whose index finger is missing, see ``index_finger``.
    """
    fist = Grip(np.array([0.0, PALM_Y - 0.006, GRIP_Z]), np.array([1.0, 0.0, 0.0]), 0.006, 0.006)
    held = grip or fist
    fingers = _FINGER_X if grip else _FINGER_X[1:]
    return merged([_palm(), *(_finger(held, x) for x in fingers), _thumb(held)])


def wrist_mesh() -> Mesh:
    """Return the yoke between the wrist's pitch and roll joints, wrist frame, m."""
    to_y = np.eye(4)
    to_y[:3, :3] = rotation((0.0, 0.0, 1.0), np.pi / 2.0)
    pin = moved(
        revolve([(-0.036, 0.013), (-0.033, 0.015), (0.033, 0.015), (0.036, 0.013)], material=METAL),
        to_y,
    )
    return merged([pin, box((0.0, 0.0, 0.0), (0.018, 0.026, 0.02), material=JOINT, bevel=0.3)])


def forearm_mesh() -> Mesh:
    """Return the forearm with its cuffs and screws, forearm frame, m."""
    shell = [
        (-0.02, 0.042), (0.02, 0.046), (0.07, 0.045), (0.12, 0.043), (0.17, 0.040), (0.21, 0.037),
        (0.225, 0.035),
    ]  # fmt: skip
    cuff = [(0.225, 0.031), (0.232, 0.033), (0.256, 0.033), (0.262, 0.030)]
    parts = [
        _along_z(shell, COVER, section=superellipse(28, 2.6)),
        _along_z(cuff, JOINT, section=circle(28)),
        _along_z([(0.216, 0.0375), (0.2235, 0.0375)], METAL, section=superellipse(28, 2.6)),
    ]
    for side in (-1.0, 1.0):
        parts.append(box((0.0, side * 0.030, 0.278), (0.014, 0.004, 0.024), material=METAL))
    cable = spline(
        [(0.03, 0.036, 0.0), (0.024, 0.046, 0.1), (0.022, 0.041, 0.20), (0.014, 0.028, 0.255)], 18
    )
    parts.append(capsule(cable, 0.004, material=PAD, sides=10))
    for z in (0.05, 0.18):
        for angle in np.arange(4) * (np.pi / 2.0) + np.pi / 4.0:
            out = np.array([np.cos(angle), np.sin(angle), 0.0])
            start = out * 0.040 + np.array([0.0, 0.0, z])
            parts.append(
                loft([start, start + out * 0.007], (0.0035, 0.0032), circle(10), material=SCREW)
            )
    return merged(parts)


def upper_arm_mesh() -> Mesh:
    """Return the upper arm and the elbow, upper arm frame, m."""
    tube = [(-0.02, 0.046), (0.0, 0.05), (0.16, 0.048), (0.25, 0.044)]
    elbow = loft(
        [(0.0, -0.05, 0.29), (0.0, -0.046, 0.29), (0.0, 0.046, 0.29), (0.0, 0.05, 0.29)],
        (0.042, 0.046, 0.046, 0.042),
        circle(28),
        material=JOINT,
    )
    return merged([_along_z(tube, COVER, section=superellipse(28, 2.6)), elbow])


def index_finger(direction: Floats, length: float) -> tuple[Mesh, Floats]:
    """Return an outstretched index finger and its tip, hand frame, m."""
    base = np.array([_FINGER_X[0], -0.004, 0.088])
    outward = direction / np.linalg.norm(direction)
    bend = np.array([0.0, -0.006, 0.0])  # slightly bent, as a relaxed finger is
    knots = [base, base + 0.46 * length * outward, base + 0.76 * length * outward + bend]
    tip_centre = base + length * outward + 2.6 * bend
    end = tip_centre - knots[-1]
    tip = tip_centre + end / np.linalg.norm(end) * _FINGER_RADIUS * 1.03
    chain = [*knots, tip_centre]
    parts = []
    for start, stop in pairwise(chain):
        along = (stop - start) / np.linalg.norm(stop - start)
        last = stop is chain[-1]
        path = np.linspace(start + 0.003 * along, stop - (0.0 if last else 0.003) * along, 6)
        parts.append(capsule(path, _FINGER_RADIUS, material=FINGER if not last else PAD))
        parts.append(_knuckle(start))
    return merged(parts), tip


def _palm() -> Mesh:
    """Return the palm, its back cover and the wrist flange."""
    core = _along_z(
        [(0.022, 0.024), (0.03, 0.034), (0.045, 0.042), (0.085, 0.043), (0.094, 0.041)],
        JOINT,
        section=superellipse(24, 5.0),
        flatten=0.36,
    )
    cover = loft(
        [(0.0, 0.011, 0.034), (0.0, 0.013, 0.040), (0.0, 0.013, 0.062), (0.0, 0.012, 0.084),
         (0.0, 0.010, 0.090)],
        [(0.034, 0.006), (0.038, 0.008), (0.041, 0.009), (0.040, 0.008), (0.037, 0.006)],
        superellipse(24, 4.0),
        material=COVER,
        up=(0.0, 1.0, 0.0),
    )  # fmt: skip
    pad = box((0.0, PALM_Y + 0.003, 0.062), (0.034, 0.0028, 0.024), material=PAD)
    flange = _along_z([(0.012, 0.021), (0.024, 0.021)], METAL, section=circle(24))
    screws = [
        loft([(x, 0.018, z), (x, 0.0225, z)], (0.003, 0.0026), circle(10), material=SCREW)
        for x in (-0.029, 0.029)
        for z in (0.046, 0.080)
    ]
    light = loft(
        [(0.0, 0.018, 0.052), (0.0, 0.0232, 0.052)], (0.0045, 0.004), circle(12), material=METAL
    )
    return merged([core, cover, pad, flange, light, *screws])


def _finger(grip: Grip, x: float) -> Mesh:
    """Return one finger bent round the handle in the plane of constant x."""
    shift = (x - grip.centre[0]) / grip.axis[0]
    centre = (grip.centre + shift * grip.axis)[1:]
    slant = float(np.hypot(grip.axis[0], grip.axis[2]) / abs(grip.axis[0]))
    half = np.array([grip.half_depth, grip.half_width * slant]) + _FINGER_RADIUS
    # Round the handle from the palm's side (+y) over its distal side (+z) to the outside (-y).
    angle = np.radians(np.linspace(48.0, 268.0, 24))
    round_handle = centre + half * np.column_stack([np.cos(angle), np.sin(angle)])
    root = np.array([-0.002, 0.088])
    around = round_handle[round_handle[:, 1] > 0.5 * (centre[1] + root[1]) - 0.012]
    start = int(np.argmin(np.abs(round_handle[:, 1] - around[0, 1])))
    curve = np.vstack([root, round_handle[start:]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    curve = curve[length < 0.104]
    path = spline(np.column_stack([np.full(len(curve), x), curve]), 28)
    parts = []
    for first, last, material in ((0, 11, FINGER), (11, 20, FINGER), (20, 27, PAD)):
        gap = 1 if first else 0
        parts.append(capsule(path[first + gap : last], _FINGER_RADIUS, material=material))
        parts.append(_knuckle(path[first]))
    return merged(parts)


def _thumb(grip: Grip) -> Mesh:
    """Return the thumb: from the palm's side under the handle and over the fingers."""
    radius = 0.0098
    crossing = grip.centre + (0.040 - grip.centre[0]) / grip.axis[0] * grip.axis
    outside = grip.centre[1] - grip.half_depth - 2.0 * _FINGER_RADIUS
    under = min(crossing[2] - grip.half_width - radius - 0.002, 0.050)
    path = spline(
        [
            (0.030, -0.006, 0.034),
            (0.045, -0.5 * radius + 0.4 * grip.centre[1], under),
            (0.047, outside + 0.3 * radius, under + 0.006),
            (0.036, outside - 0.8 * radius, 0.5 * (under + crossing[2])),
            (0.020, outside - 0.9 * radius, crossing[2] - 0.004),
        ],
        26,
    )
    parts = []
    for first, last, material in ((0, 9, FINGER), (9, 18, FINGER), (18, 26, PAD)):
        gap = 1 if first else 0
        parts.append(capsule(path[first + gap : last], radius, material=material, up=(0, 0.3, 1)))
        parts.append(_knuckle(path[first], 0.0105))
    return merged(parts)


def _knuckle(centre: Floats, radius: float = 0.0092) -> Mesh:
    """Return the short metal axle across a finger's joint."""
    across = np.array([1.0, 0.0, 0.0])
    path = [centre + s * across for s in (-0.0098, -0.0090, 0.0090, 0.0098)]
    widths = (0.75 * radius, 0.86 * radius, 0.86 * radius, 0.75 * radius)
    return loft(path, widths, circle(12), material=METAL)


def _along_z(
    profile: list[tuple[float, float]], material: int, *, section: Floats, flatten: float = 1.0
) -> Mesh:
    points = np.asarray(profile)
    path = np.column_stack([np.zeros((len(points), 2)), points[:, 0]])
    widths = np.column_stack([points[:, 1], points[:, 1] * flatten])
    return loft(path, widths, section, material=material, up=(0.0, 1.0, 0.0))
