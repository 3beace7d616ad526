"""What a shelf holds: one item a recording, from a folder, a pattern or a manifest."""

from __future__ import annotations

import csv
import io
import os
import posixpath
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.stages.detect import SUFFIX as DETECTIONS
from tooltip_cli.stages.moving import SUFFIX as EDGES
from tooltip_cli.stages.shelf.store import Listing, Place, Remote, opened, place
from tooltip_cli.stages.shelf.table import COLUMNS

Cell = str | int | float | bool | None
_RESULTS = (DETECTIONS, EDGES)
_KNOWN = ("recording", "rig", "labels", "tool")
_TABLES = (".csv", ".parquet")
_WILD = "*?["


@dataclass(frozen=True)
class Item:
    """One recording of a shelf, and what the manifest says of it."""

    name: str  # unique in the shelf: its path below the shelf's root, without .mcap
    recording: Place
    rig: Place | None = None  # None: the default, or the one stored in the recording
    labels: Place | None = None  # None: STEM.labels.csv where it usually lies
    tool: str | None = None
    columns: Mapping[str, Cell] = field(default_factory=dict)  # any others of the manifest


@dataclass(frozen=True)
class Shelf:
    """Recordings to work on, in the order of the folder or the manifest."""

    items: tuple[Item, ...]
    out: Place  # where results go if nothing else is said
    listing: Listing = field(default_factory=Listing)  # of the buckets, as far as they were listed


def read_shelf(shelf: str) -> Shelf:
    """List the recordings of a folder with its subfolders, a pattern, or a manifest.

    Each may be an address in a store, such as ``s3://bucket/folder``. A manifest is a CSV or
    Parquet table with the column ``recording``; ``rig``, ``labels`` and ``tool`` may be empty or
    missing, any other columns are kept. Its paths are relative to it. No recording is opened.

    Raises:
        TooltipError: nothing is there, or the manifest is malformed or names a recording twice.
    """
    path, listing = place(shelf), Listing()
    is_table = path.suffix.lower() in _TABLES
    if (isinstance(path, Remote) and is_table) or (isinstance(path, Path) and path.is_file()):
        if not is_table:
            raise _no_shelf(shelf)
        items: Iterable[Item] = _from_manifest(path)
        out = path.parent / f"{path.stem}.run"
    elif isinstance(path, Path) and path.is_dir():
        items, out = _items(_recordings_under(path), path), path / "run"
    elif any(character in shelf for character in _WILD):
        root = _fixed_part(path)
        items, out = _items(_matching(root, path, listing), root), root / "run"
    elif isinstance(path, Remote):
        listing.add_tree(path)
        found = (item for item in listing.below(path) if _is_recording(item.name))
        items, out = _items(found, path), path / "run"
    else:
        raise _no_shelf(shelf)
    found_items = tuple(items)
    if not found_items:
        raise TooltipError(f"{shelf} holds no recording; expected files that end in .mcap")
    return Shelf(found_items, out, listing)


def _no_shelf(shelf: str) -> TooltipError:
    return TooltipError(
        f"{shelf} is no folder, no pattern (such as 'logs/**/*.mcap', in quotes) and no "
        "manifest (.csv or .parquet with the column 'recording')"
    )


def part_of(items: Sequence[Item], part: int, parts: int) -> tuple[Item, ...]:
    """Return the part-th of equal parts, counted from 1; together they are all items, each once.

    Raises:
        TooltipError: there is no such part.
    """
    if not 1 <= part <= parts:
        raise TooltipError(f"there is no part {part} of {parts}; the first is 1/{parts}")
    return tuple(items[part - 1 :: parts])


def _recordings_under(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder, followlinks=False):
        folders.sort()
        for name in sorted(names):
            if _is_recording(name):
                yield Path(parent) / name


def _is_recording(name: str) -> bool:
    return name.endswith(".mcap") and not name.startswith(".") and not _is_result(name)


def _is_result(name: str) -> bool:
    return name.endswith(_RESULTS)


def _fixed_part(pattern: Place) -> Place:
    """Return the folder before the first wildcard of a pattern.

    Raises:
        TooltipError: the name of a bucket is part of the pattern.
    """
    text = pattern.key if isinstance(pattern, Remote) else str(pattern)
    parts = Path(text).parts
    wild = next(i for i, part in enumerate(parts) if any(char in part for char in _WILD))
    if isinstance(pattern, Path):
        return Path(*parts[:wild])
    if wild == 0:
        raise TooltipError(f"{pattern}: the bucket has to be named; a pattern may follow it")
    return Remote(pattern.url.removesuffix(pattern.key) + "/".join(parts[:wild]))


def _matching(root: Place, pattern: Place, listing: Listing) -> Iterator[Place]:
    """Yield the files of a pattern below its fixed part, in order."""
    if isinstance(root, Path):
        files: Iterable[Path] = sorted(root.glob(str(Path(str(pattern)).relative_to(root))))
        yield from (file for file in files if not _is_result(file.name) and file.is_file())
        return
    listing.add_tree(root)
    from fsspec.utils import glob_translate

    matches = re.compile(glob_translate(str(pattern))).match
    found = (item for item in listing.below(root) if matches(item.url))
    yield from (item for item in found if not _is_result(item.name))


def _items(recordings: Iterable[Place], root: Place) -> Iterator[Item]:
    for recording in recordings:
        yield Item(_name(recording, root), recording)


def _name(recording: Place, root: Place) -> str:
    """Return a recording's path below the root as a relative path that leaves no folder.

    One that does not lie in the same store or disk as the root is named by its whole address.
    """
    if isinstance(recording, Remote):
        near = isinstance(root, Remote) and root.url.split("/")[:3] == recording.url.split("/")[:3]
        base = root.key if near and isinstance(root, Remote) else ""
        path = Path(posixpath.relpath(f"/{recording.key}", f"/{base}"))
    elif isinstance(root, Remote):
        path = Path(os.path.relpath(recording, "/"))
    else:
        path = Path(os.path.relpath(recording, root))
    if path.suffix == ".mcap":
        path = path.with_suffix("")
    return "/".join("up" if part == ".." else part for part in path.parts)


def _from_manifest(path: Place) -> Iterator[Item]:
    rows = _csv_rows(path) if path.suffix.lower() == ".csv" else _parquet_rows(path)
    seen: dict[str, int] = {}
    for line, row in rows:
        if line == _first_line(path):
            _check_columns(path, list(row))
        recording = _place(path, row, "recording")
        if recording is None:
            raise TooltipError(f"{path}, row {line}: names no recording")
        name = _name(recording, path.parent)
        if name in seen:
            raise TooltipError(
                f"{path}, row {line}: names the recording of row {seen[name]} again; a shelf "
                "holds each recording once"
            )
        seen[name] = line
        others = {key: _cell(value) for key, value in row.items() if key not in _KNOWN}
        rig, labels = _place(path, row, "rig"), _place(path, row, "labels")
        yield Item(name, recording, rig, labels, _text(row.get("tool")), others)


def _place(manifest: Place, row: Mapping[str, Any], column: str) -> Place | None:
    text = _text(row.get(column))
    if text is None:
        return None
    named = place(text)
    if isinstance(named, Remote) or isinstance(manifest, Path):
        return named if isinstance(named, Remote) else manifest.parent / named
    if named.is_absolute():
        return named
    below = posixpath.normpath(f"/{manifest.parent.key}/{named}")
    return Remote(manifest.url.removesuffix(manifest.key) + below.lstrip("/"))


def _first_line(path: Place) -> int:
    return 2 if path.suffix.lower() == ".csv" else 1


def _check_columns(path: Place, columns: Sequence[str]) -> None:
    if "recording" not in columns:
        raise TooltipError(
            f"{path}: expected a column 'recording', found {', '.join(map(str, columns))[:200]}"
        )
    taken = sorted((set(columns) & set(COLUMNS)) - set(_KNOWN))
    if taken:
        raise TooltipError(
            f"{path}: the column '{taken[0]}' has the name of a result; call it something else"
        )


def _csv_rows(path: Place) -> Iterator[tuple[int, Mapping[str, Any]]]:
    try:
        with opened(path) as data:
            file = io.TextIOWrapper(data, encoding="utf-8-sig", newline="")
            reader = csv.DictReader(file, strict=True)
            for row in reader:
                if None in row or None in row.values():
                    raise TooltipError(
                        f"{path}, row {reader.line_num}: expected "
                        f"{len(reader.fieldnames or ())} cells as in the header"
                    )
                yield reader.line_num, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TooltipError(f"{path}: cannot be read as a CSV manifest ({error})") from error


def _parquet_rows(path: Place) -> Iterator[tuple[int, Mapping[str, Any]]]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("a Parquet manifest", "shelf", "pyarrow") from None
    try:
        with opened(path) as data, pyarrow.parquet.ParquetFile(data) as file:
            line = 0
            for batch in file.iter_batches():
                for row in batch.to_pylist():
                    line += 1
                    yield line, row
    except (OSError, pyarrow.ArrowException) as error:
        raise TooltipError(f"{path}: cannot be read as a Parquet manifest ({error})") from error


def _text(value: Any) -> str | None:
    text = "" if value is None else str(value).strip()
    return text or None


def _cell(value: Any) -> Cell:
    """Return a cell as what JSON, CSV and Parquet all have."""
    return value if value is None or isinstance(value, (str, int, float, bool)) else str(value)
