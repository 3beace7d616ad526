"""Shapes in the hand frame: ``foxglove_msgs/SceneUpdate``, and transforms for ``/tf``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.log import messages
from tooltip_cli.log.annotations import Color
from tooltip_cli.rig.kinematics import quaternion_from_rotation

Array = npt.NDArray[np.float64]
_LINE_LIST = 2


def transform_message(transforms: Iterable[tuple[str, str, Array]], stamp_ns: int) -> bytes:
    """Return a TFMessage of (parent, child, (4, 4) parent_from_child)."""
    return messages.encode(
        messages.TF_MESSAGE,
        {"transforms": [transform_stamped(stamp_ns, *item) for item in transforms]},
    )


def transform_stamped(
    stamp_ns: int, parent: str, child: str, parent_from_child: Array
) -> dict[str, Any]:
    """Return a ``geometry_msgs/TransformStamped``."""
    return {
        "header": messages.header(stamp_ns, parent),
        "child_frame_id": child,
        "transform": {
            "translation": _xyz(parent_from_child[:3, 3]),
            "rotation": _xyzw(parent_from_child[:3, :3]),
        },
    }


def scene_message(entities: Sequence[dict[str, Any]]) -> bytes:
    """Return a SceneUpdate that adds or replaces entities."""
    return messages.encode(messages.SCENE_UPDATE, {"entities": list(entities)})


def entity(
    name: str, stamp_ns: int, frame_id: str, **shapes: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return an entity that moves with its frame and stays until it is replaced."""
    return {
        "timestamp": messages.time_from_ns(stamp_ns),
        "frame_id": frame_id,
        "id": name,
        "frame_locked": True,
        **shapes,
    }


def sphere(center: Array, radius: float, color: Color) -> dict[str, Any]:
    """Return a ball; metres."""
    return {"pose": _pose(center), "size": _xyz(np.full(3, 2 * radius)), "color": color}


def ellipsoid(center: Array, covariance: Array, deviations: float, color: Color) -> dict[str, Any]:
    """Return the surface that lies so many standard deviations from a centre.

    Args:
        covariance: (3, 3) square metres.
    """
    variances, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]  # a rotation, not a mirror
    diameters = 2 * deviations * np.sqrt(np.maximum(variances, 0.0))
    return {"pose": _pose(center, axes), "size": _xyz(diameters), "color": color}


def segments(starts: Array, ends: Array, color: Color, width_px: float) -> dict[str, Any]:
    """Return lines from (N, 3) to (N, 3), metres, of a width in pixels of the screen."""
    points = np.stack([starts, ends], axis=1).reshape(-1, 3)
    return {
        "type": _LINE_LIST,
        "pose": _pose(np.zeros(3)),
        "thickness": width_px,
        "scale_invariant": True,
        "points": [_xyz(point) for point in points],
        "color": color,
    }


def caption(place: Array, text: str, color: Color) -> dict[str, Any]:
    """Return text that faces the viewer."""
    return {
        "pose": _pose(place),
        "billboard": True,
        "font_size": 14.0,
        "scale_invariant": True,
        "color": color,
        "text": text,
    }


def _pose(position: Array, rotation: Array | None = None) -> dict[str, Any]:
    rotation = np.eye(3) if rotation is None else rotation
    return {"position": _xyz(position), "orientation": _xyzw(rotation)}


def _xyz(values: Array) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _xyzw(rotation: Array) -> dict[str, float]:
    return dict(zip("xyzw", map(float, quaternion_from_rotation(rotation)), strict=True))
