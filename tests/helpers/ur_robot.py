"""A UR controller as the network sees it: RTDE, version 2 of the protocol.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from types import TracebackType

_HEAD = struct.Struct(">HB")
_TYPES = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D"}
_PERIOD_S = 0.008


class UrRobot:
    """Answers one client after the other and streams joint positions at 125 Hz.

    Args:
        angles: joint positions, rad, by seconds since the start.
    """

    def __init__(self, angles: Callable[[float], tuple[float, ...]]) -> None:
        self._angles, self._stop = angles, threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.spec = f"rtde://127.0.0.1:{self._listener.getsockname()[1]}"
        self._open: list[socket.socket] = []
        self.sent = 0

    def __enter__(self) -> UrRobot:
        threading.Thread(target=self._serve, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._listener.shutdown(socket.SHUT_RDWR)  # ends the accept that waits in its thread
        self._listener.close()
        for connection in self._open:
            connection.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                connection = self._listener.accept()[0]
            except OSError:
                return
            self._open.append(connection)
            threading.Thread(target=self._client, args=(connection,), daemon=True).start()

    def _client(self, connection: socket.socket) -> None:
        names: list[str] = []
        try:
            with connection, connection.makefile("rb") as stream:
                while head := stream.read(_HEAD.size):
                    size, kind = _HEAD.unpack(head)
                    data = stream.read(size - _HEAD.size)
                    answer = b"\x01"
                    if kind == ord("v"):
                        answer = struct.pack(">4I", 3, 15, 0, 0)
                    elif kind == ord("O"):
                        names = data[8:].decode().strip(",").split(",")
                        types = ",".join(_TYPES.get(name, "NOT_FOUND") for name in names)
                        answer = b"\x01" + types.encode()
                    self._send(connection, kind, answer)
                    if kind == ord("S"):
                        threading.Thread(
                            target=self._stream, args=(connection, names), daemon=True
                        ).start()
        except OSError:
            return

    def _stream(self, connection: socket.socket, names: list[str]) -> None:
        start = time.monotonic()
        try:
            while not self._stop.wait(_PERIOD_S):
                now = time.monotonic() - start
                values = {"timestamp": (100.0 + now,), "actual_q": self._angles(now)}
                flat = [value for name in names for value in values[name]]
                self._send(connection, ord("U"), b"\x01" + struct.pack(f">{len(flat)}d", *flat))
                self.sent += 1
        except OSError:
            return

    @staticmethod
    def _send(connection: socket.socket, kind: int, data: bytes) -> None:
        connection.sendall(_HEAD.pack(_HEAD.size + len(data), kind) + data)
