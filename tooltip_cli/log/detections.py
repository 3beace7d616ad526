"""``STEM.detections.mcap``: one TipDetection per pair, and annotations to see them by."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.annotations import BLACK, WHITE, rings
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.method.detector import Detections

TOPIC = "/tooltip/detections"
ANNOTATIONS_TOPIC = "/tooltip/detection_annotations"
PROVENANCE = "provenance.json"


def write_detections(
    path: Path,
    detections: Detections,
    stamps_ns: npt.NDArray[np.int64],
    frame_id: str,
    provenance: Mapping[str, Any],
) -> None:
    """Write detections whole or not at all, replacing an older file.

    Args:
        stamps_ns: (N,) image stamps of the recording.
        frame_id: of the images.

    Raises:
        TooltipError: the file cannot be written.
    """
    with LogWriter(path, overwrite=True) as writer:
        for row in range(len(detections.frames)):
            stamp_ns = int(stamps_ns[detections.frames[row]])
            partner_ns = int(stamps_ns[detections.partners[row]])
            u, v = map(float, detections.pixels[row])
            fields = {
                "header": messages.header(stamp_ns, frame_id),
                "partner": messages.time_from_ns(partner_ns),
                "u": u,
                "v": v,
                "weight": float(detections.weights[row]),
                "affine": detections.affines[row].ravel().tolist(),
                "edges": int(detections.edges[row]),
                "background_edges": int(detections.background_edges[row]),
                "flags": list(detections.flags[row]),
            }
            payload = messages.encode(messages.TIP_DETECTION, fields)
            writer.write(Message(TOPIC, messages.TIP_DETECTION, stamp_ns, payload))
            annotation = rings(stamp_ns, u, v, inner=BLACK, outer=WHITE)
            writer.write(
                Message(ANNOTATIONS_TOPIC, messages.IMAGE_ANNOTATIONS, stamp_ns, annotation)
            )
        document = json.dumps(provenance, indent=1).encode()
        writer.attach(PROVENANCE, "application/json", document)


def read_provenance(path: Path) -> dict[str, Any] | None:
    """Return a detections file's provenance; None where it is absent, damaged or another file."""
    try:
        for item in iterate(path):
            if isinstance(item, LoggedAttachment) and item.name == PROVENANCE:
                document = json.loads(item.data)
                return document if isinstance(document, dict) else None
    except (TooltipError, ValueError):
        pass
    return None


def read_detections(path: Path, stamps_ns: npt.NDArray[np.int64]) -> Detections:
    """Read detections back, frames found by their stamps.

    Args:
        stamps_ns: (N,) image stamps of the recording they belong to.

    Raises:
        TooltipError: unreadable, or of another recording.
    """
    rows = [
        messages.decode_foreign(messages.TIP_DETECTION, item.payload, str(path))
        for item in iterate(path)
        if not isinstance(item, LoggedAttachment) and item.topic == TOPIC
    ]
    firsts = np.array([messages.ns_from_time(row.header.stamp) for row in rows], dtype=np.int64)
    seconds = np.array([messages.ns_from_time(row.partner) for row in rows], dtype=np.int64)
    if not np.isin(np.concatenate([firsts, seconds]), stamps_ns).all():
        raise TooltipError(f"{path} holds detections of another recording")
    return Detections(
        frames=np.searchsorted(stamps_ns, firsts),
        partners=np.searchsorted(stamps_ns, seconds),
        pixels=np.array([[row.u, row.v] for row in rows], dtype=float).reshape(-1, 2),
        weights=np.array([row.weight for row in rows], dtype=float),
        affines=np.array([row.affine for row in rows], dtype=float).reshape(-1, 2, 3),
        edges=np.array([row.edges for row in rows], dtype=np.int64),
        background_edges=np.array([row.background_edges for row in rows], dtype=np.int64),
        flags=tuple(tuple(row.flags) for row in rows),
    )
