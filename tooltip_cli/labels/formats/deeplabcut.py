"""DeepLabCut's table of hand labels, ``CollectedData_SCORER.csv``.

Format: three header rows (scorer, bodyparts, coords), four with individuals; the image's path is in
the first column, or in the first three as folder, video and file. An empty cell is no label.
Pixels have their centres at integers, as in the labelling window's image view.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.formats.base import POINT, Album, Foreign, Mark, malformed

TOOL = "DeepLabCut"
_EMPTY = "empty: not labelled"
_FIRST = {"scorer", "individuals", "bodyparts", "coords"}


@dataclass(frozen=True)
class _Column:
    scorer: str
    point: str
    u: int  # places in a row
    v: int


def is_deeplabcut(text: str) -> bool:
    """Say whether a text begins as DeepLabCut's tables do."""
    return text.startswith("scorer,")


def read_deeplabcut(text: str, source: str) -> Foreign:
    """Read a table of hand labels.

    Raises:
        TooltipError: it is malformed, or a network's output.
    """
    left_out: Counter[str] = Counter()
    try:
        rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
        header = {row[0]: row for row in rows[:4] if row[0] in _FIRST}
        if "likelihood" in header["coords"]:
            raise TooltipError(
                f"{source}: it has likelihoods, so a network placed these points; expected "
                "CollectedData_SCORER.csv, the labels by hand"
            )
        index = next(place for place, cell in enumerate(header["coords"]) if cell in ("x", "y"))
        columns = tuple(_columns(header, index))
        marks = tuple(
            mark
            for row in rows[len(header) :]
            for mark in _marks(row, row[index - 1], columns, left_out)
        )
    except (csv.Error, KeyError, ValueError, IndexError, StopIteration) as error:
        raise malformed(source, TOOL, error) from error
    return Foreign(source, TOOL, False, marks, left_out)


def _columns(header: dict[str, list[str]], index: int) -> Iterator[_Column]:
    coords = header["coords"]
    animals = header.get("individuals", [])
    several = len({name for name in animals[index:] if name}) > 1
    for u in range(index, len(coords), 2):
        if coords[u : u + 2] != ["x", "y"]:
            raise ValueError(f"expected x, y from column {u + 1} on, found {coords[u : u + 2]}")
        part = header["bodyparts"][u]
        yield _Column(header["scorer"][u], f"{animals[u]}/{part}" if several else part, u, u + 1)


def _marks(
    row: list[str], image: str, columns: tuple[_Column, ...], left_out: Counter[str]
) -> Iterator[Mark]:
    for column in columns:
        u, v = (float(row[place] or "nan") for place in (column.u, column.v))
        if math.isnan(u) or math.isnan(v):
            left_out[_EMPTY] += 1
        else:
            yield Mark(image, column.point, "visible", (u, v), column.scorer)


def write_deeplabcut(album: Album) -> str:
    """Return labels as a table; a tip without a place is an empty cell, its state is lost."""
    scorers = sorted({frame.label.labeler for frame in album.frames if frame.label})
    scorer = scorers[0] if len(scorers) == 1 else "several"
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["scorer", "", "", scorer, scorer])
    writer.writerow(["bodyparts", "", "", POINT, POINT])
    writer.writerow(["coords", "", "", "x", "y"])
    for frame in album.frames:
        pixel = frame.label.pixel if frame.label else None
        cells = ("", "") if pixel is None else tuple(f"{value:.2f}" for value in pixel)
        writer.writerow(["labeled-data", album.name, frame.name, *cells])
    return out.getvalue()
