"""Hand labels on disk: ``stamp_ns,u,v,state,labeler``."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.log.whole import write_file
from tooltip_cli.method.types import TipPixels
from tooltip_cli.rig.camera import CameraModel

COLUMNS = ("stamp_ns", "u", "v", "state", "labeler")
STATES = ("visible", "occluded", "out_of_view")
_MAX_FILE_BYTES = 64 * 2**20


@dataclass(frozen=True)
class TipLabels:
    """Rows of a label file in file order."""

    stamps_ns: npt.NDArray[np.int64]  # (L,) image stamps
    pixels: npt.NDArray[np.float64]  # (L, 2) u, v; NaN unless visible
    states: tuple[str, ...]  # (L,) visible, occluded or out_of_view
    labelers: tuple[str, ...]  # (L,) who placed it
    source: str = "labels"

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class MatchedLabels:
    """Labels of one recording, by image index, ascending."""

    frames: npt.NDArray[np.intp]  # (L,) every labelled frame, visible or not
    visible: TipPixels  # those in which the tip was seen
    labelers: tuple[str, ...]  # distinct, sorted


def read_labels(path: Path) -> TipLabels:
    """Read a label file.

    Raises:
        TooltipError: missing, another header, or a malformed row (named by line).
    """
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise TooltipError(f"{path}: too large for a label file")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TooltipError(f"{path}: labels cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise TooltipError(f"{path}: labels cannot be read (not UTF-8 text)") from error
    return parse_labels(text, str(path))


def parse_labels(text: str, source: str) -> TipLabels:
    """Read the text of a label file.

    Args:
        source: what to call it in messages.

    Raises:
        TooltipError: another header, or a malformed row (named by line).
    """
    try:
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except csv.Error as error:
        raise TooltipError(f"{source}: not a CSV file ({error})") from error
    if not rows or tuple(rows[0]) != COLUMNS:
        found = ",".join(rows[0])[:80] if rows else "an empty file"
        raise TooltipError(f"{source}: expected the header {','.join(COLUMNS)}, found {found}")
    stamps, pixels, states, labelers = [], [], [], []
    seen: dict[int, int] = {}
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        stamp, pixel, state, labeler = _parse_row(row, f"{source}, line {line}")
        if stamp in seen:
            raise TooltipError(
                f"{source}, line {line}: the frame {stamp} is already labelled in line "
                f"{seen[stamp]}"
            )
        seen[stamp] = line
        stamps.append(stamp)
        pixels.append(pixel)
        states.append(state)
        labelers.append(labeler)
    return TipLabels(
        np.array(stamps, dtype=np.int64),
        np.array(pixels, dtype=float).reshape(-1, 2),
        tuple(states),
        tuple(labelers),
        source,
    )


def _parse_row(row: Sequence[str], where: str) -> tuple[int, tuple[float, float], str, str]:
    if len(row) != len(COLUMNS):
        raise TooltipError(f"{where}: expected {len(COLUMNS)} columns, found {len(row)}")
    stamp_text, u_text, v_text, state, labeler = row
    if state not in STATES:
        raise TooltipError(f"{where}: " + one_of("state", state, STATES))
    try:
        stamp = int(stamp_text)
        if not -(2**63) <= stamp < 2**63:
            raise ValueError
        pixel = (float(u_text), float(v_text)) if state == "visible" else (math.nan, math.nan)
    except ValueError:
        raise TooltipError(
            f"{where}: expected an integer stamp_ns and numbers u, v; found "
            f"{stamp_text!r}, {u_text!r}, {v_text!r}"
        ) from None
    if state == "visible" and not all(map(math.isfinite, pixel)):
        raise TooltipError(f"{where}: a visible tip needs finite u, v")
    if state != "visible" and (u_text or v_text):
        raise TooltipError(f"{where}: a tip that is {state} has no u, v; leave them empty")
    return stamp, pixel, state, labeler


def write_labels(path: Path, labels: TipLabels) -> None:
    """Write a label file whole (temporary file and rename), pixels to a hundredth.

    Raises:
        TooltipError: it cannot be written.
    """
    write_file(path, labels_text(labels))


def labels_text(labels: TipLabels) -> str:
    """Return what a label file holds, pixels to a hundredth."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    rows = zip(labels.stamps_ns, labels.pixels, labels.states, labels.labelers, strict=True)
    for stamp, (u, v), state, labeler in rows:
        pixel = (f"{u:.2f}", f"{v:.2f}") if state == "visible" else ("", "")
        writer.writerow([int(stamp), *pixel, state, labeler])
    return out.getvalue()


def match_labels(
    labels: TipLabels, image_stamps_ns: npt.NDArray[np.int64], camera: CameraModel
) -> MatchedLabels:
    """Find the frame of each label by its exact stamp.

    Raises:
        TooltipError: a label's stamp is no image's (another recording), or its pixel lies outside
            the image.
    """
    frames = frames_of(labels, image_stamps_ns)
    visible = np.array([state == "visible" for state in labels.states], dtype=bool)
    outside = visible & ~camera.contains(np.where(visible[:, None], labels.pixels, 0.0))
    if outside.any():
        row = int(np.argmax(outside))
        u, v = labels.pixels[row]
        raise TooltipError(
            f"{labels.source}: the label ({u:.1f}, {v:.1f}) at stamp {labels.stamps_ns[row]} lies "
            f"outside the {camera.width}x{camera.height} image"
        )
    order = np.argsort(frames, kind="stable")
    shown = order[visible[order]]
    pixels = TipPixels(frames[shown], labels.pixels[shown], np.ones(len(shown)))
    return MatchedLabels(frames[order], pixels, tuple(sorted(set(labels.labelers))))


def frames_of(labels: TipLabels, image_stamps_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
    """Return (L,) the image of each label, found by its exact stamp.

    Raises:
        TooltipError: a label's stamp is no image's, so they are of another recording.
    """
    index = np.searchsorted(image_stamps_ns, labels.stamps_ns)
    clipped = np.minimum(index, max(len(image_stamps_ns) - 1, 0)).astype(np.intp)
    unknown = image_stamps_ns[clipped] != labels.stamps_ns
    if unknown.any():
        raise TooltipError(
            f"{labels.source}: {int(unknown.sum())} of {len(labels)} labels have stamps at which "
            f"the recording has no image (first: {labels.stamps_ns[unknown][0]}); are they from "
            "another recording?"
        )
    return clipped
