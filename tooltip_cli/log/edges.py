"""``STEM.edges.mcap``: the moving edges of frames paired by the hand's motion."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.detections import PROVENANCE
from tooltip_cli.log.messages import MOVING_EDGES, Message
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.method.voting.moving import FrameEdges, MovingEdges, join

TOPIC = "/tooltip/moving_edges"

_EDGE = np.dtype(
    [("pixel", "<u2", 2), ("translation", "i1", (2, 2)), ("covariance", "<f4", (2, 3))]
)


def write_edges(
    path: Path,
    edges: MovingEdges,
    stamps_ns: npt.NDArray[np.int64],
    frame_id: str,
    provenance: Mapping[str, Any],
) -> None:
    """Write moving edges whole or not at all, replacing an older file.

    Args:
        stamps_ns: (N,) image stamps of the recording.
        frame_id: of the images.

    Raises:
        TooltipError: the file cannot be written.
    """
    packed = np.empty(len(edges.pixels), dtype=_EDGE)
    packed["pixel"] = edges.pixels
    packed["translation"] = edges.translations
    packed["covariance"] = edges.covariances
    stops = np.cumsum(edges.counts)
    with LogWriter(path, overwrite=True) as writer:
        for row, stop in enumerate(stops):
            stamp_ns = int(stamps_ns[edges.frames[row]])
            partners = [messages.time_from_ns(int(stamps_ns[i])) for i in edges.partners[row]]
            fields = {
                "header": messages.header(stamp_ns, frame_id),
                "partners": partners,
                "affines": edges.affines[row].ravel().tolist(),
                "count": int(edges.counts[row]),
                "edge_step": _EDGE.itemsize,
                "data": packed[stop - edges.counts[row] : stop].tobytes(),
            }
            writer.write(
                Message(TOPIC, MOVING_EDGES, stamp_ns, messages.encode(MOVING_EDGES, fields))
            )
        writer.attach(PROVENANCE, "application/json", json.dumps(provenance, indent=1).encode())


def read_edges(path: Path, stamps_ns: npt.NDArray[np.int64]) -> MovingEdges:
    """Read moving edges back, frames found by their stamps.

    Args:
        stamps_ns: (N,) image stamps of the recording they belong to.

    Raises:
        TooltipError: unreadable, malformed, or of another recording.
    """
    rows = [
        messages.decode_foreign(MOVING_EDGES, item.payload, str(path))
        for item in iterate(path)
        if not isinstance(item, LoggedAttachment) and item.topic == TOPIC
    ]
    stamps = np.array(
        [
            [messages.ns_from_time(row.header.stamp), *map(messages.ns_from_time, row.partners)]
            for row in rows
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    if not np.isin(stamps, stamps_ns).all():
        raise TooltipError(f"{path} holds moving edges of another recording")
    index = np.searchsorted(stamps_ns, stamps)
    parts = []
    for row in rows:
        if row.edge_step != _EDGE.itemsize or len(row.data) != row.count * _EDGE.itemsize:
            raise TooltipError(f"{path} holds moving edges in a layout that is not read")
        packed = np.frombuffer(row.data, dtype=_EDGE)
        affines = np.array(row.affines, dtype=float).reshape(2, 2, 3)
        parts.append(
            FrameEdges(affines, packed["pixel"], packed["translation"], packed["covariance"])
        )
    return join(index[:, 0], index[:, 1:], parts)
