"""An S3 server on loopback, as a process of its own, and a connection to it that can be cut."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

BUCKET = "lab"
KEY, SECRET = "AKIATESTTESTTESTTEST", "not-a-secret-but-never-to-be-shown"
_PATIENCE_S = 60
_SERVE = "import sys; from moto.server import main; main(['-H', '127.0.0.1', '-p', sys.argv[1]])"


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def environment(port: int) -> dict[str, str]:
    """Return what the provider's own settings are read from."""
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_MAX_ATTEMPTS": "2",
    }


class Server:
    """A running server with one bucket."""

    def __init__(self, port: int) -> None:
        self.port = port

    def client(self) -> Any:
        """Return a client that goes around any cut connection."""
        import boto3

        return boto3.client(
            "s3",
            endpoint_url=f"http://127.0.0.1:{self.port}",
            aws_access_key_id=KEY,
            aws_secret_access_key=SECRET,
            region_name="us-east-1",
        )

    def upload(self, folder: Path, prefix: str) -> None:
        """Copy a folder into the bucket."""
        client = self.client()
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                key = f"{prefix}/{path.relative_to(folder)}"
                client.put_object(Bucket=BUCKET, Key=key, Body=path.read_bytes())

    def objects(self, prefix: str) -> dict[str, bytes]:
        """Return everything under a prefix, by what follows it."""
        client = self.client()
        pages = client.get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=prefix)
        keys = [item["Key"] for page in pages for item in page.get("Contents", ())]
        return {
            key.removeprefix(prefix).lstrip("/"): client.get_object(Bucket=BUCKET, Key=key)[
                "Body"
            ].read()
            for key in keys
        }

    def unfinished(self) -> int:
        """Return how many uploads in parts were begun and neither completed nor aborted."""
        return len(self.client().list_multipart_uploads(Bucket=BUCKET).get("Uploads", ()))


@contextmanager
def serve() -> Iterator[Server]:
    """Run a server for as long as the block lasts."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-c", _SERVE, str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        until = time.monotonic() + _PATIENCE_S
        while True:
            with suppress(OSError), closing(socket.create_connection(("127.0.0.1", port), 1)):
                break
            assert time.monotonic() < until, "no server"
            time.sleep(0.05)
        server = Server(port)
        server.client().create_bucket(Bucket=BUCKET)
        yield server
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


class Cutter:
    """Passes connections on to a server, and cuts those that its rule says.

    Args:
        rule: given the first bytes of a request that writes, after how many of its bytes to cut
            it; None: never.
        note: called with the first bytes of every other request.
    """

    def __init__(
        self,
        server: int,
        rule: Callable[[bytes], int | None],
        note: Callable[[bytes], None] = lambda request: None,
    ) -> None:
        self._server, self._rule, self._note_of = server, rule, note
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.cuts = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Accept nothing more."""
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._server))
                threading.Thread(target=self._there, args=(near, far), daemon=True).start()
                threading.Thread(target=_pass_on, args=(far, near), daemon=True).start()

    def _there(self, near: socket.socket, far: socket.socket) -> None:
        """Pass on what the client sends; each block that begins a request is looked at."""
        left: int | None = None
        with suppress(OSError):
            while data := near.recv(4096):
                if data[:4] in (b"PUT ", b"POST"):
                    left = self._rule(data)
                elif data[:4] in (b"GET ", b"HEAD", b"DELE"):
                    left = None
                    self._note_of(data)
                if left is not None:
                    far.sendall(data[:left])
                    left -= len(data)
                    if left <= 0:
                        self.cuts += 1
                        break
                else:
                    far.sendall(data)
        _end(near, far)


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(65536):
            target.sendall(data)
    _end(source, target)


def _end(*ends: socket.socket) -> None:
    for end in ends:
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
        end.close()


def use(monkeypatch: Any, settings: Mapping[str, str]) -> None:
    """Put settings into the environment, and forget connections made with others."""
    import s3fs

    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
