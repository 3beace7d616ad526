"""Play a recording back through ``tooltip record camera`` and compare the tips.

python -m tests.benchmarks.live.replay ../shared/data/reference/pen.mcap
"""

from __future__ import annotations

import json
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.helpers.live import MjpegServer, free_port, play, played, udp_joints


def tooltip(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tooltip_cli.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def tip(recording: Path, rig: Path, out: Path) -> dict[str, object]:
    out.mkdir()
    done = tooltip("estimate", recording, "--rig", rig, "--out", out, "--json")
    print(done.stderr.strip())
    document: dict[str, object] = json.loads((out / f"{recording.stem}.tip.json").read_text())
    return document


def main(path: Path) -> None:
    rig = path.with_name(f"{path.stem}.rig.yaml")
    camera_rig = Path(tempfile.mkdtemp()) / "rig.yaml"
    folder = camera_rig.parent
    with_camera(path, rig, camera_rig)
    out = folder / "live.mcap"
    server, port = MjpegServer(), free_port(socket.SOCK_DGRAM)
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", "camera", str(out)]
    command += ["--camera", server.url, "--joints", f"udp://127.0.0.1:{port}"]
    command += ["--rig", str(camera_rig), "--json"]
    items = played(path)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    server.connected.wait(30)
    with udp_joints(port) as send:
        play(items, server.show, send)
    server.close()
    result, _ = process.communicate(timeout=60)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(result)
    print(f"recording took {used.ru_utime + used.ru_stime:.1f} s of processor time")
    # away from its labels, whose frames an estimate leaves out
    copy = Path(shutil.copy(path, folder / "own.mcap"))
    live, own = tip(out, camera_rig, folder / "live"), tip(copy, camera_rig, folder / "own")
    print("live", live["status"], live.get("tip"), "\nown ", own["status"], own.get("tip"))
    if live["status"] == own["status"] == "ok":
        points = [np.array(item["tip"]["position_m"]) for item in (live, own)]  # type: ignore[index]
        print(f"{path.name}: {1000 * np.linalg.norm(points[0] - points[1]):.2f} mm apart")


def with_camera(recording: Path, rig: Path, out: Path) -> None:
    """Write a rig that holds the intrinsics and the robot too, as a live camera needs it."""
    from dataclasses import replace

    from tooltip_cli.log.recording import read_recording
    from tooltip_cli.rig.rigfile import load_rig, rig_files

    full = replace(load_rig(rig), camera=read_recording(recording).camera)
    for name, text in rig_files(full).items():
        (out.parent / name).write_text(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
