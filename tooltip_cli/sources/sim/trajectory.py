"""Smooth random motion: ramps between random positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tooltip_cli.sources.sim.mesh import Floats


@dataclass(frozen=True)
class Ramps:
    """Raised-cosine ramps of one joint between targets, at rest only at the targets."""

    times: Floats  # (n,) s, increasing
    targets: Floats  # (n,) rad

    def at(self, times: Floats) -> Floats:
        """Return the joint position at any times (K,), s; constant before and after."""
        index = np.clip(
            np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2
        )
        start, stop = self.times[index], self.times[index + 1]
        s = np.clip((times - start) / (stop - start), 0.0, 1.0)
        share = 0.5 - 0.5 * np.cos(np.pi * s)
        return self.targets[index] + share * (self.targets[index + 1] - self.targets[index])


def random_ramps(
    rng: np.random.Generator,
    span: tuple[float, float],
    limit: float,
    seconds: tuple[float, float] = (1.0, 2.0),
) -> Ramps:
    """Return ramps over a span of time to random positions within +- limit.

    Each ramp takes a random number of ``seconds``. Short ramps to nearby targets would leave the
    joint nearly at rest, so a target lies at least a quarter of the range from the one before.
    The first ramp is under way when the span begins, as when logging starts during motion.
    """
    times = [span[0] - float(rng.uniform(0.2, 0.8)) * seconds[0]]
    targets = [float(rng.uniform(-limit, limit))]
    while times[-1] < span[1] or len(times) < 2:
        times.append(times[-1] + float(rng.uniform(*seconds)))
        target = float(rng.uniform(-limit, limit))
        while abs(target - targets[-1]) < 0.5 * limit:
            target = float(rng.uniform(-limit, limit))
        targets.append(target)
    return Ramps(np.array(times), np.array(targets))


def rest(position: float = 0.0) -> Ramps:
    """Return a joint that does not move."""
    return Ramps(np.array([0.0, 1.0]), np.array([position, position]))
