"""The paper's ten tools (figure 2) at their real sizes, by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.sources.sim import household, workshop
from tooltip_cli.sources.sim.tool import Tool

HELD: dict[str, Callable[[np.random.Generator], Tool]] = {
    "hot_glue_gun": workshop.hot_glue_gun,
    "screwdriver": workshop.screwdriver,
    "bottle": household.bottle,
    "electrical_plug": household.electrical_plug,
    "paint_brush": household.paint_brush,
    "pen": household.pen,
    "pliers": workshop.pliers,
    "hammer": workshop.hammer,
    "scissors": household.scissors,
}
"""All but the robot's finger, which is part of the hand."""


def build(name: str, rng: np.random.Generator) -> Tool:
    """Return the named tool with wear drawn from ``rng``.

    Raises:
        TooltipError: no such tool, or one that is not held (the robot's finger).
    """
    if name not in HELD:
        raise TooltipError(one_of("tool", name, HELD))
    return HELD[name](rng)
