"""``STEM.edges.mcap``: moving edges and silhouettes of frames paired by the hand's motion."""

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
from tooltip_cli.log.messages import MOVING_EDGES, SILHOUETTE, Message
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.method.voting.moving import FrameEdges, MovingEdges, join
from tooltip_cli.method.voting.silhouette import FrameSilhouette

TOPIC = "/tooltip/moving_edges"
SILHOUETTE_TOPIC = "/tooltip/silhouettes"

_EDGE = np.dtype(
    [("pixel", "<u2", 2), ("translation", "i1", (2, 2)), ("covariance", "<f4", (2, 3))]
)
_POINT_BYTES = 8
_PNG_FILTER, _NO_FILTER = 19, 8  # as OpenCV numbers them from 4.12 on; before, it passes them over


def write_edges(
    path: Path,
    edges: MovingEdges,
    stamps_ns: npt.NDArray[np.int64],
    frame_id: str,
    provenance: Mapping[str, Any],
) -> None:
    """Write moving edges and silhouettes whole or not at all, replacing an older file.

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
    silhouettes = edges.silhouettes
    corners = np.cumsum(silhouettes.counts) if silhouettes is not None else stops
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
            if silhouettes is not None:
                points = slice(corners[row] - silhouettes.counts[row], corners[row])
                fields = {
                    "header": messages.header(stamp_ns, frame_id),
                    "scale": silhouettes.scale,
                    "mask": _png(silhouettes.masks[row]),
                    "count": int(silhouettes.counts[row]),
                    "contour": silhouettes.contours[points].astype("<f4").tobytes(),
                }
                payload = messages.encode(SILHOUETTE, fields)
                writer.write(Message(SILHOUETTE_TOPIC, SILHOUETTE, stamp_ns, payload))
        writer.attach(PROVENANCE, "application/json", json.dumps(provenance, indent=1).encode())


def _png(mask: npt.NDArray[np.uint8]) -> bytes:
    import cv2

    # trying filters on rows of three values takes three quarters of the time and saves nothing
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, _PNG_FILTER, _NO_FILTER]
    return bytes(cv2.imencode(".png", mask, options)[1])


def read_edges(path: Path, stamps_ns: npt.NDArray[np.int64]) -> MovingEdges:
    """Read moving edges and silhouettes back, frames found by their stamps.

    Args:
        stamps_ns: (N,) image stamps of the recording they belong to.

    Raises:
        TooltipError: unreadable, malformed, or of another recording.
    """
    rows: list[Any] = []
    shown: dict[int, FrameSilhouette] = {}
    for item in iterate(path):
        if isinstance(item, LoggedAttachment):
            continue
        if item.topic == TOPIC:
            rows.append(messages.decode_foreign(MOVING_EDGES, item.payload, str(path)))
        elif item.topic == SILHOUETTE_TOPIC:
            row = messages.decode_foreign(SILHOUETTE, item.payload, str(path))
            shown[messages.ns_from_time(row.header.stamp)] = _silhouette(row, path)
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
    for row, stamp_ns in zip(rows, stamps[:, 0], strict=True):
        if row.edge_step != _EDGE.itemsize or len(row.data) != row.count * _EDGE.itemsize:
            raise TooltipError(f"{path} holds moving edges in a layout that is not read")
        packed = np.frombuffer(row.data, dtype=_EDGE)
        parts.append(
            FrameEdges(
                np.array(row.affines, dtype=float).reshape(2, 2, 3),
                packed["pixel"],
                packed["translation"],
                packed["covariance"],
                shown.get(int(stamp_ns)),
            )
        )
    return join(index[:, 0], index[:, 1:], parts)


def _silhouette(row: Any, path: Path) -> FrameSilhouette:
    import cv2

    data = np.frombuffer(bytes(row.mask), dtype=np.uint8)
    mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if mask is None or row.scale < 1 or len(row.contour) != _POINT_BYTES * row.count:
        raise TooltipError(f"{path} holds silhouettes in a layout that is not read")
    contour = np.frombuffer(row.contour, dtype="<f4").astype(np.float32).reshape(-1, 2)
    return FrameSilhouette(np.asarray(mask, dtype=np.uint8), int(row.scale), contour)
