"""MCAP records: everything intact is read, everything damaged is said, nothing is made up."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from tests.helpers import refusal
from tests.helpers.logs import joint_message, robot_message
from tooltip_cli.errors import DamagedLogError, TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.container import (
    LoggedAttachment,
    LoggedMessage,
    iterate,
    open_log,
    read_chunk,
)
from tooltip_cli.log.writer import LogWriter

FRAME = struct.Struct("<BQ")


def small_log(path: Path) -> Path:
    """Write two topics, two attachments and metadata: every kind of record that we write."""
    with LogWriter(path) as writer:
        writer.write(robot_message("<robot/>"))
        for step in range(40):
            writer.write(joint_message(10**18 + step, ("a", "b"), (0.1 * step, -step)))
        writer.attach("rig.yaml", "application/yaml", b"hand: {frame: h}")
        writer.metadata("made by", {"a": "test"})
        writer.attach("noise.bin", "application/octet-stream", bytes(range(256)))
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return small_log(tmp_path_factory.mktemp("log") / "whole.mcap").read_bytes()


def content(path: Path) -> list[tuple[Any, ...]]:
    """Return what a log says, without where it says it."""
    return [
        (item.name, item.media_type, item.data)
        if isinstance(item, LoggedAttachment)
        else (item.topic, item.datatype, item.encoding, item.log_time_ns, item.payload)
        for item in iterate(path)
    ]


def test_everything_is_read_in_file_order(whole: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(whole)
    items = list(iterate(tmp_path / "a.mcap"))
    topics = [item.topic for item in items if isinstance(item, LoggedMessage)]
    assert topics == ["/robot_description"] + ["/joint_states"] * 40
    names = [item.name for item in items if isinstance(item, LoggedAttachment)]
    assert names == ["rig.yaml", "noise.bin"]
    with (tmp_path / "a.mcap").open("rb") as file:
        for item in items:
            if isinstance(item, LoggedMessage):
                chunk = read_chunk(file, item.chunk_offset, tmp_path / "a.mcap")
                assert chunk[item.offset : item.offset + len(item.payload)] == item.payload


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("crcs", [True, False])
def test_foreign_logs_of_every_kind(
    compression: CompressionType, chunked: bool, crcs: bool, tmp_path: Path
) -> None:
    path = tmp_path / "foreign.mcap"
    rows = [(5, b"first"), (3, b"earlier, logged later"), (5, b"again"), (9, b"")]
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            compression=compression,
            use_chunking=chunked,
            enable_crcs=crcs,
            chunk_size=10,
            index_types=IndexType.ALL if crcs else IndexType.NONE,
            use_statistics=crcs,
            use_summary_offsets=crcs,
        )
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        bare = writer.register_channel("/no_schema", "json", 0)
        for time, data in rows:
            writer.add_message(channel, time, data, time + 1)
        writer.add_message(bare, 7, b"{}", 7)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    found = [item for item in iterate(path) if isinstance(item, LoggedMessage)]
    assert [(item.log_time_ns, item.payload) for item in found[:4]] == rows
    assert [item.publish_time_ns for item in found[:4]] == [6, 4, 6, 10]
    assert (found[4].datatype, found[4].encoding) == ("", "json")
    with path.open("rb") as file:
        for item in found:
            if chunked:
                data = read_chunk(file, item.chunk_offset, path)
            else:
                assert item.chunk_offset == -1
                data = path.read_bytes()
            assert data[item.offset : item.offset + len(item.payload)] == item.payload


def test_the_library_reads_what_we_write_with_every_checksum(whole: bytes) -> None:
    reader = make_reader(io.BytesIO(whole), validate_crcs=True)
    header = reader.get_header()
    assert header.profile == "ros2"
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 41
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert "offered_qos_profiles" in channel.metadata
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
    assert sum(1 for _ in reader.iter_messages()) == 41
    assert [item.name for item in reader.iter_attachments()] == ["rig.yaml", "noise.bin"]


def test_a_log_cut_anywhere_is_refused(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    for length in {*range(120), *range(0, len(whole), 7), *range(len(whole) - 120, len(whole))}:
        path.write_bytes(whole[:length])
        message = refusal(lambda: content(path))
        assert message is not None, f"cut to {length} bytes"
        assert str(path) in message
        assert "salvage" in message or length < 8, message


def test_every_flipped_bit_is_found_or_harmless(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "flipped.mcap"
    path.write_bytes(whole)
    expected = content(path)
    rng = np.random.default_rng(7)
    refused = 0
    for offset in rng.integers(0, len(whole), 300):
        bad = bytearray(whole)
        bad[offset] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        message = refusal(lambda: content(path))
        if message is None:
            assert content(path) == expected
        else:
            refused += 1
            assert str(path) in message
            assert "salvage" in message or offset < 8
    assert refused > 250


def framing(data: bytes) -> list[tuple[int, int, int]]:
    """Return (opcode, offset, length) of the top-level records."""
    records, offset = [], 8
    while offset < len(data) - 8:
        opcode, length = FRAME.unpack_from(data, offset)
        records.append((opcode, offset, length))
        offset += FRAME.size + length
    return records


def test_the_framing_is_guarded(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "flipped.mcap"
    path.write_bytes(whole)
    expected = content(path)
    places = [offset + byte for _, offset, _ in framing(whole) for byte in range(FRAME.size)]
    places += range(len(whole) - 8 - 29 - 13, len(whole))  # end of data, footer, closing magic
    for place in places:
        for bit in (0, 1, 3, 7):
            bad = bytearray(whole)
            bad[place] ^= 1 << bit
            path.write_bytes(bad)
            message = refusal(lambda: content(path))
            if message is None:
                assert content(path) == expected
            else:
                assert str(path) in message
                assert "salvage" in message


def test_what_was_yielded_before_the_damage_is_intact(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole)
    expected = content(path)
    chunk = next(place for code, place, _ in framing(whole) if code == Opcode.CHUNK)
    path.write_bytes(whole[: chunk + 20])
    found: list[tuple[Any, ...]] = []

    def read() -> None:
        found.extend(
            (item.name, item.media_type, item.data)
            for item in iterate(path)
            if isinstance(item, LoggedAttachment)
        )

    assert f"truncated: it ends inside the record at byte {chunk};" in (refusal(read) or "")
    assert found == expected[:2]


def spoiled(data: bytes, opcode: int, position: int, *, fix_data_crc: bool) -> bytes:
    """Flip one byte of the first record of a kind; optionally repair the data section's CRC."""
    bad = bytearray(data)
    offset = next(place for code, place, _ in framing(data) if code == opcode)
    bad[offset + FRAME.size + position] ^= 0xFF
    if fix_data_crc:
        end = next(place for code, place, _ in framing(data) if code == Opcode.DATA_END)
        struct.pack_into("<I", bad, end + FRAME.size, zlib.crc32(bytes(bad[:end])))
    return bytes(bad)


@pytest.mark.parametrize("fix_data_crc", [True, False])
def test_a_damaged_attachment_fails_its_own_crc(
    fix_data_crc: bool, whole: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(spoiled(whole, Opcode.ATTACHMENT, 50, fix_data_crc=fix_data_crc))
    with pytest.raises(DamagedLogError, match="an attachment fails its CRC"):
        content(path)


def test_a_damaged_chunk_fails_its_own_crc(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(spoiled(whole, Opcode.CHUNK, 24, fix_data_crc=True))  # its stored CRC
    with pytest.raises(DamagedLogError, match="a chunk fails its CRC"):
        content(path)


def test_a_damaged_header_fails_the_data_sections_crc(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(spoiled(whole, Opcode.HEADER, 6, fix_data_crc=False))
    with pytest.raises(DamagedLogError, match="the data section fails its CRC"):
        content(path)


def record(opcode: int, body: bytes) -> bytes:
    return FRAME.pack(opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk_of(records: bytes, *, claimed: int | None = None, compression: str = "") -> bytes:
    size = len(records) if claimed is None else claimed
    head = struct.pack("<QQQI", 0, 0, size, 0) + text(compression)
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(records)) + records)


def file_of(*records: bytes) -> bytes:
    magic = b"\x89MCAP0\r\n"
    end = record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, bytes(20))
    return magic + record(Opcode.HEADER, text("ros2") + text("x")) + b"".join(records) + end + magic


MESSAGE = record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 5, 5) + b"payload")
CHANNEL = record(
    Opcode.CHANNEL, struct.pack("<HH", 1, 0) + text("/a") + text("cdr") + struct.pack("<I", 0)
)
WITHOUT_CRC: dict[str, tuple[bytes, str]] = {
    "unknown channel": (file_of(MESSAGE), "unknown channel 1"),
    "unknown channel in a chunk": (file_of(chunk_of(MESSAGE)), "unknown channel 1"),
    "short message": (
        file_of(CHANNEL, record(Opcode.MESSAGE, bytes(5))),
        "a record cannot be read",
    ),
    "short channel": (file_of(record(Opcode.CHANNEL, bytes(3))), "a record cannot be read"),
    "channel that is no text": (
        file_of(CHANNEL.replace(b"/a", b"\xff\xfe")),
        "a record cannot be read",
    ),
    "short schema": (file_of(record(Opcode.SCHEMA, b"\x01")), "a record cannot be read"),
    "short attachment": (file_of(record(Opcode.ATTACHMENT, bytes(3))), "a record cannot be read"),
    "short chunk": (file_of(record(Opcode.CHUNK, bytes(9))), "a chunk cannot be unpacked"),
    "chunk ends in a frame": (file_of(chunk_of(CHANNEL + b"\x05\x00")), "ends inside a record"),
    "record longer than its chunk": (
        file_of(chunk_of(FRAME.pack(Opcode.MESSAGE, 10**12) + b"x")),
        "longer than its chunk",
    ),
    "giant chunk": (file_of(chunk_of(CHANNEL, claimed=1 << 40)), "more than 128 MiB"),
    "chunk of another size": (file_of(chunk_of(CHANNEL, claimed=7)), "another size"),
    "chunk that is not zstd": (
        file_of(chunk_of(b"hello", compression="zstd")),
        "a chunk cannot be unpacked",
    ),
    "chunk that is not lz4": (
        file_of(chunk_of(b"hello" * 9, compression="lz4")),
        "a chunk cannot be unpacked",
    ),
    "unknown compression": (
        file_of(chunk_of(b"hello", compression="rar")),
        "compressed with 'rar'",
    ),
    "giant record": (
        b"\x89MCAP0\r\n" + FRAME.pack(Opcode.HEADER, 1 << 63) + bytes(50),
        "truncated",
    ),
    "long end of data": (
        b"\x89MCAP0\r\n" + record(Opcode.DATA_END, bytes(8)) + bytes(60),
        "wrong length",
    ),
    "no footer": (
        b"\x89MCAP0\r\n" + record(Opcode.DATA_END, bytes(4)) + bytes(40) + b"\x89MCAP0\r\n",
        "footer",
    ),
    "magic alone": (b"\x89MCAP0\r\n", "truncated"),
}


@pytest.mark.parametrize(("data", "expected"), WITHOUT_CRC.values(), ids=WITHOUT_CRC.keys())
def test_nonsense_without_checksums_is_damage(data: bytes, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with pytest.raises(DamagedLogError) as caught:
        content(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert expected in message
    assert "tooltip salvage" in message
    assert "\n" not in message


def test_records_of_the_future_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(file_of(record(0x7F, b"??"), CHANNEL, record(0x90, b""), MESSAGE))
    assert content(path) == [("/a", "", "cdr", 5, b"payload")]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "is empty; expected an MCAP recording"),
        (b"#ROSBAG V2.0\n" + bytes(50), "ROS 1 bag; import it with 'tooltip record bag'"),
        (b"SQLite format 3\x00" + bytes(50), "'tooltip record bag'"),
        (b"PK\x03\x04" + bytes(50), "expected an MCAP recording"),
        (b"hello", "expected an MCAP recording"),
        (b"\x89MCAP", "expected an MCAP recording"),
        (b"\x89MCAP1\r\n" + bytes(50), "expected an MCAP recording"),
        (b"\x89MCAP0\n\n" + bytes(50), "expected an MCAP recording"),
    ],
)
def test_other_formats_are_named(data: bytes, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with pytest.raises(TooltipError) as caught:
        open_log(path)
    assert str(caught.value).startswith(str(path))
    assert expected in str(caught.value)


def test_missing_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match=r"nothing\.mcap: cannot be opened \(No such file"):
        open_log(tmp_path / "nothing.mcap")
    with pytest.raises(TooltipError, match="is a directory; give the "):
        open_log(tmp_path)
    with pytest.raises(TooltipError, match="cannot be opened"):
        open_log(tmp_path / ("x" * 300))


def test_messages_survive_the_container(whole: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(whole)
    rows = [
        messages.decode(item.datatype, item.payload)
        for item in iterate(tmp_path / "a.mcap")
        if isinstance(item, LoggedMessage) and item.topic == "/joint_states"
    ]
    assert [list(row.position) for row in rows] == [[0.1 * step, -step] for step in range(40)]
