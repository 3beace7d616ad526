"""Whether something hides the tip: the ray from the camera against every triangle, exactly."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from tooltip_cli.sources.sim.raster import compiled

TOLERANCE_M = 0.003  # a surface this close to the tip is the tip's own


@compiled
def hidden(points: NDArray[Any], faces: NDArray[Any], target: NDArray[Any]) -> bool:
    """Say whether a triangle lies between the camera and a point (Moller and Trumbore 1997).

    Args:
        points: (V, 3) vertices in the camera frame, m.
        faces: (F, 3) vertex indices.
        target: (3,) the tip in the camera frame, m.
    """
    tx, ty, tz = target[0], target[1], target[2]
    reach = 1.0 - TOLERANCE_M / (tx * tx + ty * ty + tz * tz) ** 0.5
    for f in range(faces.shape[0]):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        px, py, pz = ty * vz - tz * vy, tz * vx - tx * vz, tx * vy - ty * vx
        det = ux * px + uy * py + uz * pz
        if abs(det) < 1e-15:
            continue
        s = -(a[0] * px + a[1] * py + a[2] * pz) / det
        if s < 0.0 or s > 1.0:
            continue
        qx, qy, qz = uy * a[2] - uz * a[1], uz * a[0] - ux * a[2], ux * a[1] - uy * a[0]
        t = (tx * qx + ty * qy + tz * qz) / det
        if t < 0.0 or s + t > 1.0:
            continue
        distance = (vx * qx + vy * qy + vz * qz) / det
        if 0.0 < distance < reach:
            return True
    return False
