"""Synthetic views of a tip: cameras around a hand, detections with noise and clutter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.estimators import EstimationInput
from tooltip_cli.method.generative import Observations
from tooltip_cli.method.rays import rays_in_hand, sphere_array
from tooltip_cli.rig.kinematics import inverse_transform, rotation_from_rpy

Array = npt.NDArray[np.float64]

FOCAL = 500.0  # pixels
SIZE = np.array([640.0, 480.0])
TIP = np.array([0.03, -0.05, 0.18])  # metres, hand frame
HAND = np.array([0.02, 0.03, 0.6])  # metres, camera frame


def poses_of(angles: Array) -> Array:
    """Return (N, 4, 4) camera_from_hand for (N, 3) roll, pitch, yaw about the hand, radians."""
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, :3, :3] = np.array([rotation_from_rpy(row) for row in angles]).reshape(-1, 3, 3)
    poses[:, :3, 3] = HAND
    return poses


def looking_at(tip: Array, angles: Array) -> Observations:
    """Return noiseless observations of a tip."""
    poses = poses_of(angles)
    points = np.einsum("nij,j->ni", poses[:, :3, :3], tip) + poses[:, :3, 3]
    return Observations(points[:, :2] / points[:, 2:], poses, FOCAL, float(SIZE.prod()))


def observe(
    count: int, noise_px: float = 0.0, outliers: float = 0.0, seed: int = 0, spread: float = 1.0
) -> Observations:
    """Return observations of the tip from wrist angles within ``spread`` radians.

    Exactly ``outliers`` of them, rounded, lie anywhere in the image.
    """
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-spread, spread, (count, 3)) * (1.0, 1.0, 0.3)
    exact = looking_at(TIP, angles)
    noisy = exact.normalized + noise_px / FOCAL * rng.normal(size=(count, 2))
    wrong = rng.permutation(count) < round(outliers * count)
    clutter = (rng.uniform(size=(count, 2)) - 0.5) * SIZE / FOCAL
    return Observations(
        np.where(wrong[:, None], clutter, noisy),
        exact.camera_from_hand,
        FOCAL,
        exact.image_area_px,
    )


def input_of(
    observations: Observations, spheres: Sequence[tuple[Sequence[float], float]] = ()
) -> EstimationInput:
    """Return what an estimator sees of observations."""
    count = len(observations.normalized)
    directions = np.hstack([observations.normalized, np.ones((count, 1))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = rays_in_hand(
        np.arange(count), directions, inverse_transform(observations.camera_from_hand)
    )
    return EstimationInput(
        rays,
        directions,
        observations.camera_from_hand,
        sphere_array(spheres),
        FOCAL,
        observations.image_area_px,
    )
