"""CSV tables of joint angles, hand poses and image stamps.

Every table begins with a header line and has one time column: ``stamp_ns`` in whole nanoseconds
or ``stamp`` in seconds. Joint tables have one further column a joint, named as the joint, in rad
or m; pose tables have ``x,y,z`` in metres and ``qx,qy,qz,qw``; stamp tables have ``file``.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.documents import shown
from tooltip_cli.sources.streams import check_stamp, one_line

Cells = Iterator[tuple[int, dict[str, str]]]
"""Line number, and cell by column."""

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TIME_COLUMNS = ("stamp_ns", "stamp")
_FARTHEST_S = 10**12  # beyond it even the rounding of a decimal's digits takes long
_UNIT_TOLERANCE = 0.01  # of a quaternion's norm; reading a log leaves out what is farther off


@dataclass(frozen=True)
class Table:
    """Rows of numbers at times, sorted by time."""

    columns: tuple[str, ...]
    stamps_ns: npt.NDArray[np.int64]  # (N,) ascending
    rows: npt.NDArray[np.float64]  # (N, columns)
    reversals: int  # rows of the file that were earlier than the row before


def read_joints(path: Path) -> Table:
    """Read a table of joint positions.

    Raises:
        TooltipError: not such a table; the message names the line.
    """
    columns, cells = _read(path)
    joints = tuple(name for name in columns if name not in _TIME_COLUMNS)
    if not joints:
        raise TooltipError(f"{path}:1: no joint columns; after the time comes one a joint")
    return _numbers(path, joints, cells)


def read_poses(path: Path) -> Table:
    """Read a table of hand poses, its columns in the order of ``POSE_COLUMNS``.

    Raises:
        TooltipError: not such a table, or a quaternion that is no rotation; names the line.
    """
    columns, cells = _read(path)
    _check_columns(path, columns, POSE_COLUMNS)
    rows = []
    for line, row in cells:
        norm = math.sqrt(
            sum(_number(row[name], path, line, name) ** 2 for name in POSE_COLUMNS[3:])
        )
        if abs(norm - 1) > _UNIT_TOLERANCE:
            raise TooltipError(
                f"{path}:{line}: the quaternion qx,qy,qz,qw has the norm {norm:.4g}, expected 1"
            )
        rows.append((line, row))
    return _numbers(path, POSE_COLUMNS, iter(rows))


def _rotations(path: Path, cells: Cells) -> Cells:
    """Pass rows on, each with a unit quaternion."""
    for line, row in cells:
        norm = math.hypot(*(_number(row[name], path, line, name) for name in POSE_COLUMNS[3:]))
        if abs(norm - 1) > _UNIT_TOLERANCE:
            raise TooltipError(
                f"{path}:{line}: the quaternion qx,qy,qz,qw has the norm {norm:.4g}, expected 1"
            )
        yield line, row


def read_image_stamps(path: Path) -> dict[str, int]:
    """Read a table of image stamps, nanoseconds by file name.

    Raises:
        TooltipError: not such a table, or a file that is named twice; names the line.
    """
    columns, cells = _read(path)
    _check_columns(path, columns, ("file",))
    stamps: dict[str, int] = {}
    for line, row in cells:
        name = row["file"].strip()
        if name in stamps:
            raise TooltipError(f"{path}:{line}: {shown(name)} is listed a second time")
        stamps[name] = _stamp(row, path, line)
    if not stamps:
        raise TooltipError(f"{path} has no rows below its header")
    return stamps


def _check_columns(path: Path, columns: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    known = (*_TIME_COLUMNS, *wanted)
    missing = [name for name in wanted if name not in columns]
    unknown = [name for name in columns if name not in known]
    if missing or unknown:
        raise TooltipError(
            f"{path}:1: expected the columns stamp_ns,{','.join(wanted)}; found {','.join(columns)}"
        )


def _numbers(path: Path, names: tuple[str, ...], cells: Cells) -> Table:
    stamps, values = array("q"), array("d")  # a long log's numbers, without an object for each
    for line, row in cells:
        stamps.append(_stamp(row, path, line))
        values.extend(_number(row[name], path, line, name) for name in names)
    if not stamps:
        raise TooltipError(f"{path} has no rows below its header")
    stamps_ns = np.array(stamps, dtype=np.int64)
    order = np.argsort(stamps_ns, kind="stable")
    reversals = int(np.count_nonzero(np.diff(stamps_ns) < 0))
    rows = np.array(values, dtype=float).reshape(-1, len(names))
    return Table(names, stamps_ns[order], rows[order], reversals)


def _read(path: Path) -> tuple[tuple[str, ...], Cells]:
    """Return the header and the rows below it."""
    lines = _lines(path)
    header = next(lines, None)
    if header is None:
        raise TooltipError(f"{path} is empty; expected a header line that begins with stamp_ns")
    columns = tuple(name.strip() for name in header[1])
    times = [name for name in columns if name in _TIME_COLUMNS]
    if len(times) != 1:
        found = "both" if times else f"neither in {shown(','.join(columns))}"
        raise TooltipError(
            f"{path}:{header[0]}: the header must name one time column, stamp_ns (nanoseconds) or "
            f"stamp (seconds), separated by commas from the others; found {found}"
        )
    for place, name in enumerate(columns, start=1):
        if not name or not name.isprintable():
            raise TooltipError(f"{path}:{header[0]}: column {place} has no name, or no plain one")
    repeated = sorted({name for name in columns if columns.count(name) > 1})
    if repeated:
        raise TooltipError(
            f"{path}:{header[0]}: the header names columns more than once: {', '.join(repeated)}"
        )

    def cells() -> Cells:
        for line, row in lines:
            if len(row) != len(columns):
                raise TooltipError(
                    f"{path}:{line}: {len(row)} values, but the header names {len(columns)} columns"
                )
            yield line, dict(zip(columns, row, strict=True))

    return columns, cells()


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, cells) of the lines that are not blank."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            try:
                for row in reader:
                    if any(cell.strip() for cell in row):
                        yield reader.line_num, row
            except csv.Error as error:
                raise TooltipError(f"{path}:{reader.line_num}: not CSV ({error})") from error
    except UnicodeDecodeError as error:
        raise TooltipError(f"{path}: not UTF-8 text; expected CSV") from error
    except OSError as error:
        raise TooltipError(f"{path}: cannot be read ({one_line(error)})") from error


def _stamp(row: dict[str, str], path: Path, line: int) -> int:
    where = f"{path}:{line}"
    if "stamp_ns" in row:
        text = row["stamp_ns"].strip()
        if not text.isascii() or not text.removeprefix("-").isdigit() or len(text) > 20:
            raise TooltipError(f"{where}: stamp_ns is {shown(text)}, expected whole nanoseconds")
        return check_stamp(int(text), where)
    text = row["stamp"].strip()
    try:
        # a decimal keeps the nanoseconds that a float of a time of day would lose
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not seconds.is_finite() or abs(seconds) > _FARTHEST_S:
        raise TooltipError(f"{where}: stamp is {shown(text)}, expected seconds")
    return check_stamp(round(seconds * 10**9), where)


def _number(text: str, path: Path, line: int, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise TooltipError(f"{path}:{line}: {name} is {shown(text.strip())}, expected a number")
    return value
