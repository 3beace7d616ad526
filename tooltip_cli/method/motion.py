"""How the hand moves before the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tooltip_cli.method.types import Array

_COMPARED = 300  # poses that are compared with one another, evenly spread


@dataclass(frozen=True)
class HandMotion:
    """The hand's motion relative to the camera."""

    turn_deg: float  # largest angle between any two orientations
    travel_m: float  # largest distance between any two positions
    speed_deg_s: float  # median angular speed
    fastest_deg_s: float  # its 95 % quantile


def hand_motion(camera_from_hand: Array, times_s: Array) -> HandMotion:
    """Describe a motion.

    Args:
        camera_from_hand: (N, 4, 4), all known, N at least 1.
        times_s: (N,) ascending, seconds.
    """
    rotations = camera_from_hand[:, :3, :3]
    steps = np.einsum("nij,nij->n", rotations[1:], rotations[:-1])
    speeds = np.degrees(_angle(steps)) / np.diff(times_s)
    few = camera_from_hand[:: max(len(camera_from_hand) // _COMPARED, 1)]
    traces = np.einsum("nij,mij->nm", few[:, :3, :3], few[:, :3, :3])
    places = few[:, :3, 3]
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    return HandMotion(
        turn_deg=float(np.degrees(_angle(traces).max())),
        travel_m=float(distances.max()),
        speed_deg_s=float(np.median(speeds)) if len(speeds) else 0.0,
        fastest_deg_s=float(np.quantile(speeds, 0.95)) if len(speeds) else 0.0,
    )


def _angle(traces: Array) -> Array:
    """Return the angles of rotations with these traces, radians."""
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))
