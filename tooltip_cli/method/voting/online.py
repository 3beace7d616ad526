"""Frames chosen while they arrive: the same pairs, and orientations spread as well as may be."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.pairing import displacement, find_partners, probe_pixels
from tooltip_cli.method.voting.params import PairingParams

_REMEMBERED = 1800  # motions from image to image, whose median says how fast the hand is


@dataclass(frozen=True)
class Decided:
    """An image whose neighbourhood is complete."""

    frame: int  # running number of the image
    partners: tuple[int, int] | None  # images before and after; None: it cannot be used
    displacements: tuple[float, float]  # pixels that the probes move by
    level: int  # how often images are halved for that to fit the search window; -1: no partners


class CausalPairing:
    """Finds the partners that :func:`~tooltip_cli.method.voting.pairing.pair_frames` would.

    An image is decided once as many have followed as lie at most between partners.

    Args:
        focal_px: pixels per unit of normalized coordinates.
    """

    def __init__(self, focal_px: float, params: PairingParams) -> None:
        self._focal, self._params = focal_px, params
        self._probes: deque[Array] = deque(maxlen=2 * params.max_gap + 1)
        self._moved: deque[float] = deque(maxlen=_REMEMBERED)
        self._count = 0  # images that have come
        self._decided = 0

    @property
    def oldest(self) -> int:
        """The first image that may still be a partner of one to come, or be decided."""
        return max(self._count - len(self._probes), 0)

    @property
    def fastest_px(self) -> float:
        """Median motion of the probes from image to image, pixels."""
        known = [pixels for pixels in self._moved if np.isfinite(pixels)]
        return float(np.median(known)) if known else 0.0

    def add(self, camera_from_hand: Array) -> list[Decided]:
        """Take the pose (4, 4) at the next image, NaN where it is unknown or must not be used."""
        probes = probe_pixels(camera_from_hand[None], self._focal, self._params)
        if self._probes:
            self._moved.append(float(displacement(self._probes[-1][None], probes)[0]))
        self._probes.append(probes[0])
        self._count += 1
        return self._decide(self._count - self._params.max_gap)

    def finish(self) -> list[Decided]:
        """Decide the images that are left, for no more will come."""
        return self._decide(self._count)

    def _decide(self, until: int) -> list[Decided]:
        if until <= self._decided:
            return []
        frames, first = range(self._decided, until), self.oldest
        self._decided = until
        rows = np.arange(frames.start, frames.stop) - first
        partners, moved, levels = find_partners(np.array(self._probes), rows, self._params)
        return [
            Decided(
                frame,
                (first + int(pair[0]), first + int(pair[1])) if (pair >= 0).all() else None,
                (float(pixels[0]), float(pixels[1])),
                int(level),
            )
            for frame, pair, pixels, level in zip(frames, partners, moved, levels, strict=True)
        ]


class Spread:
    """Keeps a bounded number of points far from one another, as they come.

    While there is room everything is kept. Afterwards a point that is farther from all than the two
    closest are from each other takes the place of one of these two. A point of a lower rank is
    always kept before one of a higher: it takes such a one's place, and only among those of the
    highest rank are others given up for their distance.

    Args:
        capacity: points that are kept.
        dimensions: coordinates of a point.
    """

    def __init__(self, capacity: int, dimensions: int) -> None:
        self._points = np.zeros((capacity, dimensions))
        self._ranks = np.zeros(capacity, dtype=np.intp)
        self._distances = np.full((capacity, capacity), np.inf)
        self._count = 0

    @property
    def full(self) -> bool:
        """Whether every further point takes the place of another."""
        return self._count == len(self._points)

    def place_for(self, point: Array, rank: int = 0) -> int | None:
        """Return the place that a point (D,) should take; None: it would not spread them more."""
        if not self.full:
            return self._count
        worst = int(self._ranks.max())
        if rank > worst:
            return None
        replaceable = np.flatnonzero(self._ranks == worst)
        distances = self._distances[replaceable]
        row, second = divmod(int(np.argmin(distances)), len(self._points))
        first = int(replaceable[row])
        if rank == worst and self._to_all(point).min() <= distances[row, second]:
            return None
        if self._ranks[second] < worst:
            return first
        # of the two, the one that has another near it as well is missed less
        others = np.sort(self._distances[[first, second]], axis=1)[:, 1]
        return first if others[0] <= others[1] else second

    def put(self, place: int, point: Array, rank: int = 0) -> None:
        """Put a point (D,) where :meth:`place_for` said."""
        self._points[place], self._ranks[place] = point, rank
        self._count = max(self._count, place + 1)
        distances = self._to_all(point)
        distances[self._count :] = np.inf
        distances[place] = np.inf
        self._distances[place] = self._distances[:, place] = distances

    def _to_all(self, point: Array) -> Array:
        return np.asarray(np.linalg.norm(self._points - point, axis=1))
