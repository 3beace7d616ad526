"""Joint angles as they come: a socket, a UR robot, a CSV file that grows, a Python object.

A line on a socket is a JSON object, one a datagram for UDP::

    {"stamp": 1700000000.25, "positions": {"wrist_pitch": 0.12, "wrist_roll": -0.4}}

The positions are rad or m. The time is ``stamp`` in seconds or ``stamp_ns`` in whole nanoseconds,
since 1970 and by the sender's clock; without one the time of arrival stands for it.
"""

from __future__ import annotations

import csv
import importlib
import json
import os
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import IO, Protocol
from urllib.parse import urlsplit

from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.documents import shown
from tooltip_cli.sources import rtde
from tooltip_cli.sources.streams import check_stamp, one_line

_POLL_S = 0.2  # between looks at whether to stop
_TAIL_S = 0.005  # between looks at a file that grows
_CONNECT_S = 5.0
_MAX_LINE = 1 << 16
_TIMES = ("stamp_ns", "stamp")
_LARGEST = Decimal(10) ** 20


@dataclass(frozen=True)
class JointSample:
    """Joint positions at one time."""

    positions: Mapping[str, float]  # rad or m, by joint name
    stamp_ns: int | None = None  # since 1970, by the robot's clock; None: the time of arrival


class JointFactory(Protocol):
    """What ``--joints module:factory`` names: called once, it returns an iterable of samples.

    ::

        def robot() -> Iterator[JointSample]:
            arm = connect()
            while True:
                yield JointSample(dict(zip(NAMES, arm.positions())), arm.stamp_ns())

    The iterable runs in a thread of its own and sets the pace.
    """

    def __call__(self) -> Iterable[JointSample]:
        """Return the samples as they come."""


Samples = Callable[[threading.Event], Iterator["JointSample | str"]]
"""Yields samples, or why one was left out, until the event is set."""


def joint_samples(spec: str) -> Samples:
    """Return what listens to a source of joints, by how its name begins or ends.

    It is ``udp://HOST:PORT``, ``tcp://HOST:PORT``, ``rtde://HOST``, a CSV or ``module:factory``.

    Raises:
        TooltipError: it is none of them.
    """
    scheme = spec.partition("://")[0]
    if scheme in ("udp", "tcp"):
        host, port = _address(spec)
        if not port:
            raise TooltipError(f"{spec}: no port; expected e.g. udp://:9870 or tcp://robot:9870")
        place = host, port
        receive = _udp if scheme == "udp" else _tcp
        return lambda halt: _parsed(receive(spec, place, halt))
    if scheme == "rtde":
        host, port = _address(spec)
        if not host:
            raise TooltipError(f"{spec}: no robot; expected e.g. rtde://192.168.0.10")
        return lambda halt: _arm(spec, host, port or rtde.PORT, halt)
    if spec.lower().endswith(".csv"):
        return lambda halt: _grown(Path(spec), halt)
    module, colon, name = spec.partition(":")
    if colon and module and name.isidentifier():
        return lambda halt: _called(spec, module, name, halt)
    raise TooltipError(
        f"{shown(spec)} is no source of joints; expected udp://HOST:PORT, tcp://HOST:PORT, "
        "rtde://HOST, a .csv file that grows, or module:factory"
    )


def sample_from_json(line: bytes | str) -> JointSample:
    """Return the sample that a line holds.

    Raises:
        ValueError: it holds none; the text says why.
    """
    try:
        # a decimal keeps the nanoseconds that a float of a time of day would lose
        item = json.loads(line, parse_float=Decimal)
    except (ValueError, RecursionError) as error:
        raise ValueError("lines that are not JSON") from error
    positions = item.get("positions") if isinstance(item, dict) else None
    if not isinstance(positions, dict) or not positions:
        raise ValueError("lines without 'positions', an object of numbers by joint")
    return JointSample(
        {str(name): float(_number(value, "position")) for name, value in positions.items()},
        _stamp_ns(item),
    )


def _number(value: object, what: str) -> Decimal:
    if isinstance(value, (int, Decimal)) and not isinstance(value, bool):
        number = Decimal(value)
        if number.is_finite() and abs(number) < _LARGEST:
            return number
    raise ValueError(f"lines with a {what} that is no number")


def _stamp_ns(item: Mapping[str, object]) -> int | None:
    times = [(name, item[name]) for name in _TIMES if item.get(name) is not None]
    if not times:
        return None
    name, value = times[0]
    stamp_ns = round(_number(value, "stamp") * (1 if name == "stamp_ns" else 10**9))
    try:
        return check_stamp(stamp_ns, "stamp")
    except TooltipError as error:
        raise ValueError("lines with a stamp that ROS cannot hold") from error


def _parsed(lines: Iterator[bytes]) -> Iterator[JointSample | str]:
    for line in lines:
        if not line.strip():
            continue
        try:
            yield sample_from_json(line)
        except ValueError as error:
            yield str(error)


def _address(spec: str) -> tuple[str, int | None]:
    try:
        parts = urlsplit(spec)
        return parts.hostname or "", parts.port
    except ValueError:
        return "", None


def _udp(spec: str, place: tuple[str, int], halt: threading.Event) -> Iterator[bytes]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            receiver.bind(place)
        except OSError as error:
            raise TooltipError(f"{spec}: cannot be listened to ({one_line(error)})") from error
        receiver.settimeout(_POLL_S)
        while not halt.is_set():
            try:
                datagram = receiver.recv(_MAX_LINE)
            except TimeoutError:
                continue
            yield from datagram.splitlines()


def _tcp(spec: str, place: tuple[str, int], halt: threading.Event) -> Iterator[bytes]:
    try:
        connection = socket.create_connection(place, timeout=_CONNECT_S)
    except OSError as error:
        raise TooltipError(f"{spec}: cannot be reached ({one_line(error)})") from error
    with connection:
        connection.settimeout(_POLL_S)
        rest = b""
        while not halt.is_set():
            try:
                part = connection.recv(_MAX_LINE)
            except TimeoutError:
                continue
            except OSError as error:
                raise TooltipError(f"{spec}: was lost ({one_line(error)})") from error
            if not part:
                raise TooltipError(f"{spec}: was closed by the other side")
            *lines, rest = (rest + part).split(b"\n")
            yield from lines
            if len(rest) > _MAX_LINE:
                raise TooltipError(f"{spec}: sends a line without an end; expected JSON lines")


def _arm(spec: str, host: str, port: int, halt: threading.Event) -> Iterator[JointSample]:
    for positions in rtde.arm_positions(spec, host, port, halt):
        yield JointSample(dict(zip(rtde.JOINTS, positions, strict=True)))


def _grown(path: Path, halt: threading.Event) -> Iterator[JointSample | str]:
    """Yield the rows that are added to a CSV file from now on."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            columns = _cells(file.readline())
            times = [name for name in columns if name in _TIMES]
            if len(times) > 1 or len(columns) <= len(times) or "" in columns:
                raise TooltipError(
                    f"{path}: expected a header line with one column a joint, and stamp_ns "
                    f"(nanoseconds) or stamp (seconds); found {shown(','.join(columns))}"
                )
            file.seek(0, os.SEEK_END)
            for line in _lines_added(path, file, halt):
                try:
                    yield _sample_from_row(columns, _cells(line))
                except ValueError as error:
                    yield str(error)
    except (OSError, UnicodeDecodeError) as error:
        raise TooltipError(f"{path}: cannot be read ({one_line(error)})") from error


def _lines_added(path: Path, file: IO[str], halt: threading.Event) -> Iterator[str]:
    rest = ""
    while not halt.is_set():
        part = file.read(_MAX_LINE)
        if not part:
            here, read = os.fstat(file.fileno()), os.lseek(file.fileno(), 0, os.SEEK_CUR)
            if path.stat().st_ino != here.st_ino or here.st_size < read:
                raise TooltipError(f"{path}: was replaced by another file")
            halt.wait(_TAIL_S)
            continue
        *lines, rest = (rest + part).split("\n")
        yield from (line for line in lines if line.strip())


def _cells(line: str) -> list[str]:
    return [cell.strip() for row in csv.reader([line]) for cell in row]


def _sample_from_row(columns: list[str], cells: list[str]) -> JointSample:
    if len(cells) != len(columns):
        raise ValueError("rows with another number of values than the header has columns")
    try:
        row = {name: Decimal(cell) for name, cell in zip(columns, cells, strict=True)}
    except InvalidOperation as error:
        raise ValueError("rows with a value that is no number") from error
    positions = {
        name: float(_number(value, "position")) for name, value in row.items() if name not in _TIMES
    }
    return JointSample(positions, _stamp_ns(row))


def _called(
    spec: str, module: str, name: str, halt: threading.Event
) -> Iterator[JointSample | str]:
    # the working directory, as for 'python -m'; a console script's own folder stands there instead
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        factory: JointFactory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise TooltipError(f"{spec}: cannot be imported ({one_line(error)})") from error
    for sample in factory():
        if halt.is_set():
            return
        if not isinstance(sample, JointSample):
            raise TooltipError(
                f"{spec}: yields {type(sample).__name__}, expected "
                "tooltip_cli.sources.joints.JointSample"
            )
        yield sample
