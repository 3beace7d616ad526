"""The results table: one row a recording, as CSV and Parquet."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tooltip_cli.errors import MissingExtraError, TooltipError

OK, REFUSED, FAILED = "ok", "refused", "failed"


@dataclass(frozen=True)
class Row:
    """What became of one recording; lengths in metres in the hand frame. None: there is none."""

    name: str  # in the shelf
    recording: str  # path
    rig: str | None  # path, where one was given
    labels: str | None  # path, where some were found
    tool: str | None
    status: str  # ok, refused, or failed
    code: str | None = None  # the first reason why it is not ok, or what to keep in mind
    reason: str | None = None  # the same in words
    method: str | None = None
    frames_used: int | None = None  # images behind the estimate
    tip_x_m: float | None = None
    tip_y_m: float | None = None
    tip_z_m: float | None = None
    cov_xx_m2: float | None = None
    cov_xy_m2: float | None = None
    cov_xz_m2: float | None = None
    cov_yy_m2: float | None = None
    cov_yz_m2: float | None = None
    cov_zz_m2: float | None = None
    error_px: float | None = None  # mean over the scored test frames (paper, 4.3)
    baseline_px: float | None = None  # of the estimate from the labels
    tip_error_mm: float | None = None  # to the true tip; simulated recordings only
    scored: int | None = None  # test frames with a visible label
    rig_id: str | None = None  # the same for equal rigs and cameras, wherever they are stored
    recorded: str | None = None  # stamp of the first image, ISO 8601, UTC
    frames: int | None = None  # images
    bytes: int | None = None  # of the recording
    seconds_estimate: float | None = None  # wall time, detection included
    seconds_evaluate: float | None = None
    seconds: float | None = None  # everything, reading included
    version: str | None = None  # of the program
    created: str | None = None  # ISO 8601, UTC
    recording_sha256: str | None = None
    estimate_key: str | None = None  # of STEM.tip.json
    tip_file: str | None = None  # STEM.tip.json
    columns: Mapping[str, Any] = field(default_factory=dict)  # the manifest's own


COLUMNS = tuple(item.name for item in dataclasses.fields(Row) if item.name != "columns")
_TYPES = {item.name: str(item.type).split(" ")[0] for item in dataclasses.fields(Row)}


def row_from_document(document: Mapping[str, Any]) -> Row:
    """Read a row back from what JSON holds.

    Raises:
        TooltipError: it is none.
    """
    try:
        return Row(**document)
    except TypeError as error:
        raise TooltipError(f"not a row of a results table ({error})") from error


def other_columns(rows: Iterable[Row]) -> tuple[str, ...]:
    """Return the manifest's own columns in the order of their first appearance."""
    return tuple(dict.fromkeys(name for row in rows for name in row.columns))


def csv_table(rows: Sequence[Row]) -> str:
    """Return the table as CSV; what there is not is empty."""
    others = other_columns(rows)
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow((*COLUMNS, *others))
    for row in rows:
        cells = [getattr(row, name) for name in COLUMNS]
        writer.writerow([*cells, *(row.columns.get(name) for name in others)])
    return out.getvalue()


def parquet_table(rows: Sequence[Row]) -> bytes:
    """Return the table as a Parquet file.

    A manifest's column whose cells are of several kinds becomes text.

    Raises:
        MissingExtraError: PyArrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("a Parquet table", "shelf", "pyarrow") from None
    kinds = {"str": pa.string(), "int": pa.int64(), "float": pa.float64()}
    columns = {
        name: pa.array([getattr(row, name) for row in rows], kinds[_TYPES[name]])
        for name in COLUMNS
    }
    for name in other_columns(rows):
        cells = [row.columns.get(name) for row in rows]
        if len({type(cell) for cell in cells if cell is not None}) > 1:
            cells = [None if cell is None else str(cell) for cell in cells]
        columns[name] = pa.array(cells)
    sink = pa.BufferOutputStream()
    pyarrow.parquet.write_table(pa.table(columns), sink)
    return bytes(sink.getvalue())
