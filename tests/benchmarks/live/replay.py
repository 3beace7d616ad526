"""Play a recording back through a live path and compare the tips.

python -m tests.benchmarks.live.replay http|udp|ros2|zenoh|ros1 ../shared/data/reference/pen.mcap

``http`` and ``udp`` go to ``record camera``, as MJPEG and as an MPEG-TS stream of ffmpeg (needed),
with joints over a socket; the others to the command of their name. A stream that is encoded and
decoded is late by some images, so for ``udp`` the delay is measured and entered in the rig. What
``estimate --refine time`` finds where some of it, or none, is entered is printed before.
"""

from __future__ import annotations

import contextlib
import json
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tests.helpers.live import MjpegServer, Played, free_port, play, played, udp_joints
from tests.helpers.recorder import by_topic
from tests.helpers.robots import Network, network
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.recording import read_recording
from tooltip_cli.rig.rigfile import load_rig
from tooltip_cli.sources.ros1types import typestore
from tooltip_cli.sources.streams import IMAGE_TOPIC
from tooltip_cli.stages.calibrate import write_rig

FPS = 30
_LEFT_S = (0.0, 0.03, 0.06, 0.09, 0.12)  # of the delay of a stream, for ``--refine`` to find


def tooltip(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tooltip_cli.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def tip(recording: Path, rig: Path, out: Path, *options: str) -> dict[str, Any]:
    out.mkdir()
    done = tooltip("estimate", recording, "--rig", rig, "--out", out, "--json", *options)
    print(done.stderr.strip())
    document: dict[str, Any] = json.loads((out / f"{recording.stem}.tip.json").read_text())
    return document


def recorder(kind: str, out: Path, *options: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", kind, str(out), "--json"]
    return subprocess.Popen([*command, *map(str, options)], stdout=subprocess.PIPE, text=True)


def over_camera(kind: str, path: Path, rig: Path, out: Path) -> str:
    """Play to ``record camera``; return what it printed."""
    port = free_port(socket.SOCK_DGRAM)
    sink = camera_http if kind == "http" else camera_udp
    with sink() as (source, ready, show), udp_joints(port) as send:
        names = ["--camera", source, "--joints", f"udp://127.0.0.1:{port}", "--rig", rig]
        process = recorder("camera", out, *names, "--patience", 5)
        items, shown = played(path), list[tuple[int, bytes]]()
        ready(items, out)

        def note_and_show(image: bytes) -> None:
            shown.append((time.time_ns(), image))
            show(image)

        play(items, note_and_show, send)
    said = process.communicate(timeout=60)[0]
    if kind == "udp":
        put_clocks_right(out, rig, shown)
    return said


Camera = tuple[str, Callable[[Sequence[Played], Path], object], Callable[[bytes], object]]


@contextlib.contextmanager
def camera_http() -> Iterator[Camera]:
    """Provide an MJPEG server: its address, what waits for a viewer, what shows an image."""
    server = MjpegServer()
    yield server.url, lambda items, out: server.connected.wait(30), server.show
    server.close()


@contextlib.contextmanager
def camera_udp() -> Iterator[Camera]:
    """Provide ffmpeg that sends what it is given as MPEG-2 video, of the best quality it has."""
    url = f"udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    encode = ["-c:v", "mpeg2video", "-qscale:v", "1", "-g", "1", "-b:v", "60M", "-maxrate", "90M"]
    command = ["ffmpeg", "-loglevel", "error", "-fflags", "nobuffer", "-probesize", "32"]
    command += ["-f", "image2pipe", "-c:v", "mjpeg", "-framerate"]
    command += [str(FPS), "-i", "-", *encode, "-bufsize", "20M", "-flush_packets", "1"]
    command += ["-muxdelay", "0", "-f", "mpegts"]
    sender = subprocess.Popen([*command, f"{url}?pkt_size=1316"], stdin=subprocess.PIPE)
    assert sender.stdin is not None
    pipe = sender.stdin

    def show(image: bytes) -> None:
        pipe.write(image)
        pipe.flush()

    def ready(items: Sequence[Played], out: Path) -> None:
        # a stream is joined once enough of it has come to know what it is
        still = next(item.image for item in items if item.image)
        unfinished = out.with_name(f"{out.name}.unfinished")
        while not unfinished.exists() or unfinished.stat().st_size < 100_000:
            show(still)
            time.sleep(1 / FPS)

    yield f"{url}?fifo_size=100000&overrun_nonfatal=1", ready, show
    pipe.close()
    sender.wait(30)


def over_network(kind: str, path: Path, rig: Path, out: Path) -> str:
    """Play to the command of a network, message by message; return what it printed."""
    found = [
        item
        for item in iterate(path)
        if isinstance(item, LoggedMessage)
        and item.datatype in (messages.COMPRESSED_IMAGE, messages.JOINT_STATE)
    ]
    topics = {item.datatype: item.topic for item in found}
    names: list[object] = ["--image", topics[messages.COMPRESSED_IMAGE]]
    names += ["--joints", topics[messages.JOINT_STATE], "--rig", rig, "--patience", 5]
    with network(kind) as joined:
        process = recorder(kind, out, *joined.options, *names)
        robot = Network([], playing(kind, joined.robot, found, out.parent), joined.environment)
        robot.start().wait()
        return process.communicate(timeout=60)[0]


def playing(
    kind: str, robot: Sequence[str], found: Sequence[LoggedMessage], folder: Path
) -> list[str]:
    """Return the command of a robot that plays messages from a file."""
    start, file = found[0].log_time_ns, folder / "messages"
    with file.open("wb") as out:
        for item in found:
            payload = item.payload
            if kind == "ros1":
                payload = bytes(typestore("ROS2_HUMBLE").cdr_to_ros1(payload, item.datatype))
            head = {"at_s": (item.log_time_ns - start) / 1e9, "bytes": len(payload)}
            out.write(json.dumps({**head, "topic": item.topic, "type": item.datatype}).encode())
            out.write(b"\n" + payload)
    return [*robot, "play", str(file)]


def main(kind: str, path: Path) -> None:
    rig = path.with_name(f"{path.stem}.rig.yaml")
    folder = Path(tempfile.mkdtemp())
    full_rig, out = with_camera(path, rig, folder), folder / "live.mcap"
    over = over_camera if kind in ("http", "udp") else over_network
    print(over(kind, path, full_rig, out))
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"playing and recording took {used.ru_utime + used.ru_stime:.1f} s of processor time")
    # away from its labels, whose frames an estimate leaves out
    copy = Path(shutil.copy(path, folder / "own.mcap"))
    live, own = tip(out, full_rig, folder / "live"), tip(copy, rig, folder / "own")
    print("live", live["status"], live.get("tip"), "\nown ", own["status"], own.get("tip"))
    if live["status"] == own["status"] == "ok":
        points = [np.array(item["tip"]["position_m"]) for item in (live, own)]
        apart = 1000 * np.linalg.norm(points[0] - points[1])
        print(f"{path.name} over {kind}: {apart:.2f} mm apart")
    shutil.rmtree(folder)


def put_clocks_right(recording: Path, rig: Path, shown: Sequence[tuple[int, bytes]]) -> None:
    """Enter in the rig how late the images came, as one would who has measured a camera's delay.

    First, some of the delay is left for ``--refine time`` to find.
    """
    late_s = delay_s(recording, shown)
    for left_s in (*_LEFT_S, late_s):
        enter_offset(rig, left_s - late_s)
        found = tip(recording, rig, rig.with_name(f"left-{left_s}"), "--refine", "time")
        refined = found["refined"] or {"time_offset_s": 0.0, "applied": False}
        use = "used" if refined["applied"] else "not used"
        found_ms = -1000 * refined["time_offset_s"]
        print(f"of {1000 * left_s:.0f} ms {found_ms:.1f} are found, {use}; {found['status']}")
    enter_offset(rig, -late_s)


def delay_s(recording: Path, shown: Sequence[tuple[int, bytes]]) -> float:
    """Return how late images came, the median, seconds; each is known by what it shows."""
    pictures = np.array([small(image) for _, image in shown])
    late: list[int] = []
    for message in by_topic(recording)[IMAGE_TOPIC]:
        picture = small(bytes(messages.decode(message.datatype, message.payload).data))
        nearest = int(np.argmin(((pictures - picture) ** 2).sum(axis=1)))
        if nearest > 0:  # the first one was shown before the play too
            late.append(message.log_time_ns - shown[nearest][0])
    print(f"{len(late)} images of {len(shown)}, {np.median(late) / 1e6:.1f} ms late")
    return float(np.median(late)) / 1e9


def small(image: bytes) -> npt.NDArray[np.float32]:
    """Return the grey levels of a part of an image, whose noise tells it from its neighbours."""
    pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    return np.asarray(pixels[::4, ::4], dtype=np.float32).ravel()


def enter_offset(rig: Path, offset_s: float) -> None:
    write_rig(replace(load_rig(rig), time_offset_s=offset_s), rig.parent)


def with_camera(recording: Path, rig: Path, folder: Path) -> Path:
    """Write a rig that holds the intrinsics and the robot too, as a live camera needs it."""
    return write_rig(replace(load_rig(rig), camera=read_recording(recording).camera), folder)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
