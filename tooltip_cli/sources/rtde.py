"""Joint angles of a Universal Robots arm, by version 2 of its Real-Time Data Exchange.

A package is its own size, two bytes, its kind, one byte, and the data, all big-endian. The client
asks for a version and for outputs by name, and after a start the controller sends them by itself.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator

from tooltip_cli.errors import TooltipError
from tooltip_cli.sources.streams import one_line

PORT = 30004
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""As the manufacturer's robot descriptions name them, in the order of ``actual_q``."""

_PROTOCOL, _CONTROLLER, _OUTPUTS, _START, _DATA = b"VvOSU"
_OUTPUT, _OUTPUT_TYPE = "actual_q", "VECTOR6D"
_FASTEST = ((5, 500.0), (0, 125.0))  # Hz, from a major version of the controller on
_TIMEOUT_S = 5.0
_POLL_S = 0.2
_HEAD = struct.Struct(">HB")
_ANGLES = struct.Struct(">6d")


def arm_positions(spec: str, host: str, port: int, halt: threading.Event) -> Iterator[list[float]]:
    """Yield the positions of :data:`JOINTS`, rad, as the controller sends them.

    Args:
        spec: what to call it in messages.

    Raises:
        TooltipError: it cannot be reached, is no such controller, or was lost.
    """
    try:
        connection = socket.create_connection((host, port), timeout=_TIMEOUT_S)
    except OSError as error:
        raise TooltipError(f"{spec}: cannot be reached ({one_line(error)})") from error
    with connection:
        connection.settimeout(_POLL_S)
        link = _Link(spec, connection, halt)
        recipe = _subscribe(link, spec)
        while recipe is not None and (package := link.receive()) is not None:
            kind, data = package
            if kind == _DATA and data[:1] == recipe and len(data) == 1 + _ANGLES.size:
                yield list(_ANGLES.unpack(data[1:]))


def _subscribe(link: _Link, spec: str) -> bytes | None:
    """Ask for the joint angles as often as they can be had.

    Returns:
        What marks their packages; None: the end of the recording came first.
    """
    if (accepted := link.ask(_PROTOCOL, struct.pack(">H", 2))) is None:
        return None
    if accepted != b"\x01":
        raise TooltipError(f"{spec}: does not speak version 2 of RTDE")
    if (version := link.ask(_CONTROLLER)) is None:
        return None
    major = int.from_bytes(version[:4], "big")
    rate = next(rate for least, rate in _FASTEST if major >= least)
    if (outputs := link.ask(_OUTPUTS, struct.pack(">d", rate) + _OUTPUT.encode())) is None:
        return None
    if outputs[1:].decode(errors="replace") != _OUTPUT_TYPE:
        raise TooltipError(f"{spec}: does not offer {_OUTPUT} as {_OUTPUT_TYPE}")
    if (started := link.ask(_START)) is None:
        return None
    if started != b"\x01":
        raise TooltipError(f"{spec}: does not start to send")
    return outputs[:1]


class _Link:
    """Packages to and from a controller, which must not be silent for long."""

    def __init__(self, spec: str, connection: socket.socket, halt: threading.Event) -> None:
        self._spec, self._connection, self._halt = spec, connection, halt

    def ask(self, kind: int, data: bytes = b"") -> bytes | None:
        """Send a package and return the data of its answer; None: the end came first."""
        try:
            self._connection.sendall(_HEAD.pack(_HEAD.size + len(data), kind) + data)
        except OSError as error:
            raise self._lost(one_line(error)) from error
        while (package := self.receive()) is not None:
            if package[0] == kind:  # the controller may send remarks in between
                return package[1]
        return None

    def receive(self) -> tuple[int, bytes] | None:
        """Return the next package's kind and data; None: the end came first."""
        head = self._exactly(_HEAD.size)
        if head is None:
            return None
        size, kind = _HEAD.unpack(head)
        if size < _HEAD.size:
            raise TooltipError(f"{self._spec}: does not speak RTDE")
        data = self._exactly(size - _HEAD.size)
        return None if data is None else (kind, data)

    def _exactly(self, count: int) -> bytes | None:
        data, heard = b"", time.monotonic()
        while len(data) < count:
            if self._halt.is_set():
                return None
            try:
                part = self._connection.recv(count - len(data))
            except TimeoutError:
                if time.monotonic() - heard > _TIMEOUT_S:
                    raise self._lost(f"silent for {_TIMEOUT_S:.0f} s") from None
                continue
            except OSError as error:
                raise self._lost(one_line(error)) from error
            if not part:
                raise self._lost("closed by the other side")
            data += part
            heard = time.monotonic()
        return data

    def _lost(self, reason: str) -> TooltipError:
        return TooltipError(f"{self._spec}: was lost ({reason})")
