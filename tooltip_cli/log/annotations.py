"""Marks over the video: ``foxglove_msgs/ImageAnnotations``.

Foxglove counts pixels from the corner of the first one, this program from its centre: half a pixel
is added to both coordinates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tooltip_cli.log import messages

Color = dict[str, float]

BLACK = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 1.0}
WHITE = {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}
GREEN = {"r": 0.1, "g": 0.9, "b": 0.2, "a": 1.0}
YELLOW = {"r": 1.0, "g": 0.85, "b": 0.0, "a": 1.0}

_LINE_LIST = 4
_THICKNESS = 1.5
_ARM = 12.0  # pixels


def rings(
    stamp_ns: int, u: float, v: float, inner: dict[str, float], outer: dict[str, float]
) -> bytes:
    """Return two rings around a pixel, one in the other, to be seen on any background.

    Where the pixel is not finite the message is empty, which clears what was shown before.
    """
    if not np.isfinite([u, v]).all():
        return messages.encode(messages.IMAGE_ANNOTATIONS, {})
    circles = [
        {
            "timestamp": messages.time_from_ns(stamp_ns),
            "position": _corner(u, v),
            "diameter": diameter,
            "thickness": _THICKNESS,
            "outline_color": color,
        }
        for diameter, color in ((12.0, inner), (15.0, outer))
    ]
    return messages.encode(messages.IMAGE_ANNOTATIONS, {"circles": circles})


def cross(stamp_ns: int, u: float, v: float, color: Color) -> bytes:
    """Return an upright cross on a pixel; empty where it is not finite."""
    if not np.isfinite([u, v]).all():
        return messages.encode(messages.IMAGE_ANNOTATIONS, {})
    ends = [(u - _ARM, v), (u + _ARM, v), (u, v - _ARM), (u, v + _ARM)]
    lines: dict[str, Any] = {
        "timestamp": messages.time_from_ns(stamp_ns),
        "type": _LINE_LIST,
        "points": [_corner(*end) for end in ends],
        "outline_color": color,
        "thickness": _THICKNESS,
    }
    return messages.encode(messages.IMAGE_ANNOTATIONS, {"points": [lines]})


def _corner(u: float, v: float) -> dict[str, float]:
    return {"x": float(u) + 0.5, "y": float(v) + 0.5}
