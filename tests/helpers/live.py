"""A robot that plays a recording: a real HTTP-MJPEG server, and joints over UDP or TCP."""

from __future__ import annotations

import http.server
import json
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.helpers.recorder import wait_for
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import decode, ns_from_time

BOUNDARY = "frame"


@dataclass(frozen=True)
class Played:
    """One thing to send, at a time after the start."""

    at_s: float
    image: bytes = b""
    positions: dict[str, float] | None = None


def played(path: Path) -> list[Played]:
    """Return the images and joints of a log by their header stamps."""
    found: list[tuple[int, Played]] = []
    for item in iterate(path):
        if not isinstance(item, LoggedMessage):
            continue
        if item.datatype in (messages.COMPRESSED_IMAGE, messages.JOINT_STATE):
            message = decode(item.datatype, item.payload)
            stamp_ns = ns_from_time(message.header.stamp)
            if item.datatype == messages.COMPRESSED_IMAGE:
                found.append((stamp_ns, Played(0, image=bytes(message.data))))
            else:
                positions = dict(zip(message.name, message.position, strict=True))
                found.append((stamp_ns, Played(0, positions=positions)))
    found.sort(key=lambda pair: pair[0])
    start = found[0][0]
    return [Played((stamp - start) / 1e9, item.image, item.positions) for stamp, item in found]


class MjpegServer:
    """Sends JPEG images as multipart/x-mixed-replace to whoever is connected."""

    def __init__(self, *, lengths: bool = True, port: int = 0) -> None:
        self.connected = threading.Event()
        self._viewers: list[queue.SimpleQueue[bytes]] = []
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
                self.send_header("Content-Type", kind)
                self.end_headers()
                outer._send(self.wfile.write, lengths)

            def log_message(self, *arguments: object) -> None:
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/stream"

    @property
    def port(self) -> int:
        return int(self._server.server_address[1])

    def show(self, image: bytes) -> None:
        for viewer in self._viewers:
            viewer.put(image)

    def close(self) -> None:
        self.show(b"")
        self._server.shutdown()
        self._server.server_close()

    def _send(self, write: Callable[[bytes], object], lengths: bool) -> None:
        viewer: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._viewers.append(viewer)
        self.connected.set()
        while image := viewer.get():
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n"
            if lengths:
                head += f"Content-Length: {len(image)}\r\n"
            try:
                write(head.encode() + b"\r\n" + image + b"\r\n")
            except OSError:
                return


def joint_line(positions: dict[str, float], stamp_ns: int | None) -> bytes:
    """Return a line as the joints' socket takes it."""
    stamp = {} if stamp_ns is None else {"stamp_ns": stamp_ns}
    return json.dumps({**stamp, "positions": positions}).encode() + b"\n"


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a port that nobody uses."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def udp_joints(port: int) -> Iterator[Callable[[bytes], object]]:
    """Yield what sends a datagram to a port of this machine; the first waits until one listens."""
    place, heard = ("127.0.0.1", port), False
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
    ):
        probe.connect(place)

        def listening() -> bool:
            probe.send(b"\n")  # an empty line is no sample
            return probe.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0

        def send(line: bytes) -> None:
            nonlocal heard
            if not heard:
                wait_for(listening, "somebody who listens to joints")
                heard = True
            sender.sendto(line, place)

        yield send


def play(
    items: Sequence[Played],
    show: Callable[[bytes], object],
    send: Callable[[bytes], object],
    *,
    stamped: bool = True,
) -> None:
    """Send everything at its time; joints carry this machine's time."""
    start, start_ns = time.monotonic(), time.time_ns()
    for item in items:
        time.sleep(max(start + item.at_s - time.monotonic(), 0))
        if item.positions is None:
            show(item.image)
        else:
            send(joint_line(item.positions, start_ns + round(item.at_s * 1e9) if stamped else None))
