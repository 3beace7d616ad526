"""Everything that is intact is recovered, nothing else, and what was lost is said."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tests.helpers import damage
from tests.helpers.cli import tooltip
from tests.helpers.damage import Row, chunk_ends, content, salvaged
from tests.helpers.logs import IMAGE_TOPIC, JOINT_TOPIC, Log, wrist_parts, write_log
from tooltip_cli.errors import DamagedLogError, TooltipError
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.salvage import salvage
from tooltip_cli.log.survey import survey

FRAME = struct.Struct("<BQ")
CHUNK_BYTES = 30_000


def repacked(path: Path, out: Path, compression: CompressionType, *, chunked: bool = True) -> Path:
    return damage.repacked(path, out, compression, chunked=chunked, chunk_bytes=CHUNK_BYTES)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in many chunks, as a recorder flushes them."""
    folder = tmp_path_factory.mktemp("good")
    whole = write_log(folder / "whole.mcap", wrist_parts(24))
    return repacked(whole, folder / "good.mcap", CompressionType.ZSTD)


@pytest.fixture(scope="module")
def rows(good: Path) -> list[Row]:
    return content(good)


def records_of(data: bytes) -> list[tuple[int, int, int]]:
    """Return (opcode, offset, length of the content) of the records at top level."""
    found, offset = [], 8
    while offset < len(data) - 8:
        opcode, length = FRAME.unpack_from(data, offset)
        found.append((opcode, offset, length))
        offset += FRAME.size + length
    return found


def chunks_of(data: bytes) -> list[tuple[int, int]]:
    return [(offset, length) for opcode, offset, length in records_of(data) if opcode == 6]


def flipped(data: bytes, *offsets: int) -> bytes:
    changed = bytearray(data)
    for offset in offsets:
        changed[offset] ^= 0x10
    return bytes(changed)


def test_a_whole_file_is_copied_with_all_it_holds(
    good: Path, rows: list[Row], tmp_path: Path
) -> None:
    result = salvage(good, tmp_path / "out.mcap")
    assert (result.state, result.losses, result.notes) == ("whole", (), ())
    assert content(tmp_path / "out.mcap") == rows
    assert {topic: count.lost for topic, count in result.topics.items()} == dict.fromkeys(
        {row[0] for row in rows}, 0
    )
    attached = [
        [item for item in iterate(path) if isinstance(item, LoggedAttachment)]
        for path in (good, tmp_path / "out.mcap")
    ]
    assert attached[0] == attached[1]
    assert result.attachments == tuple(item.name for item in attached[0])


def test_a_file_cut_anywhere(good: Path, rows: list[Row], tmp_path: Path) -> None:
    data, ends = good.read_bytes(), chunk_ends(good)
    assert len(ends) > 3
    broken, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    offsets = random.Random(1).sample(range(len(data)), 40)
    for offset in [*offsets, *(end + shift for end, _ in ends for shift in (-1, 0, 1))]:
        broken.write_bytes(data[:offset])
        complete = sum(count for end, count in ends if end <= offset)
        found = salvaged(broken, out)
        if found is None:
            assert complete == 0
        else:
            assert found == rows[: len(found)]
            assert len(found) >= complete


@pytest.mark.parametrize("compression", CompressionType)
def test_the_whole_messages_of_the_last_chunk(
    compression: CompressionType, good: Path, rows: list[Row], tmp_path: Path
) -> None:
    # packers give their output block by block, of which a chunk must have several
    packed = damage.repacked(good, tmp_path / "packed.mcap", compression, chunk_bytes=1 << 20)
    data = packed.read_bytes()
    offset, length = chunks_of(data)[-1]
    before = sum(count for _, count in chunk_ends(packed)[:-1])
    (tmp_path / "cut.mcap").write_bytes(data[: offset + FRAME.size + length - 10])
    result = salvage(tmp_path / "cut.mcap", tmp_path / "out.mcap")
    found = content(tmp_path / "out.mcap")
    assert found == rows[: len(found)]
    assert len(found) > before
    assert f"of which {len(found) - before} whole messages" in result.losses[-1].reason
    assert result.losses[-1].after_ns == found[-1][2]
    assert result.losses[-1].before_ns is None


@pytest.mark.parametrize("compression", CompressionType)
def test_flipped_bits(compression: CompressionType, good: Path, tmp_path: Path) -> None:
    packed = repacked(good, tmp_path / "packed.mcap", compression)
    data, known = packed.read_bytes(), Counter(content(packed))
    broken, out = tmp_path / "flipped.mcap", tmp_path / "out.mcap"
    rng = random.Random(2)
    for _ in range(40):
        changed = bytearray(data)
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        broken.write_bytes(changed)
        with pytest.raises(TooltipError):
            content(broken)
        assert not survey(broken).whole
        found = salvaged(broken, out)
        assert not Counter(found or []) - known


def test_a_damaged_chunk_costs_no_other(good: Path, rows: list[Row], tmp_path: Path) -> None:
    data = good.read_bytes()
    offset, length = chunks_of(data)[2]
    (tmp_path / "bad.mcap").write_bytes(flipped(data, offset + length // 2))
    result = salvage(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    found = content(tmp_path / "out.mcap")
    gone = Counter(rows) - Counter(found)
    assert result.state == "damaged"
    assert [loss.offset for loss in result.losses] == [offset]
    assert sum(gone.values()) == chunk_ends(good)[2][1]
    expected = Counter(row[0] for row in gone.elements())
    assert result.losses[0].messages == expected
    assert {topic: count.lost for topic, count in result.topics.items() if count.lost} == expected
    times = sorted(row[2] for row in gone)
    loss = result.losses[0]
    assert loss.after_ns is not None
    assert loss.before_ns is not None
    assert loss.after_ns <= times[0] <= times[-1] <= loss.before_ns


def test_each_of_our_chunks_stands_for_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first chunk is lost, and with it nothing that the others need; nor is there a summary."""
    monkeypatch.setattr("tooltip_cli.log.mcapfile.CHUNK_BYTES", CHUNK_BYTES)
    whole = write_log(tmp_path / "a.mcap", wrist_parts(24))
    data = whole.read_bytes()
    chunks = chunks_of(data)
    assert len(chunks) > 3
    cut = chunks[-1][0] + 5
    (tmp_path / "bad.mcap").write_bytes(flipped(data, chunks[0][0] + 100)[:cut])
    result = salvage(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert result.topics[IMAGE_TOPIC].recovered > 0
    assert result.topics[JOINT_TOPIC].recovered > 0


@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("what", ["length", "opcode", "private opcode", "times"])
def test_a_damaged_frame_is_stepped_over(
    what: str, summary: bool, good: Path, rows: list[Row], tmp_path: Path
) -> None:
    data = bytearray(good.read_bytes())
    offset, _ = chunks_of(bytes(data))[1]
    if what == "length":
        data[offset + 4] ^= 0x40  # beyond the end of the file
    elif what == "opcode":
        data[offset] = Opcode.MESSAGE_INDEX
    elif what == "private opcode":
        data[offset] ^= 0x80
    else:
        data[offset + FRAME.size] ^= 0x01
    if not summary:
        del data[-100:]
    (tmp_path / "bad.mcap").write_bytes(data)
    found = salvaged(tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert found is not None
    assert not Counter(found) - Counter(rows)
    most = chunk_ends(good)[1][1] if "opcode" in what else 0
    assert len(found) >= len(rows) - most


def test_damaged_first_bytes(good: Path, rows: list[Row], tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(flipped(good.read_bytes(), 1))
    assert salvaged(tmp_path / "bad.mcap", tmp_path / "out.mcap") == rows


def test_room_that_was_never_written_is_no_data(
    good: Path, rows: list[Row], tmp_path: Path
) -> None:
    """A power cut leaves a file that is as long as it should be, with zeros at its end."""
    data = good.read_bytes()
    offset, length = chunks_of(data)[-1]
    for start in (offset, offset + 30, offset + FRAME.size + length // 2):
        bad = data[:start] + bytes(offset + length - start + 5000)
        (tmp_path / "bad.mcap").write_bytes(bad)
        result = salvage(tmp_path / "bad.mcap", tmp_path / "out.mcap", overwrite=True)
        found = content(tmp_path / "out.mcap")
        assert found == rows[: len(found)]
        assert len(found) >= sum(count for _, count in chunk_ends(good)[:-1])
        assert result.losses


def test_what_carries_no_checksum_is_left_out_of_a_damaged_file(
    good: Path, rows: list[Row], tmp_path: Path
) -> None:
    bare = repacked(good, tmp_path / "bare.mcap", CompressionType.NONE, chunked=False)
    assert salvaged(bare, tmp_path / "out.mcap") == rows
    data = bare.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    found = salvaged(tmp_path / "cut.mcap", tmp_path / "out.mcap")
    assert found
    assert found == rows[: len(found)]
    attachment = next(offset for code, offset, _ in records_of(data) if code == Opcode.ATTACHMENT)
    (tmp_path / "bad.mcap").write_bytes(flipped(data, attachment + 30))
    with pytest.raises(TooltipError, match="messages carry no checksum; --unverified takes them"):
        salvage(tmp_path / "bad.mcap", tmp_path / "nothing.mcap")
    assert not (tmp_path / "nothing.mcap").exists()
    again = salvaged(tmp_path / "bad.mcap", tmp_path / "out.mcap", unverified=True)
    assert again == rows


def test_messages_outside_chunks_are_found_again_behind_damage(
    good: Path, rows: list[Row], tmp_path: Path
) -> None:
    bare = repacked(good, tmp_path / "bare.mcap", CompressionType.NONE, chunked=False)
    data = bytearray(bare.read_bytes())
    messages = [offset for code, offset, _ in records_of(bytes(data)) if code == Opcode.MESSAGE]
    data[messages[10] + 5] ^= 0x40  # a length beyond the file
    del data[-5000:]
    (tmp_path / "bad.mcap").write_bytes(data)
    found = salvaged(tmp_path / "bad.mcap", tmp_path / "out.mcap", unverified=True)
    assert found is not None
    assert found[:10] == rows[:10]
    assert not Counter(found) - Counter(rows)
    assert len(found) > len(rows) // 2


def test_foreign_types_and_encodings_pass_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("my profile", "my library")
        schema = writer.register_schema("my/Type", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/a", "json", schema, {"key": "value"})
        bare = writer.register_channel("/b", "", 0)
        writer.add_message(channel, 7, b"{}", 5, sequence=3)
        writer.add_message(bare, 8, b"\x00", 8, sequence=9)
        writer.add_metadata("about", {"a": "b"})
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    salvage(path, tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found: list[Any] = list(reader.iter_messages())
        header = reader.get_header()
        metadata = [(item.name, item.metadata) for item in reader.iter_metadata()]
    (schema_1, channel_1, message_1), (schema_2, channel_2, message_2) = found
    assert (schema_1.name, schema_1.encoding, schema_1.data) == (
        "my/Type",
        "jsonschema",
        b'{"type": "object"}',
    )
    assert (channel_1.message_encoding, channel_1.metadata) == ("json", {"key": "value"})
    assert (message_1.sequence, message_1.publish_time, message_1.data) == (3, 5, b"{}")
    assert (schema_2, channel_2.topic, message_2.sequence) == (None, "/b", 9)
    assert header.profile == "my profile"
    assert "my library" in header.library
    assert metadata == [("about", {"a": "b"})]


def test_the_command_says_what_was_recovered_and_lost(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    offset, length = chunks_of(data)[1]
    bad, out = tmp_path / "bad.mcap", tmp_path / "out.mcap"
    bad.write_bytes(flipped(data, offset + length // 2))
    done = tooltip("salvage", bad, out)
    assert (done.code, done.out) == (0, f"{out}\n")
    assert f"{bad}: it is damaged" in done.err
    assert f"byte {offset} (a chunk fails its CRC), between 20" in done.err
    assert " lost" in done.err
    document = json.loads(tooltip("salvage", bad, out, "--force", "--json").out)
    assert document["state"] == "damaged"
    assert document["losses"][0]["offset"] == offset
    assert document["topics"][IMAGE_TOPIC]["recovered"] < 24


def test_nothing_is_overwritten_and_the_broken_file_stays(good: Path, tmp_path: Path) -> None:
    bad, out = tmp_path / "bad.mcap", tmp_path / "out.mcap"
    bad.write_bytes(good.read_bytes()[:-3000])
    before = bad.read_bytes()
    out.write_text("precious")
    assert "exists; give another name, or --force" in tooltip("salvage", bad, out).error
    assert "is the broken file itself" in tooltip("salvage", bad, bad, "--force").error
    (tmp_path / "link.mcap").symlink_to(bad)
    link = tmp_path / "link.mcap"
    assert "is the broken file itself" in tooltip("salvage", link, bad, "--force").error
    assert (bad.read_bytes(), out.read_text()) == (before, "precious")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (None, "cannot be read (No such file or directory)"),
        (b"", "is empty"),
        (b"hello", "is not an MCAP file"),
        (b"#ROSBAG V2.0\n" + bytes(60), "'tooltip record bag'"),
        (b"\x89MCAP0\r\n", "holds no message that can be recovered"),
        (b"\x89MCAP0\r\n" + bytes(3000), "holds no message that can be recovered"),
    ],
)
def test_files_that_hold_nothing(data: bytes | None, expected: str, tmp_path: Path) -> None:
    if data is not None:
        (tmp_path / "bad.mcap").write_bytes(data)
    done = tooltip("salvage", tmp_path / "bad.mcap", tmp_path / "out.mcap")
    assert done.code == 1
    assert expected in done.error
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("command", ["detect", "estimate", "evaluate", "export"])
def test_the_stages_refuse_a_damaged_file_and_name_the_remedy(command: str, wrist: Log) -> None:
    data = wrist.path.read_bytes()
    for bad in (data[: len(data) // 2], flipped(data, len(data) // 3)):
        wrist.path.write_bytes(bad)
        extra = ["--tf"] if command == "export" else []
        done = tooltip(command, wrist.path, *extra)
        assert done.code == 1
        assert "'tooltip salvage' recovers" in done.error
        assert "length" not in done.error


def test_a_chunk_is_recovered_by_its_own_length(
    good: Path, rows: list[Row], tmp_path: Path
) -> None:
    """A frame whose length leads into the middle of nowhere, with the summary gone."""
    data = bytearray(good.read_bytes())
    offset, length = chunks_of(bytes(data))[1]
    FRAME.pack_into(data, offset, Opcode.CHUNK, length - 1000)
    del data[-50:]
    (tmp_path / "bad.mcap").write_bytes(data)
    assert salvaged(tmp_path / "bad.mcap", tmp_path / "out.mcap") == rows


def test_a_log_whose_definitions_contradict_one_another_is_damaged(
    good: Path, tmp_path: Path
) -> None:
    data = good.read_bytes()
    end = next(offset for code, offset, _ in records_of(data) if code == Opcode.DATA_END)
    body = struct.pack("<HH", 1, 1) + b"\x02\0\0\0/x" + b"\x03\0\0\0cdr" + bytes(4)
    extra = FRAME.pack(Opcode.CHANNEL, len(body)) + body
    changed = data[:end] + extra
    tail = FRAME.pack(Opcode.DATA_END, 4) + struct.pack("<I", zlib.crc32(changed))
    footer = FRAME.pack(Opcode.FOOTER, 20) + bytes(20)
    (tmp_path / "bad.mcap").write_bytes(changed + tail + footer + data[-8:])
    with pytest.raises(DamagedLogError, match="channel 1 is defined twice, differently"):
        content(tmp_path / "bad.mcap")
