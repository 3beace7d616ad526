"""A simulated robot that holds a tool before its camera: recordings with known truth."""

from __future__ import annotations

from tooltip_cli.sources.sim.params import BACKGROUNDS, MOTIONS, TOOLS, SimParams
from tooltip_cli.sources.sim.render import SimFrame, render_frames, truth
from tooltip_cli.sources.sim.simulation import Simulation, simulate

__all__ = [
    "BACKGROUNDS",
    "MOTIONS",
    "TOOLS",
    "SimFrame",
    "SimParams",
    "Simulation",
    "render_frames",
    "simulate",
    "truth",
]
