"""What a simulated recording is made of: every choice in one frozen, validated object."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tooltip_cli.errors import TooltipError, one_of

TOOLS: tuple[str, ...] = (
    "hot_glue_gun",
    "screwdriver",
    "bottle",
    "electrical_plug",
    "paint_brush",
    "robot_finger",
    "pen",
    "pliers",
    "hammer",
    "scissors",
)
"""The paper's ten tools (figure 2)."""

MOTIONS: tuple[str, ...] = ("sweep", "in_plane", "still", "fast")
"""``sweep``: smooth ramps to random wrist angles (section 4.1). ``in_plane``: the hand turns about
the optical axis alone, so that depth cannot be observed (section 4.4). ``still``: the wrist does
not move. ``fast``: the sweep at three times the speed."""

BACKGROUNDS: tuple[str, ...] = ("auto", "motorcycle", "astronaut", "coffee", "chelsea", "clutter")
"""Photographs that ship inside scikit-image's wheel, a procedural ``clutter`` with the statistics
of photographs, and ``auto``, which lets the seed choose."""


@dataclass(frozen=True)
class SimParams:
    """Parameters of one simulated recording; equal parameters give equal bytes.

    Raises:
        TooltipError: a name is unknown or a number out of its range; the message says which
            names or range are valid.
    """

    tool: str
    frames: int = 500
    seed: int = 0
    size: tuple[int, int] = (640, 480)  # width, height, px
    fps: float = 30.0
    joint_rate_hz: float = 100.0
    noise_sigma: float = 2.0  # grey levels (of 255) at mid grey
    jpeg_quality: int = 90
    shutter: float = 0.4  # exposure as a fraction of the frame period
    head_motion_deg: float = 0.0  # the head nods and turns within +- this
    background: str = "auto"
    grip_offset_m: float = 0.0  # shift of the tool along its handle, towards the tip
    tilt_deg: float | None = None  # tool axis towards the fingers' ends; None: the seed chooses
    motion: str = "sweep"
    limit_deg: float = 60.0  # wrist pitch and roll stay within +- this
    time_offset_s: float = 0.0  # joint stamps are late by this
    joint_noise_rad: float = 2e-4  # standard deviation of the encoders

    def __post_init__(self) -> None:
        for kind, name, known in (
            ("tool", self.tool, TOOLS),
            ("motion", self.motion, MOTIONS),
            ("background", self.background, BACKGROUNDS),
        ):
            if name not in known:
                raise TooltipError(one_of(kind, name, known))
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise TooltipError(f"{name} is {value}; expected {low:g} to {high:g}")
        width, height = self.size
        if not (64 <= width <= 4096 and 48 <= height <= 4096):
            raise TooltipError(
                f"size is {width}x{height}; expected 64x48 to 4096x4096 pixels (width x height)"
            )


_RANGES: tuple[tuple[str, float, float], ...] = (
    ("frames", 1, 100_000),
    ("seed", 0, 2**63 - 1),
    ("fps", 1.0, 240.0),
    ("joint_rate_hz", 5.0, 2000.0),
    ("noise_sigma", 0.0, 50.0),
    ("jpeg_quality", 1, 100),
    ("shutter", 0.0, 1.0),
    ("head_motion_deg", 0.0, 5.0),
    ("grip_offset_m", -0.03, 0.03),
    ("tilt_deg", -45.0, 45.0),
    ("limit_deg", 1.0, 75.0),
    ("time_offset_s", -1.0, 1.0),
    ("joint_noise_rad", 0.0, 0.1),
)
