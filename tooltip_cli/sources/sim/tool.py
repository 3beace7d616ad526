"""What a tool is to the simulator.

Tool frame: origin at the usual grip, x along the handle towards the tip, z towards the ends of
the fingers, y towards the palm. The tip is what a person would label: the point of a pointed
tool, the middle of the end face of a blunt one.
"""

from __future__ import annotations

from dataclasses import dataclass

from tooltip_cli.sources.sim.materials import Material
from tooltip_cli.sources.sim.mesh import Floats, Mesh


@dataclass(frozen=True)
class Tool:
    """A tool in its own frame, m."""

    mesh: Mesh  # material indices count from 0 in ``materials``
    materials: tuple[Material, ...]
    tip: Floats  # (3,)
    axis: Floats  # (3,) unit, the direction in which the tool ends at its tip
    half_depth: float  # half thickness of the handle across the palm
    half_width: float  # half thickness of the handle along the fingers
    slide_m: float = 0.012  # random grasps shift the grip along the handle within +- this
    tilt_deg: tuple[float, float] = (0.0, 32.0)  # usual tilts towards the fingers' ends
    spin_deg: tuple[float, float] = (-25.0, 25.0)  # usual turns in the hand
    other_ends: tuple[Floats, ...] = ()  # ends that are as good as the tip
