"""Point clouds as PLY files, which MeshLab, CloudCompare, Open3D and Blender read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.log.whole import write_file

Array = npt.NDArray[np.float64]

_LAYOUT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
     ("frames", "<i4")]
)  # fmt: skip


def write_ply(
    path: Path, points: Array, colors: npt.NDArray[np.uint8], frames: npt.NDArray[np.int64],
    comment: str,
) -> None:  # fmt: skip
    """Write points (P, 3), metres, with colours (P, 3) and how many frames show each (P,).

    Source: the PLY polygon file format, binary_little_endian 1.0.

    Raises:
        TooltipError: the file cannot be written.
    """
    rows = np.zeros(len(points), dtype=_LAYOUT)
    for index, name in enumerate("xyz"):
        rows[name] = points[:, index]
    for index, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, index]
    rows["frames"] = frames
    kinds = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
    properties = "".join(
        f"property {kinds[_LAYOUT[name].str]} {name}\n" for name in _LAYOUT.names or ()
    )
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment {' '.join(comment.split())}\nelement vertex {len(rows)}\n{properties}end_header\n"
    )
    write_file(path, header.encode() + rows.tobytes())
