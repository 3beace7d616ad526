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


@dataclass(frozen=True)
class Reason:
    """Why an estimate is refused or qualified."""

    code: str  # machine-readable, e.g. depth_unobservable
    text: str  # a sentence for a person


@dataclass(frozen=True)
class TipEstimate:
    """The tip in the hand frame, or the reasons why it is not known."""

    method: str
    position: Array | None  # (3,) metres, hand frame; None: refused
    covariance: Array | None  # (3, 3) m^2
    candidates: tuple[Candidate, ...]  # the first is the estimate
    reasons: tuple[Reason, ...]
    frames_used: int

    @property
    def status(self) -> str:
        """``ok`` or ``refused``."""
        return "refused" if self.position is None else "ok"


def refused(method: str, frames_used: int, *reasons: Reason) -> TipEstimate:
    """Return an estimate that states no position."""
    return TipEstimate(method, None, None, (), tuple(reasons), frames_used)
