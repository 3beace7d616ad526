"""The report over a shelf, from the rows of its results, read one after the other."""

from __future__ import annotations

import csv
import datetime
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from tooltip_cli import __version__
from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.report.shelf_figures import shelf_figures
from tooltip_cli.report.shelf_model import Sample, ShelfReport
from tooltip_cli.report.shelf_page import shelf_page, shelf_tables
from tooltip_cli.report.shelf_totals import ShelfTotals
from tooltip_cli.stages.artifacts import plain
from tooltip_cli.stages.shelf.store import Place, opened, write
from tooltip_cli.stages.shelf.table import FAILED, OK, REFUSED, Row

REPORT = "report"
_NEEDED = ("name", "recording", "status")
_NUMBERS = ("error_px", "baseline_px", "tip_error_mm", "tip_x_m", "tip_y_m", "tip_z_m", "seconds")


def shelf_report(
    rows: Iterable[Mapping[str, Any]], source: str, on_row: Callable[[], None] = lambda: None
) -> ShelfReport:
    """Gather rows of results; none is kept.

    Raises:
        TooltipError: there are none, or one is no row of results.
    """
    totals, count = ShelfTotals(), 0
    for count, row in enumerate(rows, start=1):
        try:
            totals.add(sample_of(row))
        except (KeyError, ValueError, TypeError) as error:
            raise TooltipError(
                f"{source}, row {count}: not a row of results ({error}); expected the table that "
                "'tooltip run' writes"
            ) from error
        on_row()
    if not count:
        raise TooltipError(f"{source} holds no row; expected the results of 'tooltip run'")
    now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    return totals.report(source, __version__, now)


def sample_of(row: Mapping[str, Any]) -> Sample:
    """Return what the report takes of a row; what is empty is None.

    Raises:
        KeyError, ValueError: it is no row of results.
    """
    numbers = {name: _number(row.get(name)) for name in _NUMBERS}
    tip = (numbers["tip_x_m"], numbers["tip_y_m"], numbers["tip_z_m"])
    status = str(row["status"])
    if status not in (OK, REFUSED, FAILED):
        raise ValueError(f"the status {status!r}")
    recorded = row.get("recorded") or None
    return Sample(
        name=str(row["name"]),
        recording=str(row["recording"]),
        status=status,
        code=row.get("code") or None,
        reason=row.get("reason") or None,
        tool=_text(row.get("tool")),
        rig=_text(row.get("rig")),
        rig_id=_text(row.get("rig_id")),
        recorded_s=None
        if recorded is None
        else datetime.datetime.fromisoformat(str(recorded)).timestamp(),
        error_px=numbers["error_px"],
        baseline_px=numbers["baseline_px"],
        tip_error_mm=numbers["tip_error_mm"],
        tip_m=None if None in tip else (tip[0] or 0.0, tip[1] or 0.0, tip[2] or 0.0),
        seconds=numbers["seconds"],
    )


def _number(value: Any) -> float | None:
    return None if value is None or value == "" else float(value)


def _text(value: Any) -> str | None:
    return None if value is None or value == "" else str(value)


def cells_of(row: Row) -> dict[str, Any]:
    """Return a row as the table has it."""
    return {**row.columns, **{name: getattr(row, name) for name in row.__dataclass_fields__}}


def is_results(path: Place) -> bool:
    """Tell a table of results from a manifest, by its columns.

    Raises:
        TooltipError: it cannot be read.
    """
    first = next(stored_rows(path), None)
    return first is not None and all(name in first for name in _NEEDED)


def stored_rows(path: Place) -> Iterator[Mapping[str, Any]]:
    """Yield the rows of a table, CSV or Parquet, without holding more than a part of it.

    Raises:
        TooltipError: it is not there or is no table.
    """
    kind = path.suffix.lower()
    try:
        if kind == ".parquet":
            yield from _parquet(path)
        else:
            with opened(path) as data:
                text = io.TextIOWrapper(data, encoding="utf-8-sig", newline="")
                yield from csv.DictReader(text, strict=True)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TooltipError(f"{path}: cannot be read as a table of results ({error})") from error


def _parquet(path: Place) -> Iterator[Mapping[str, Any]]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("a Parquet table", "shelf", "pyarrow") from None
    try:
        with opened(path) as data, pyarrow.parquet.ParquetFile(data) as file:
            for batch in file.iter_batches(batch_size=1024):
                yield from batch.to_pylist()
    except pyarrow.ArrowException as error:
        raise TooltipError(f"{path}: cannot be read as a Parquet table ({error})") from error


def write_report(report: ShelfReport, folder: Place) -> Place:
    """Write the page, ``shelf.json``, the tables and the figures; return where the page is.

    Raises:
        MissingExtraError: matplotlib is not installed.
        TooltipError: something cannot be written.
    """
    figures = list(shelf_figures(report))
    files: list[tuple[str, str | bytes]] = [*shelf_tables(report)]
    for figure in figures:
        for suffix, data in (("svg", figure.svg), ("png", figure.png), ("csv", figure.data)):
            files.append((f"figures/{figure.name}.{suffix}", data))
    files.append(("shelf.json", json.dumps(plain(report), indent=1) + "\n"))
    files.append(("index.html", "".join(shelf_page(report, figures))))
    for name, data in files:
        write(folder / name, data)
    return folder / "index.html"
