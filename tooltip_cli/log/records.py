"""MCAP records from bytes that a stranger may have written: nothing is allocated before its bound.

Source: MCAP specification, section "Records".
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Schema

MAX_CHUNK_BYTES = 1 << 27
"""Largest chunk that is read, packed or unpacked; writers make chunks of a few MiB at most."""
MAX_RECORD_BYTES = 1 << 28
"""Largest other record that is read into memory; a message outside chunks may be a large image."""

_Record = TypeVar("_Record", bound=McapRecord)

FRAME = struct.Struct("<BQ")  # opcode and length before every record
CRC = struct.Struct("<I")
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first and last log time, unpacked size, CRC, name length
_LENGTH = struct.Struct("<Q")
_COMPRESSIONS = ("", "lz4", "zstd")


class RecordError(ValueError):
    """A record that is not what it says; the text names what is wrong."""


@dataclass(frozen=True, slots=True)
class LoggedSchema:
    """The definition of a type."""

    name: str
    encoding: str
    text: bytes


@dataclass(frozen=True, slots=True)
class LoggedChannel:
    """What is common to the messages of a topic from one publisher."""

    topic: str
    encoding: str  # message encoding, "cdr" for ROS 2
    schema: LoggedSchema | None
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """A chunk before it is unpacked."""

    start_ns: int
    end_ns: int
    size: int  # bytes when unpacked
    crc: int  # of the unpacked bytes; 0: none
    compression: str
    data: memoryview


def chunk_head(body: memoryview) -> ChunkHead:
    """Read the fields of a chunk record.

    Raises:
        RecordError: it is too short, too large, or compressed in an unknown way.
    """
    start_ns, end_ns, size, crc, compression, packed, place = _chunk_fields(body)
    if max(size, packed) > MAX_CHUNK_BYTES:
        raise RecordError(
            f"a chunk claims {max(size, packed)} bytes, more than {MAX_CHUNK_BYTES >> 20} MiB"
        )
    if packed > len(body) - place:
        raise RecordError("a chunk ends before its data do")
    return ChunkHead(start_ns, end_ns, size, crc, compression, body[place : place + packed])


def chunk_beginning(body: memoryview) -> bytes:
    """Return as much of a chunk's records as the beginning of its record gives, unchecked.

    Raises:
        RecordError: not even its fields are there.
    """
    *_, compression, packed, place = _chunk_fields(body)
    return _unpack_beginning(compression, body[place : place + packed])


def chunk_length(beginning: bytes) -> int:
    """Return the length of a chunk record's content by its own fields.

    Raises:
        RecordError: they are not there.
    """
    *_, packed, place = _chunk_fields(memoryview(beginning))
    return place + packed


def _chunk_fields(body: memoryview) -> tuple[int, int, int, int, str, int, int]:
    """Return first and last time, size, CRC, compression, packed size, where the data start."""
    try:
        start_ns, end_ns, size, crc, length = _CHUNK.unpack_from(body)
        place = _CHUNK.size + min(length, 64)
        compression = bytes(body[_CHUNK.size : place]).decode()
        (packed,) = _LENGTH.unpack_from(body, place)
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordError(f"a chunk cannot be unpacked ({error})") from error
    if compression not in _COMPRESSIONS or length != len(compression):
        raise RecordError(f"a chunk is compressed with {compression!r}")
    return start_ns, end_ns, size, crc, compression, packed, place + _LENGTH.size


def unpack(chunk: ChunkHead) -> bytes:
    """Return the records of a chunk, of the size and with the CRC that it claims.

    Raises:
        RecordError: the data are not that.
    """
    try:
        records = _unpacked(chunk)
    except (zstandard.ZstdError, RuntimeError) as error:
        raise RecordError(f"a chunk cannot be unpacked ({error})") from error
    if len(records) != chunk.size:
        raise RecordError("a chunk has another size than it claims")
    if chunk.crc and zlib.crc32(records) != chunk.crc:
        raise RecordError("a chunk fails its CRC")
    return records


def _unpacked(chunk: ChunkHead) -> bytes:
    """Return at most one byte more than claimed, whatever the packed data say of themselves."""
    if chunk.compression == "lz4":
        frame = lz4.frame.LZ4FrameDecompressor()
        return bytes(frame.decompress(chunk.data, max_length=chunk.size + 1))
    if chunk.compression == "zstd":
        return unpack_zstd(chunk.data, chunk.size)
    return bytes(chunk.data)


def unpack_zstd(data: memoryview | bytes, limit: int) -> bytes:
    """Return what a zstd frame holds, or its first ``limit`` + 1 bytes where it is more.

    Raises:
        zstandard.ZstdError: it is no such frame.
    """
    unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
    if 0 <= zstandard.frame_content_size(data) <= limit:
        return bytes(unpacker.decompress(data))
    with unpacker.stream_reader(data) as reader:
        return bytes(reader.read(limit + 1))


def _unpack_beginning(compression: str, data: memoryview) -> bytes:
    if compression == "lz4":
        frame = lz4.frame.LZ4FrameDecompressor()
        try:
            return bytes(frame.decompress(data, max_length=MAX_CHUNK_BYTES))
        except RuntimeError:
            return b""
    if compression == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        parts: list[bytes] = []
        size = 0
        try:
            with unpacker.stream_reader(data) as reader:
                while (part := reader.read(1 << 16)) and size < MAX_CHUNK_BYTES:
                    parts.append(part)
                    size += len(part)
        except zstandard.ZstdError:
            pass  # the part ends where it ends
        return b"".join(parts)
    return bytes(data)


def inner_records(records: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start of content, length) of the records inside a chunk.

    Raises:
        RecordError: the chunk ends inside a record; what came before was whole.
    """
    position, size = 0, len(records)
    while position < size:
        if position + FRAME.size > size:
            raise RecordError("a chunk ends inside a record")
        opcode, length = FRAME.unpack_from(records, position)
        position += FRAME.size
        if length > size - position:
            raise RecordError("a record is longer than its chunk")
        yield opcode, position, length
        position += length


def parsed(kind: type[_Record], data: bytes) -> _Record:
    """Return a small record of one of the library's kinds.

    Raises:
        RecordError: the bytes are not one.
    """
    try:
        record: _Record = kind.read(ReadDataStream(BytesIO(data)))  # type: ignore[attr-defined]
    except (McapError, struct.error, ValueError) as error:
        raise RecordError(f"a record cannot be read ({error!r})") from error
    return record


def read_attachment(data: bytes) -> Attachment:
    """Return an attachment whose CRC holds.

    Raises:
        RecordError: it does not, or it is no attachment.
    """
    if len(data) < CRC.size:
        raise RecordError("a record cannot be read (an attachment that is too short)")
    (stored,) = CRC.unpack_from(data, len(data) - CRC.size)
    if stored and zlib.crc32(memoryview(data)[: -CRC.size]) != stored:
        raise RecordError("an attachment fails its CRC")
    return parsed(Attachment, data)


class Definitions:
    """The schemas and channels of a log, as far as it was read."""

    def __init__(self) -> None:
        self._schemas: dict[int, LoggedSchema] = {}
        self._channels: dict[int, Channel] = {}
        self._known: dict[int, LoggedChannel] = {}
        self._bodies: dict[tuple[int, int], bytes] = {}

    def copy(self) -> Definitions:
        """Return the same definitions, to which others can be added."""
        other = Definitions()
        other._schemas, other._channels = dict(self._schemas), dict(self._channels)
        other._known, other._bodies = dict(self._known), dict(self._bodies)
        return other

    def take(self, opcode: int, body: bytes) -> None:
        """Remember a schema or a channel; other records are ignored.

        Raises:
            RecordError: it cannot be read, or says something else than an earlier one.
        """
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        key = opcode, int.from_bytes(body[:2], "little")
        known = self._bodies.get(key)
        if known is not None:
            if known != body:
                kind = "schema" if opcode == Opcode.SCHEMA else "channel"
                raise RecordError(f"{kind} {key[1]} is defined twice, differently")
            return
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, body)
            self._schemas[schema.id] = LoggedSchema(schema.name, schema.encoding, schema.data)
        else:
            channel = parsed(Channel, body)
            self._channels[channel.id] = channel
        self._bodies[key] = body

    def channel(self, number: int) -> LoggedChannel:
        """Return a channel by its number.

        Raises:
            RecordError: there is none.
        """
        known = self._known.get(number)
        if known is None:
            channel = self._channels.get(number)
            if channel is None:
                raise RecordError(f"a message names the unknown channel {number}")
            schema = self._schemas.get(channel.schema_id)
            known = LoggedChannel(
                channel.topic, channel.message_encoding, schema, dict(channel.metadata)
            )
            self._known[number] = known
        return known
