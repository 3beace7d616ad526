"""Time and memory of the paper's estimators by the number of rays, and what sampling changes.

    python tests/benchmarks/estimation/run.py [--rays 400 2000 54000] [--against-all 3000]

The views are synthetic: of every ten six show the tip with 3 px of noise, and four show anywhere
between hand and tip with 15 px, as wrong detections do. With --against-all the estimates from
samples are compared with that from all pairs, in standard deviations of their own uncertainty.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np

from tooltip_cli.method.estimators import EstimationInput, EstimatorParams, estimate_tip
from tooltip_cli.method.rays import intersections, rays_in_hand
from tooltip_cli.rig.kinematics import inverse_transform, rotation_from_quaternion

TIP = np.array([0.02, -0.03, 0.15])
FOCAL_PX, AREA_PX = 600.0, 640.0 * 480.0
NOWHERE_NEAR = 10**9


def views(count: int, seed: int) -> EstimationInput:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal((0.0, 0.0, 0.0, 3.0), 1.0, (count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    hand_from_camera = np.tile(np.eye(4), (count, 1, 1))
    hand_from_camera[:, :3, :3] = rotation_from_quaternion(quaternions)
    shaken = rng.normal(0.0, 0.03, (count, 3))
    hand_from_camera[:, :3, 3] = shaken - 0.8 * hand_from_camera[:, :3, 2]
    camera_from_hand = inverse_transform(hand_from_camera)
    wrong = rng.random(count) < 0.4
    along = np.where(wrong, 0.8 * rng.random(count), 1.0)
    seen = np.einsum("nij,nj->ni", camera_from_hand[:, :3, :3], along[:, None] * TIP)
    seen += camera_from_hand[:, :3, 3]
    noise_px = np.where(wrong, 15.0, 3.0)[:, None] * rng.normal(size=(count, 2))
    normalized = seen[:, :2] / seen[:, 2:] + noise_px / FOCAL_PX
    directions = np.column_stack([normalized, np.ones(count)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return EstimationInput(
        rays_in_hand(np.arange(count), directions, hand_from_camera),
        directions,
        camera_from_hand,
        np.array([[0.0, 0.0, 0.0, 0.04]]),
        FOCAL_PX,
        AREA_PX,
    )


def one(count: int, method: str) -> None:
    """Print the figures of one number of rays; in a process of its own, for its peak memory."""
    data = views(count, 0)
    estimate_tip(views(50, 1), EstimatorParams(method=method))  # compiles or links
    begin = time.process_time()
    intersections(data.rays, max_distance=0.0254, z_start=0.05)
    pairs = time.process_time() - begin
    begin = time.process_time()
    found = estimate_tip(data, EstimatorParams(method=method))
    whole = time.process_time() - begin
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    assert found.position is not None
    error_mm = 1000 * np.linalg.norm(found.position - TIP)
    print(
        f"{count:6d} rays {method:7s} pairs {1000 * pairs:7.1f} ms  estimate {whole:6.2f} s  "
        f"peak {megabytes:4d} MB  error {error_mm:.2f} mm",
        flush=True,
    )


def against_all(count: int) -> None:
    for scene in range(3):
        data = views(count, scene)
        for method in ("kmeans", "map"):
            params = EstimatorParams(method=method)
            everything = replace(
                params, max_pairs=NOWHERE_NEAR, max_points=NOWHERE_NEAR, max_views=NOWHERE_NEAR
            )
            reference = estimate_tip(data, everything).position
            for seed in range(3):
                found = estimate_tip(data, replace(params, seed=seed))
                assert found.position is not None
                assert found.covariance is not None
                assert reference is not None
                apart = found.position - reference
                deviations = np.sqrt(apart @ np.linalg.solve(found.covariance, apart))
                print(
                    f"scene {scene}, {method}, seed {seed}: {1000 * np.linalg.norm(apart):.2f} mm "
                    f"from all pairs, {deviations:.2f} standard deviations",
                    flush=True,
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rays", type=int, nargs="*", default=[400, 2000, 54_000])
    parser.add_argument("--against-all", type=int)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        one(int(options.one[0]), options.one[1])
        return
    for count in options.rays:
        for method in ("kmeans", "map"):
            subprocess.run([sys.executable, __file__, "--one", str(count), method], check=True)
    if options.against_all:
        against_all(options.against_all)


if __name__ == "__main__":
    main()
