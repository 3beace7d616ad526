"""Watch recordings one after the other, again and again for minutes: does memory or delay grow?

python -m tests.soak.watching MINUTES REC...

They should be of one robot. With several, what is held keeps changing, and estimates keep being
made; that these make no sense is no matter here.
"""

from __future__ import annotations

import itertools
import json
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.live.replay import with_camera
from tooltip_cli.log.container import LoggedAttachment, LoggedMessage, iterate
from tooltip_cli.log.messages import Message, header_stamp_ns, time_from_ns
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.writer import LogWriter

_PAUSE_NS = 1_000_000_000  # between two rounds, longer than any gap that is bridged
_SAMPLE_S = 10.0
_MOST_GROWTH_KB = 100_000  # from the second minute on


def repeat(paths: list[Path], seconds: float, out: Path) -> None:
    """Write the recordings one after the other until there are so many seconds of images."""
    end_ns = None
    start_ns = read_recording(paths[0]).image_stamps_ns[0]
    with LogWriter(out) as writer:
        for path in itertools.cycle(paths):
            recording = read_recording(path)
            topics = {recording.image_topic, recording.joint_topic, recording.pose_topic}
            stamps_ns = recording.image_stamps_ns
            shift_ns = 0 if end_ns is None else int(end_ns + _PAUSE_NS - stamps_ns[0])
            for item in iterate(path):
                if isinstance(item, LoggedAttachment):
                    if end_ns is None:
                        writer.attach(item.name, item.media_type, item.data)
                elif item.topic in topics:
                    writer.write(_later(item, shift_ns))
                elif end_ns is None:
                    writer.write(_later(item, 0))
            end_ns = int(stamps_ns[-1]) + shift_ns
            if end_ns - start_ns > seconds * 1e9:
                return


def _later(item: LoggedMessage, shift_ns: int) -> Message:
    payload, log_time_ns = item.payload, item.log_time_ns + shift_ns
    stamp_ns = header_stamp_ns(payload)
    if shift_ns and stamp_ns is not None:
        stamp = time_from_ns(stamp_ns + shift_ns)
        order = "<iI" if payload[1] & 1 else ">iI"
        packed = struct.pack(order, stamp["sec"], stamp["nanosec"])
        payload = payload[:4] + packed + payload[12:]
    return Message(item.topic, item.datatype, log_time_ns, payload)


def resident_kb(process: subprocess.Popen[str]) -> int:
    """Return the memory that a process holds now."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


def main(minutes: float, paths: list[Path]) -> None:
    folder = Path(tempfile.mkdtemp())
    long = folder / "long.mcap"
    repeat(paths, 60 * minutes, long)
    beside = paths[0].with_name(f"{paths[0].stem}.rig.yaml")
    rig: list[str] = []
    if beside.exists():
        with_camera(paths[0], beside, folder / "rig.yaml")
        rig = ["--rig", str(folder / "rig.yaml")]
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "watch", str(long), *rig, "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    updates: list[dict[str, Any]] = []

    def read() -> None:
        assert process.stdout is not None
        updates.extend(json.loads(line) for line in process.stdout)

    reader = threading.Thread(target=read)
    reader.start()
    began, sizes = time.monotonic(), []
    while process.poll() is None:
        time.sleep(_SAMPLE_S)
        try:
            sizes.append((time.monotonic() - began, resident_kb(process)))
        except (OSError, StopIteration):
            break
        if len(sizes) % 6 == 0:
            print(f"{sizes[-1][0]:.0f} s: {sizes[-1][1] / 1000:.0f} MB, {len(updates)} updates")
    reader.join()
    last, delays = updates[-1], [update["delay_s"] for update in updates[:-1]]
    print(
        f"{last['images']} images of {len(read_recording(long).image_stamps_ns)}, "
        f"{last['passed_over']} passed over, {last['dropped']} dropped; {len(updates)} updates, "
        f"delay {np.median(delays):.1f} s median, {max(delays):.1f} s at most; images taken after "
        f"{max(update['behind_s'] for update in updates):.2f} s at most"
    )
    settled = [size for seconds, size in sizes if seconds > 60]
    print(f"memory after a minute: {min(settled) / 1000:.0f} to {max(settled) / 1000:.0f} MB")
    third = max(len(settled) // 3, 1)
    growth = max(settled[-third:]) - max(settled[:third])
    assert growth < _MOST_GROWTH_KB, f"memory grew by {growth} kB"


if __name__ == "__main__":
    main(float(sys.argv[1]), [Path(argument) for argument in sys.argv[2:]])
