"""A real ``tooltip record`` process that is given its images one by one, and cut short.

The folder that it imports holds named pipes: it waits for each image until the test writes it, so
that the test knows what the process was given, and when.
"""

from __future__ import annotations

import contextlib
import errno
import os
import random
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 33_333_333
IMAGE_TOPIC = "/camera/image/compressed"
_NOISE_BYTES = 40_000
_ROOT = Path(__file__).parents[2]


@dataclass
class Session:
    """One recording that was cut short."""

    out: Path
    sent: list[bytes] = field(default_factory=list)
    times: list[float] = field(default_factory=list)  # when each was taken by the process
    ended: float = 0.0  # when the process was killed, or ended
    code: int = 0
    stderr: str = ""

    @property
    def unfinished(self) -> Path:
        """What is left of it."""
        return self.out.with_name(f"{self.out.name}.unfinished")

    def lost_s(self, found: Sequence[bytes]) -> float:
        """Return how long before the end the first image that is not found was taken.

        Raises:
            AssertionError: what is found is not the beginning of what was sent.
        """
        assert list(found) == self.sent[: len(found)], "an image that was not sent"
        lost = self.times[len(found) :]
        return max(self.ended - lost[0], 0.0) if lost else 0.0


def picture() -> bytes:
    """Return a JPEG of 640x480 with some texture."""
    noise = np.random.default_rng(0).uniform(0, 255, (480, 640, 3))
    image = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    return bytes(cv2.imencode(".jpg", image.astype(np.uint8))[1].tobytes())


def run(
    folder: Path,
    end: Callable[[subprocess.Popen[str], int], bool],
    *,
    frames: int = 400,
    fps: float = 30.0,
    arguments: Sequence[str] = (),
    file_limit: int | None = None,
    image: bytes | None = None,
) -> Session:
    """Feed a recording until the process is gone.

    Args:
        end: called after each image with the process and the number of images sent; True where it
            has just ended the process, or asked it to end.
        file_limit: bytes that a file of the process may have, like a disk that is full.
    """
    image = picture() if image is None else image
    pipes = folder / "images"
    pipes.mkdir(parents=True)
    names = [pipes / f"{START_NS + i * FRAME_NS}.jpg" for i in range(frames)]
    for name in names:
        os.mkfifo(name)
    rows = [f"{START_NS - 10**7 + i * 10**7},{i / 1000}" for i in range(frames * 4)]
    (folder / "joints.csv").write_text("\n".join(["stamp_ns,a", *rows]))
    session = Session(folder / "out.mcap")
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", "video", str(pipes)]
    command += [str(session.out), "--joints", str(folder / "joints.csv"), *arguments]
    process = subprocess.Popen(command, cwd=_ROOT, stderr=subprocess.PIPE, text=True)
    if file_limit is not None:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (file_limit, file_limit))
    try:
        asked = 0.0
        for index, name in enumerate(names):
            # behind the picture's end, so that no two are alike, or packed into less
            data = image + random.Random(index).randbytes(_NOISE_BYTES)
            if not _give(name, data, process):
                break
            session.sent.append(data)
            session.times.append(time.monotonic())
            if not asked and end(process, index + 1):
                asked = time.monotonic()
            time.sleep(1 / fps)
        else:
            raise AssertionError("the recording was not cut short")
        session.ended = asked or time.monotonic()
        session.code = process.wait(30)
    finally:
        process.kill()
        assert process.stderr is not None
        session.stderr = process.stderr.read()
        process.stderr.close()
        process.wait()
    return session


def _give(pipe: Path, data: bytes, process: subprocess.Popen[str]) -> bool:
    """Write one image as soon as the process asks for it; False where it is gone."""
    while True:
        try:
            descriptor = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
            break
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            if process.poll() is not None:
                return False
            time.sleep(0.001)
    with os.fdopen(descriptor, "wb", buffering=0) as file:
        view = memoryview(data)
        while view:
            written = None
            with contextlib.suppress(BlockingIOError):
                try:
                    written = file.write(view)
                except BrokenPipeError:
                    return False
            view = view[written or 0 :]
            if not written:
                if process.poll() is not None:
                    return False
                time.sleep(0.0005)
    return True


def images_in(path: Path) -> list[bytes]:
    """Return the images of a log in file order."""
    return [
        bytes(messages.decode(item.datatype, item.payload).data)
        for item in iterate(path)
        if isinstance(item, LoggedMessage) and item.topic == IMAGE_TOPIC
    ]
