"""Logs are written whole or not at all."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.helpers.logs import image_message, joint_message, jpeg_of, robot_message
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedAttachment, LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.writer import LogWriter


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_messages_keep_their_order_times_and_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent = [
        joint_message(30, ("a",), (0.1,)),
        image_message(10, jpeg_of(0)),
        joint_message(20, ("a",), (0.2,)),
        joint_message(20, ("a",), (0.2,)),
        Message("/robot_description", messages.STRING, 40, messages.string("x"), 35),
    ]
    with LogWriter(path) as writer:
        for message in sent:
            writer.write(message)
    found = [item for item in iterate(path) if isinstance(item, LoggedMessage)]
    assert [item.topic for item in found] == [message.topic for message in sent]
    assert [item.payload for item in found] == [message.payload for message in sent]
    assert [item.log_time_ns for item in found] == [30, 10, 20, 20, 40]
    assert [item.publish_time_ns for item in found] == [30, 10, 20, 20, 35]


def test_the_same_messages_make_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        with LogWriter(tmp_path / name) as writer:
            for stamp in range(50):
                writer.write(joint_message(stamp, ("a",), (0.1 * stamp,)))
            writer.attach("x", "text/plain", b"y")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_large_logs_are_split_into_chunks_with_checksums(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as writer:
        for stamp in range(6):
            writer.write(image_message(stamp, os.urandom(700_000)))
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) > 2
        assert all(index.compression == "zstd" for index in summary.chunk_indexes)
    assert sum(1 for _ in iterate(path)) == 6


def test_attachments_and_metadata(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as writer:
        writer.attach("rig.yaml", "application/yaml", b"a", stamp_ns=5)
        writer.attach("empty", "text/plain", b"")
        writer.metadata("note", {"by": "test"})
    found = [item for item in iterate(path) if isinstance(item, LoggedAttachment)]
    assert [(item.name, item.media_type, item.data) for item in found] == [
        ("rig.yaml", "application/yaml", b"a"),
        ("empty", "text/plain", b""),
    ]
    with path.open("rb") as file:
        assert [(item.name, item.metadata) for item in make_reader(file).iter_metadata()] == [
            ("note", {"by": "test"})
        ]


def test_a_topic_keeps_its_type(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match="/x carries std_msgs/msg/String and cannot also carry"):
        write_two_types(tmp_path / "a.mcap")
    assert files_in(tmp_path) == []


def write_two_types(path: Path) -> None:
    with LogWriter(path) as writer:
        writer.write(robot_message(topic="/x"))
        writer.write(joint_message(5, ("a",), (0.1,), topic="/x"))


def test_an_existing_file_is_kept_unless_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(TooltipError, match=r"a\.mcap exists; give another name, or --force"):
        LogWriter(path)
    assert path.read_text() == "precious"
    with LogWriter(path, overwrite=True) as writer:
        writer.write(robot_message())
    assert path.read_bytes().startswith(b"\x89MCAP0")
    assert files_in(tmp_path) == ["a.mcap"]


class Interrupted(BaseException):
    """Stands for Ctrl-C and the like."""


@pytest.mark.parametrize("error", [ValueError, TooltipError, KeyboardInterrupt, Interrupted])
def test_nothing_remains_of_a_failure(error: type[BaseException], tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(error):
        fail_within(path, error)
    assert files_in(tmp_path) == ["a.mcap"]
    assert path.read_text() == "precious"


def fail_within(path: Path, error: type[BaseException]) -> None:
    with LogWriter(path, overwrite=True) as writer:
        writer.write(robot_message())
        raise error


def test_the_file_appears_under_its_name_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as writer:
        writer.write(robot_message())
        assert not path.exists()
    assert path.exists()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing/a.mcap", "No such file"),
        ("file/a.mcap", "Not a directory"),
        ("x" * 300, "File name too long"),
        ("y" * 250, "File name too long"),  # with the temporary name's addition
    ],
)
def test_places_that_cannot_be_written(name: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    path = tmp_path / name
    with pytest.raises(TooltipError, match=reason) as caught:
        with_one_message(path)
    assert str(caught.value).startswith(str(path))
    assert files_in(tmp_path) == ["file"]


def with_one_message(path: Path) -> None:
    with LogWriter(path, overwrite=True) as writer:
        writer.write(robot_message())


def test_a_directory_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").mkdir()
    with pytest.raises(TooltipError, match="Is a directory"):
        with_one_message(tmp_path / "a.mcap")
    assert files_in(tmp_path) == ["a.mcap"]


FULL_DISK = """
import os, resource, signal, sys
from pathlib import Path
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import COMPRESSED_IMAGE, Message
from tooltip_cli.log.writer import LogWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
try:
    with LogWriter(Path(sys.argv[1]), overwrite=True) as writer:
        for stamp in range(20):
            writer.write(Message("/image", COMPRESSED_IMAGE, stamp, os.urandom(300_000)))
except TooltipError as error:
    sys.exit(str(error))
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="no file size limit on this system")
@pytest.mark.parametrize("room", [0, 100, 8192, 100_000, 2_000_000])
def test_a_full_disk_is_one_line_and_leaves_nothing(room: int, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("precious")
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path / "a.mcap"), str(room)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        f"{tmp_path / 'a.mcap'}: cannot be written (File too large)"
    ]
    assert files_in(tmp_path) == ["a.mcap"]
    assert (tmp_path / "a.mcap").read_text() == "precious"


def test_permissions_are_those_of_an_ordinary_file(tmp_path: Path) -> None:
    with_one_message(tmp_path / "a.mcap")
    (tmp_path / "b").write_text("")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a.mcap", "b")]
    assert modes[0] == modes[1]
