"""The quantities that the method passes between its steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class TipPixels:
    """Where the tip was seen: detections and hand labels alike."""

    frames: Indices  # (N,) image indices of the recording
    pixels: Array  # (N, 2) u, v; integer at pixel centres
    weights: Array  # (N,) Mahalanobis distances of detections; ones for labels

    def select(self, keep: Mask) -> TipPixels:
        """Return the rows where ``keep`` (N,) is true."""
        return TipPixels(self.frames[keep], self.pixels[keep], self.weights[keep])


@dataclass(frozen=True)
class Rays:
    """Viewing rays in the hand frame (paper, 3.2)."""

    frames: Indices  # (N,) image indices
    origins: Array  # (N, 3) optical centres, metres
    directions: Array  # (N, 3) unit vectors

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, keep: Mask | Indices) -> Rays:
        """Return the chosen rows."""
        return Rays(self.frames[keep], self.origins[keep], self.directions[keep])


@dataclass(frozen=True)
class Candidate:
    """One place where the tip may be."""

    position: Array  # (3,) metres, hand frame
    support: float  # share of the evidence that speaks for it, 0 to 1
    covariance: Array | None = None  # (3, 3) m^2; None: not known for this place
    axis: Array | None = None  # (3,) unit vector out of the tool's end, hand frame
    axis_std: float | None = None  # rad, standard deviation of its direction either way
    agreement: float | None = None  # share of the images that agree on it; None: too few show it


@dataclass(frozen=True)
class Correction:
    """What is to be put right about clocks and camera."""

    time_offset: float = 0.0  # seconds to add to image stamps
    rotation: Array | None = None  # (3,) rotation vector, rad, camera frame; None: not asked for
    translation: Array | None = None  # (3,) metres, camera frame

    @property
    def corrected_from_camera(self) -> Array:
        """(4, 4): takes points in the camera's frame as it was said to where it really is."""
        result = np.eye(4)
        if self.rotation is None or self.translation is None:
            return result
        result[:3, 3] = self.translation
        angle = float(np.linalg.norm(self.rotation))
        if angle > 0:  # Rodrigues' formula
            x, y, z = self.rotation / angle
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            result[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
        return result


@dataclass(frozen=True)
class Reason:
    """Why an estimate is refused or qualified."""

    code: str  # machine-readable, e.g. depth_unobservable
    text: str  # a sentence for a person


@dataclass(frozen=True)
class Refinement:
    """What was found out about clocks and camera, and whether it was used."""

    correction: Correction
    deviations: Array  # (1,) or (7,) standard deviations of offset, rotation and translation
    applied: bool  # clearly more frames fit with it
    support_before: float  # share of what images could show of the end that fits
    support_after: float
    # (3, 3) m^2, of each recording's tip: what is still unknown of clocks and camera
    tip_covariances: tuple[Array, ...] = ()


@dataclass(frozen=True)
class TipEstimate:
    """The tip in the hand frame, or the reasons why it is not known."""

    method: str
    position: Array | None  # (3,) metres, hand frame; None: refused
    covariance: Array | None  # (3, 3) m^2
    candidates: tuple[Candidate, ...]  # the first is the estimate
    reasons: tuple[Reason, ...]
    frames_used: int
    refinement: Refinement | None = None  # of the rig, where it was asked for

    @property
    def status(self) -> str:
        """``ok`` or ``refused``."""
        return "refused" if self.position is None else "ok"


def refused(method: str, frames_used: int, *reasons: Reason) -> TipEstimate:
    """Return an estimate that states no position."""
    return TipEstimate(method, None, None, (), tuple(reasons), frames_used)


def largest_std(covariance: Array) -> float:
    """Return the standard deviation, metres, in the direction where it is largest.

    Args:
        covariance: (3, 3) m^2.
    """
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
