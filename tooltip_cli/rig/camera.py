"""Camera model: pixels to viewing rays and back.

The distortion models are those of ``sensor_msgs/CameraInfo``: ``plumb_bob`` (Brown-Conrady, k1 k2
p1 p2 k3), ``rational_polynomial`` (eight coefficients) and ``equidistant`` (Kannala-Brandt
fisheye, four coefficients).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from numpy.polynomial import polynomial

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.rig.documents import parse_yaml, shown

Array = npt.NDArray[np.float64]

_COEFFICIENTS = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
_NEWTON_STEPS = 20
_MAX_IMAGE_SIDE = 32768


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of one camera at one resolution."""

    width: int  # pixels
    height: int  # pixels
    fx: float  # focal lengths, pixels
    fy: float
    cx: float  # optical centre (u_p, v_p in the paper), pixels, integer at pixel centres
    cy: float
    distortion_model: str  # plumb_bob, rational_polynomial or equidistant
    distortion: tuple[float, ...]  # coefficients in the order of CameraInfo.d

    @classmethod
    def create(
        cls,
        *,
        width: int,
        height: int,
        matrix: Array,
        distortion_model: str,
        distortion: Sequence[float],
        source: str,
    ) -> CameraModel:
        """Check and build a model from a CameraInfo's fields.

        Args:
            matrix: (3, 3) K, pixels.
            source: where it came from, for messages.

        Raises:
            TooltipError: an unknown model, a wrong number of coefficients, or numbers that no
                camera has.
        """
        model = distortion_model or "plumb_bob"
        if model not in _COEFFICIENTS:
            raise TooltipError(f"{source}: " + one_of("distortion model", model, _COEFFICIENTS))
        counts = _COEFFICIENTS[model]
        coefficients = tuple(float(value) for value in distortion)
        if len(coefficients) not in counts:
            wanted = " or ".join(map(str, counts))
            raise TooltipError(
                f"{source}: {model} has {len(coefficients)} distortion coefficients, "
                f"expected {wanted}"
            )
        if any(coefficients[8:]):
            raise TooltipError(
                f"{source}: thin-prism and tilt coefficients (beyond the eighth) are not "
                "supported; calibrate with the first eight"
            )
        values = np.array([*np.asarray(matrix, dtype=float).ravel(), *coefficients])
        fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
        if not np.isfinite(values).all() or fx <= 0 or fy <= 0:
            raise TooltipError(
                f"{source}: camera matrix and distortion must be finite and the focal lengths "
                f"positive, found fx={fx}, fy={fy}"
            )
        if matrix[[0, 1, 2, 2], [1, 0, 0, 1]].any() or matrix[2, 2] != 1:
            raise TooltipError(
                f"{source}: the camera matrix must have the form fx 0 cx, 0 fy cy, 0 0 1; skewed "
                "pixels are not supported"
            )
        if not (0 < width <= _MAX_IMAGE_SIDE and 0 < height <= _MAX_IMAGE_SIDE):
            raise TooltipError(f"{source}: the image size {width}x{height} is not a camera's")
        return cls(
            width, height, fx, fy, float(matrix[0, 2]), float(matrix[1, 2]), model, coefficients[:8]
        )

    @property
    def matrix(self) -> Array:
        """(3, 3) K, pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points_camera: npt.ArrayLike) -> Array:
        """Project points into the image.

        Args:
            points_camera: (..., 3) metres, optical frame.

        Returns:
            (..., 2) pixels (u, v); NaN for points at or behind the camera's plane, and beyond the
            angle at which the distortion model folds back into the image.
        """
        points = np.asarray(points_camera, dtype=float)
        z = points[..., 2:]
        with np.errstate(over="ignore", invalid="ignore"):
            normalized = points[..., :2] / np.where(z > 0, z, np.nan)
            distorted = np.where(self._unfolded(normalized), self._distort(normalized), np.nan)
        return distorted * (self.fx, self.fy) + (self.cx, self.cy)

    def directions(self, pixels: npt.ArrayLike) -> Array:
        """Return the viewing direction of each pixel, the distortion undone.

        Args:
            pixels: (..., 2) pixels (u, v).

        Returns:
            (..., 3) unit vectors in the optical frame; NaN where the distortion has no inverse.
        """
        pixels = np.asarray(pixels, dtype=float)
        distorted = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        normalized = self._undistort(distorted)
        rays = np.concatenate([normalized, np.ones_like(normalized[..., :1])], axis=-1)
        unit: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def contains(self, pixels: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return (...,) whether pixels lie inside the image (pixel areas included)."""
        pixels = np.asarray(pixels, dtype=float)
        low = (pixels >= -0.5).all(axis=-1)
        high = (pixels <= (self.width - 0.5, self.height - 0.5)).all(axis=-1)
        return np.asarray(low & high)

    @cached_property
    def _fold(self) -> float:
        """Largest tangent of the viewing angle up to which farther out stays farther out.

        Beyond it the model is an extrapolation that maps directions onto the wrong pixels.
        """
        if self.distortion_model == "equidistant":
            k1, k2, k3, k4 = self.distortion
            slope = np.array([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])  # of the angle, by its square
            return float(np.tan(min(np.sqrt(_first_root(slope)), np.pi / 2)))
        k1, k2, _, _, k3, k4, k5, k6 = self._eight
        above, below = np.array([1, k1, k2, k3]), np.array([1, k4, k5, k6])
        # the derivative's numerator of r above(r^2) / below(r^2), by r^2
        rising = polynomial.polymul(
            polynomial.polyadd(above, 2 * polynomial.polymulx(polynomial.polyder(above))), below
        )
        falling = 2 * polynomial.polymulx(polynomial.polymul(above, polynomial.polyder(below)))
        slope = polynomial.polysub(rising, falling)
        return float(np.sqrt(min(_first_root(slope), _first_root(below))))

    @property
    def _eight(self) -> tuple[float, ...]:
        """k1 k2 p1 p2 k3 k4 k5 k6, zero where the model has fewer."""
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))

    def _unfolded(self, normalized: Array) -> npt.NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(normalized, axis=-1, keepdims=True) <= self._fold)

    def _distort(self, normalized: Array) -> Array:
        if self.distortion_model == "equidistant":
            return self._fisheye(normalized)
        if not any(self.distortion):
            return normalized
        k1, k2, p1, p2, k3, k4, k5, k6 = self._eight
        x, y = normalized[..., 0], normalized[..., 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def _fisheye(self, normalized: Array) -> Array:
        r = np.linalg.norm(normalized, axis=-1)
        theta = np.arctan(r)
        k1, k2, k3, k4 = self.distortion
        t2 = theta * theta
        bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        scale = np.where(r > 1e-12, bent / np.where(r > 1e-12, r, 1.0), 1.0)
        scaled: Array = normalized * scale[..., None]
        return scaled

    def _undistort(self, distorted: Array) -> Array:
        """Invert the distortion by Newton's method with a numerical Jacobian."""
        if self.distortion_model != "equidistant" and not any(self.distortion):
            return distorted
        estimate = distorted.copy()
        if self.distortion_model == "equidistant":
            # start from the coefficient-free inverse, which is near for every real lens
            theta = np.linalg.norm(distorted, axis=-1)
            safe = np.where(theta > 1e-12, theta, 1.0)
            tangent = np.tan(np.minimum(theta, 1.55))
            estimate = distorted * np.where(theta > 1e-12, tangent / safe, 1.0)[..., None]
        step = 1e-6
        right, down = np.array([step, 0.0]), np.array([0.0, step])
        for _ in range(_NEWTON_STEPS):
            error = self._distort(estimate) - distorted
            du = (self._distort(estimate + right) - self._distort(estimate - right)) / (2 * step)
            dv = (self._distort(estimate + down) - self._distort(estimate - down)) / (2 * step)
            determinant = du[..., 0] * dv[..., 1] - dv[..., 0] * du[..., 1]
            with np.errstate(divide="ignore", invalid="ignore"):
                estimate = estimate - np.stack(
                    [
                        (dv[..., 1] * error[..., 0] - dv[..., 0] * error[..., 1]) / determinant,
                        (du[..., 0] * error[..., 1] - du[..., 1] * error[..., 0]) / determinant,
                    ],
                    axis=-1,
                )
            if not np.nanmax(np.abs(error), initial=0.0) > 1e-13:
                break
        residual = np.abs(self._distort(estimate) - distorted).max(axis=-1, keepdims=True)
        # a pixel that no direction reaches has a mirrored solution beyond the fold
        return np.where((residual < 1e-8) & self._unfolded(estimate), estimate, np.nan)


def _first_root(coefficients: Array) -> float:
    """Return the smallest positive real root; coefficients from the constant on; inf: none."""
    roots = polynomial.polyroots(np.trim_zeros(coefficients, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def load_camera_yaml(text: str, source: str) -> CameraModel:
    """Read a camera file as ROS ``camera_calibration`` writes it (camera_calibration_parsers).

    Args:
        text: the YAML.
        source: its name, for messages.

    Raises:
        TooltipError: not such a file, or not a known camera.
    """
    data = parse_yaml(text, source)
    wanted = ("image_width", "image_height", "camera_matrix", "distortion_model")
    missing = [key for key in wanted if not isinstance(data, dict) or key not in data]
    if missing:
        raise TooltipError(
            f"{source}: not a ROS camera_info file, it lacks {', '.join(missing)}; "
            "camera_calibration writes such files"
        )
    coefficients = data.get("distortion_coefficients", {"data": []})
    return CameraModel.create(
        width=_pixels(data["image_width"], f"{source}: image_width"),
        height=_pixels(data["image_height"], f"{source}: image_height"),
        matrix=_numbers(data["camera_matrix"], 9, f"{source}: camera_matrix").reshape(3, 3),
        distortion_model=str(data["distortion_model"]),
        distortion=_numbers(coefficients, None, f"{source}: distortion_coefficients").tolist(),
        source=source,
    )


def _pixels(value: Any, where: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise TooltipError(f"{where} must be a whole number of pixels, found {shown(value)}")
    return value


def _numbers(block: Any, count: int | None, where: str) -> Array:
    """Return the numbers under ``data`` of a camera file's matrix."""
    try:
        values = [float(value) for value in block["data"]]
    except (LookupError, TypeError, ValueError, OverflowError):
        values = None
    if values is None or count not in (None, len(values)):
        wanted = "numbers" if count is None else f"{count} numbers"
        raise TooltipError(f"{where} must hold {wanted} under 'data', found {shown(block)}")
    return np.array(values)


def camera_yaml(camera: CameraModel, name: str = "camera") -> str:
    """Return a camera file that ROS tools and :func:`load_camera_yaml` read."""

    def block(array: Array) -> dict[str, Any]:
        rows, cols = array.shape
        return {"rows": rows, "cols": cols, "data": array.ravel().tolist()}

    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": block(camera.matrix),
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": block(np.array([camera.distortion], dtype=float)),
        "rectification_matrix": block(np.eye(3)),
        "projection_matrix": block(np.hstack([camera.matrix, np.zeros((3, 1))])),
    }
    return yaml.safe_dump(document, sort_keys=False)
