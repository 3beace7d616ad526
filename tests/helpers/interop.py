"""One of each kind of file that this program writes, for other programs to read."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from tests.helpers.cli import tooltip
from tests.helpers.logs import wrist_parts, write_log
from tooltip_cli.log.crashsafe import CrashSafeWriter
from tooltip_cli.log.salvage import salvage

FILES = ("recording", "recorded", "detections", "export", "salvaged", "unfinished")


def one_of_each(folder: Path) -> dict[str, Path]:
    """Return the files by kind; all names end with ``.mcap``, by which readers go."""
    recording = write_log(folder / "wrist.mcap", wrist_parts(12))
    for arguments in (
        ("record", "bag", recording, folder / "recorded.mcap"),
        ("export", recording, folder / "export.mcap", "--method", "kmeans"),
    ):
        done = tooltip(*arguments)
        assert done.code == 0, done.err
    (folder / "cut.mcap").write_bytes(recording.read_bytes()[:-200])
    salvage(folder / "cut.mcap", folder / "salvaged.mcap")
    with (
        contextlib.suppress(KeyboardInterrupt),
        CrashSafeWriter(folder / "stopped.mcap") as writer,
    ):
        for message in wrist_parts(3)["images"]:
            writer.write(message)
        raise KeyboardInterrupt
    shutil.copy(folder / "stopped.mcap.unfinished", folder / "unfinished.mcap")
    names = ("wrist", "recorded", "wrist.detections", "export", "salvaged", "unfinished")
    return {kind: folder / f"{name}.mcap" for kind, name in zip(FILES, names, strict=True)}
