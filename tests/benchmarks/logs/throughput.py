"""Writing and reading a recording, frames a second, beside the bare mcap library in the same run.

A frame is one 640x480 JPEG and the joint states of 1/30 s, as CDR messages that are made
beforehand. Both write to the same disk with zstd and all CRCs on; both read every message in file
order and check every CRC. The order alternates, and the best of several rounds counts.

    python tests/benchmarks/logs/throughput.py [--frames 3000] [--rounds 5] [--folder DIR]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.crashsafe import CrashSafeWriter
from tooltip_cli.log.messages import Message, schema_text

JOINTS = [f"joint_{index}" for index in range(7)]
JOINT_RATE, FRAME_RATE = 100, 30


def recording(frames: int) -> list[Message]:
    """Return the messages of a recording; its pictures are eight, taken in turn."""
    rng = np.random.default_rng(0)
    pictures = []
    for _ in range(8):
        noise = cv2.GaussianBlur(rng.uniform(0, 255, (480, 640, 3)), (0, 0), 1.5)
        image = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        pictures.append(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    found = []
    for frame in range(frames):
        stamp_ns = frame * 10**9 // FRAME_RATE
        payload = messages.compressed_image(stamp_ns, "camera", "jpeg", pictures[frame % 8])
        found.append(
            Message("/camera/image/compressed", messages.COMPRESSED_IMAGE, stamp_ns, payload)
        )
    for step in range(frames * JOINT_RATE // FRAME_RATE):
        stamp_ns = step * 10**9 // JOINT_RATE
        payload = messages.joint_state(stamp_ns, JOINTS, rng.uniform(-1, 1, len(JOINTS)).tolist())
        found.append(Message("/joint_states", messages.JOINT_STATE, stamp_ns, payload))
    return sorted(found, key=lambda message: message.log_time_ns)


def write_ours(path: Path, sent: list[Message]) -> None:
    """Write with the recorder's writer: flushed by time, and on the disk when done."""
    with CrashSafeWriter(path, overwrite=True) as writer:
        for message in sent:
            writer.write(message)


def write_bare(path: Path, sent: list[Message]) -> None:
    """Write with the library alone, and wait for the disk as well."""
    with path.open("wb") as file:
        writer = McapWriter(
            file, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
        )
        writer.start("ros2", "bare")
        channels: dict[str, int] = {}
        for message in sent:
            if message.topic not in channels:
                schema = writer.register_schema(
                    message.datatype, "ros2msg", schema_text(message.datatype).encode()
                )
                channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
            writer.add_message(
                channels[message.topic], message.log_time_ns, message.payload, message.log_time_ns
            )
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
        file.flush()
        os.fsync(file.fileno())


def read_ours(path: Path) -> int:
    """Read every message; return their bytes."""
    return sum(len(item.payload) for item in iterate(path) if isinstance(item, LoggedMessage))


def read_bare(path: Path) -> int:
    """Read every message with the library's reader, checking CRCs; return their bytes."""
    with path.open("rb") as file:
        records = StreamReader(file, validate_crcs=True).records
        return sum(len(item.data) for item in records if isinstance(item, McapMessage))


def best(rounds: int, *jobs: Callable[[], object]) -> list[float]:
    """Return the shortest time of each job, seconds; they take turns."""
    times: list[list[float]] = [[] for _ in jobs]
    for turn in range(rounds):
        for index in itertools.chain(range(turn % 2, len(jobs)), range(turn % 2)):
            start = time.perf_counter()
            jobs[index]()
            times[index].append(time.perf_counter() - start)
    return [min(found) for found in times]


def main() -> None:
    """Print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    sent = recording(options.frames)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        ours, bare = Path(folder) / "ours.mcap", Path(folder) / "bare.mcap"
        write = best(options.rounds, lambda: write_ours(ours, sent), lambda: write_bare(bare, sent))
        assert read_ours(ours) == read_bare(bare) == sum(len(item.payload) for item in sent)
        read = best(options.rounds, lambda: read_ours(ours), lambda: read_bare(bare))
        size = ours.stat().st_size
    frames = options.frames
    print(
        json.dumps(
            {
                "frames": frames,
                "bytes_a_frame": size // frames,
                "write_frames_per_s": round(frames / write[0]),
                "write_bare_frames_per_s": round(frames / write[1]),
                "write_time_ratio": round(write[0] / write[1], 3),
                "read_frames_per_s": round(frames / read[0]),
                "read_bare_frames_per_s": round(frames / read[1]),
                "read_time_ratio": round(read[0] / read[1], 3),
            }
        )
    )


if __name__ == "__main__":
    main()
