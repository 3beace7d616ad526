"""The MCAP container read record by record, every checksum verified.

The library's readers verify no checksum unless told to and report a truncated file as a record of
impossible length. Here each record's declared length is compared with what is left of the file
before anything is read, and whatever is wrong is said as what it is.

Source: MCAP specification, sections "File Structure" and "Records".
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Schema
from mcap.stream_reader import get_chunk_data_stream

from tooltip_cli.errors import DamagedLogError, TooltipError
from tooltip_cli.log.mcapfile import MAGIC

MAX_CHUNK_BYTES = 1 << 30
_COMPRESSIONS = ("", "lz4", "zstd")
_FRAME = struct.Struct("<BQ")  # opcode and length before every record
_CRC = struct.Struct("<I")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """One message of a log, in file order."""

    topic: str
    datatype: str
    encoding: str  # message encoding, "cdr" for ROS 2
    log_time_ns: int
    publish_time_ns: int
    payload: bytes
    chunk_offset: int  # where its chunk starts in the file; -1 when it stands alone
    offset: int  # of the payload, in the decompressed chunk or in the file


@dataclass(frozen=True, slots=True)
class LoggedAttachment:
    """One attachment of a log."""

    name: str
    media_type: str
    data: bytes


def read_chunk(file: BinaryIO, offset: int, path: Path) -> bytes:
    """Return the verified, decompressed records of the chunk that starts at ``offset``.

    Raises:
        DamagedLogError: the chunk is damaged.
    """
    file.seek(offset)
    _, length = _FRAME.unpack(file.read(_FRAME.size))
    return _decompress(file.read(length), path, offset)


def iterate(path: Path) -> Iterator[LoggedMessage | LoggedAttachment]:
    """Yield messages and attachments in file order.

    Memory: one chunk at a time.

    Raises:
        TooltipError: the file is missing, empty, unreadable, or not MCAP.
        DamagedLogError: it is truncated or a checksum fails; what was yielded before is intact.
    """
    with open_log(path) as file:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for opcode, offset, data in _records(file, path):
            try:
                if opcode == Opcode.CHUNK:
                    chunk = _decompress(data, path, offset)
                    for inner, start, length in _frames(chunk, path, offset):
                        body = memoryview(chunk)[start : start + length]
                        yield from _take(inner, body, schemas, channels, (offset, start), path)
                elif opcode == Opcode.ATTACHMENT:
                    (stored,) = _CRC.unpack(data[-_CRC.size :])
                    if stored and zlib.crc32(data[: -_CRC.size]) != stored:
                        raise _damaged(path, offset, "an attachment fails its CRC")
                    attachment = Attachment.read(_stream(data))
                    yield LoggedAttachment(attachment.name, attachment.media_type, attachment.data)
                else:
                    yield from _take(
                        opcode,
                        memoryview(data),
                        schemas,
                        channels,
                        (-1, offset + _FRAME.size),
                        path,
                    )
            except (McapError, struct.error, ValueError, IndexError) as error:
                raise _damaged(path, offset, f"a record cannot be read ({error!r})") from error


def open_log(path: Path) -> BinaryIO:
    """Open a file that starts as MCAP does.

    Raises:
        TooltipError: it is missing, a directory, empty, unreadable, or another format.
    """
    try:
        if path.is_dir():
            raise TooltipError(
                f"{path} is a directory; give the .mcap file in it, or import it with "
                "'tooltip record bag'"
            )
        file = path.open("rb")
    except OSError as error:
        raise TooltipError(f"{path}: cannot be opened ({error.strerror})") from error
    magic = file.read(len(MAGIC))
    if magic == MAGIC:
        return file
    file.close()
    if not magic:
        raise TooltipError(f"{path} is empty; expected an MCAP recording")
    remedy = "expected an MCAP recording"
    if magic.startswith(b"#ROSBAG"):
        remedy = "it is a ROS 1 bag; import it with 'tooltip record bag'"
    elif magic.startswith(b"SQLite"):
        remedy = "it is an SQLite file; import ROS 2 bags with 'tooltip record bag'"
    raise TooltipError(f"{path} is not an MCAP file: {remedy}")


def _records(file: BinaryIO, path: Path) -> Iterator[tuple[int, int, bytes]]:
    """Yield (opcode, offset, content) of the records at top level, up to the footer."""
    size = path.stat().st_size
    offset, checksum = len(MAGIC), zlib.crc32(MAGIC)
    while True:
        frame = file.read(_FRAME.size)
        if len(frame) < _FRAME.size:
            raise _truncated(path, offset)
        opcode, length = _FRAME.unpack(frame)
        if length > size - offset - _FRAME.size:
            raise _truncated(path, offset)
        data = file.read(length)
        if opcode == Opcode.DATA_END:
            if length != _CRC.size:
                raise _damaged(path, offset, "the end of the data section has the wrong length")
            (stored,) = _CRC.unpack(data)
            if stored and stored != checksum:
                raise _damaged(path, offset, "the data section fails its CRC")
            break
        checksum = zlib.crc32(data, zlib.crc32(frame, checksum))
        yield opcode, offset, data
        offset += _FRAME.size + length
    _check_summary(file, path)


def _check_summary(file: BinaryIO, path: Path) -> None:
    """Verify what follows the data section: the summary's CRC and the closing magic bytes."""
    start = file.tell()
    tail = file.read()
    footer_size = _FRAME.size + 20
    if len(tail) < footer_size + len(MAGIC) or tail[-len(MAGIC) :] != MAGIC:
        raise _truncated(path, start)
    summary, footer_record = tail[: -footer_size - len(MAGIC)], tail[-footer_size - len(MAGIC) :]
    if footer_record[0] != Opcode.FOOTER:
        raise _damaged(path, start, "the footer is not where it belongs")
    footer = Footer.read(_stream(footer_record[_FRAME.size : footer_size]))
    if footer.summary_crc:
        # the footer's own bytes up to the checksum belong to what is summed
        actual = zlib.crc32(footer_record[: footer_size - 4], zlib.crc32(summary))
        if actual != footer.summary_crc:
            raise _damaged(path, start, "the summary fails its CRC")


def _decompress(data: bytes, path: Path, offset: int) -> bytes:
    try:
        chunk = Chunk.read(_stream(data))
        if max(chunk.uncompressed_size, len(chunk.data)) > MAX_CHUNK_BYTES:
            raise _damaged(
                path, offset, f"a chunk claims {chunk.uncompressed_size} bytes, more than 1 GiB"
            )
        if chunk.compression not in _COMPRESSIONS:  # the library would take it as it is
            raise _damaged(path, offset, f"a chunk is compressed with {chunk.compression!r}")
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    except DamagedLogError:
        raise
    except Exception as error:  # each compressor raises errors of its own
        raise _damaged(path, offset, f"a chunk cannot be unpacked ({error!r})") from error
    if length != chunk.uncompressed_size:
        raise _damaged(path, offset, "a chunk has another size than it claims")
    return stream.read(length)


def _frames(chunk: bytes, path: Path, offset: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start of content, length) of the records inside a chunk."""
    position = 0
    while position < len(chunk):
        if position + _FRAME.size > len(chunk):
            raise _damaged(path, offset, "a chunk ends inside a record")
        opcode, length = _FRAME.unpack_from(chunk, position)
        position += _FRAME.size
        if length > len(chunk) - position:
            raise _damaged(path, offset, "a record is longer than its chunk")
        yield opcode, position, length
        position += length


def _take(
    opcode: int,
    body: memoryview,
    schemas: dict[int, Schema],
    channels: dict[int, Channel],
    place: tuple[int, int],
    path: Path,
) -> Iterator[LoggedMessage]:
    """Remember schemas and channels; yield messages. ``place``: chunk offset, start of content."""
    if opcode == Opcode.SCHEMA:
        schema = Schema.read(_stream(bytes(body)))
        schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(_stream(bytes(body)))
        channels[channel.id] = channel
    elif opcode == Opcode.MESSAGE:
        channel_id, _, log_time, publish_time = _MESSAGE.unpack_from(body)
        known = channels.get(channel_id)
        if known is None:
            raise _damaged(path, place[0], f"a message names the unknown channel {channel_id}")
        message_schema = schemas.get(known.schema_id)
        yield LoggedMessage(
            known.topic,
            message_schema.name if message_schema else "",
            known.message_encoding,
            log_time,
            publish_time,
            bytes(body[_MESSAGE.size :]),
            place[0],
            place[1] + _MESSAGE.size,
        )


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))


def _truncated(path: Path, offset: int) -> DamagedLogError:
    return DamagedLogError(
        f"{path} is truncated: it ends inside the record at byte {offset}; 'tooltip salvage' "
        "recovers what is complete"
    )


def _damaged(path: Path, offset: int, what: str) -> DamagedLogError:
    return DamagedLogError(
        f"{path} is damaged at byte {max(offset, 0)}: {what}; 'tooltip salvage' recovers what is "
        "intact"
    )
