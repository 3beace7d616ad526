"""Appending to an MCAP file so that each part of it stands for itself.

Every chunk repeats the schemas and channels of its messages: whatever else of the file is lost, its
messages can still be named and read. Everything goes straight to the operating system, and
:attr:`McapFile.intact_bytes` says up to where the file is made of complete records.

Source: MCAP specification, sections "Records" and "Summary Section".
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
_COMPRESSION = "zstd"
_LEVEL = 1  # JPEG does not shrink, whatever the level
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_MESSAGE_FIELDS = 22  # bytes of a message record before its data
_CHUNK = struct.Struct(f"<BQQQQII{len(_COMPRESSION)}sQ")
_CHUNK_FIELDS = _CHUNK.size - 9
_Waiting = tuple[int, int, bytes, bytes]  # channel, log time, head of the record, payload


class McapFile:
    """One MCAP file being written; errors of the operating system pass through.

    Args:
        file: open for writing, empty, without a buffer of Python's own.
        library: what the header says about the program that wrote it.
    """

    def __init__(self, file: BinaryIO, *, profile: str, library: str) -> None:
        self._file = file
        self._crc = 0  # of the data section so far
        self._written = 0
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, tuple[int, bytes]] = {}  # schema, record
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._waiting: list[_Waiting] = []
        self._waiting_bytes = 0
        self._chunk_indexes = bytearray()  # as records, a tenth of what objects take
        self._chunks = 0
        self._times: list[int] = []  # the first and the last log time
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}  # messages in the file, by channel
        self._sequences: dict[int, int] = {}  # messages given, by channel
        self._append(MAGIC, _packed(Header(profile, library)))

    @property
    def intact_bytes(self) -> int:
        """Bytes from the start of the file that are complete records."""
        return self._written

    def add_schema(self, name: str, encoding: str, text: bytes) -> int:
        """Return the number of a new schema."""
        number = len(self._schemas) + 1
        self._schemas[number] = _packed(Schema(number, text, encoding, name))
        return number

    def add_channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]
    ) -> int:
        """Return the number of a new channel."""
        number = len(self._channels) + 1
        record = Channel(number, topic, encoding, dict(metadata), schema)
        self._channels[number] = schema, _packed(record)
        return number

    def add_message(
        self,
        channel: int,
        log_time_ns: int,
        publish_time_ns: int,
        payload: bytes,
        sequence: int | None = None,
    ) -> None:
        """Append a message; ``sequence``: None counts the messages of a channel from 1."""
        if sequence is None:
            sequence = self._sequences[channel] = self._sequences.get(channel, 0) + 1
        head = _MESSAGE.pack(
            Opcode.MESSAGE,
            _MESSAGE_FIELDS + len(payload),
            channel,
            sequence & 0xFFFFFFFF,
            log_time_ns,
            publish_time_ns,
        )
        # one step, so that an exception from a signal leaves a message whole or out
        self._waiting.append((channel, log_time_ns, head, payload))
        self._waiting_bytes += len(head) + len(payload)
        if self._waiting_bytes >= CHUNK_BYTES:
            self.flush()

    @property
    def waiting(self) -> int:
        """Messages that wait for :meth:`flush`."""
        return len(self._waiting)

    def flush(self, limit: int | None = None) -> None:
        """Write the messages that wait, or the first of them, as a chunk of their own."""
        messages = self._waiting[:limit]
        if not messages:
            return
        records, entries = self._chunk_records(messages)
        packed = self._compressor.compress(records)
        times = [time for _, time, _, _ in messages]
        head = _CHUNK.pack(
            Opcode.CHUNK,
            _CHUNK_FIELDS + len(packed),
            min(times),
            max(times),
            len(records),
            zlib.crc32(records),
            len(_COMPRESSION),
            _COMPRESSION.encode(),
            len(packed),
        )
        start = self._written
        builder = RecordBuilder()
        offsets = {}
        for channel, pairs in entries.items():
            offsets[channel] = start + len(head) + len(packed) + builder.count
            MessageIndex(channel, pairs).write(builder)
        indexes = _taken(builder)
        self._append(head, packed, indexes)
        self._waiting = self._waiting[len(messages) :]
        self._waiting_bytes = sum(len(head) + len(payload) for *_, head, payload in self._waiting)
        for channel, pairs in entries.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(pairs)
        index = ChunkIndex(
            chunk_length=len(head) + len(packed),
            chunk_start_offset=start,
            compression=_COMPRESSION,
            compressed_size=len(packed),
            message_end_time=max(times),
            message_index_length=len(indexes),
            message_index_offsets=offsets,
            message_start_time=min(times),
            uncompressed_size=len(records),
        )
        self._chunk_indexes += _packed(index)
        self._chunks += 1
        self._times = [min(times + self._times), max(times + self._times)]

    def drop_waiting(self) -> None:
        """Give up the messages that wait, where no room is left for them."""
        self._waiting, self._waiting_bytes = [], 0

    def _chunk_records(
        self, messages: list[_Waiting]
    ) -> tuple[bytes, dict[int, list[tuple[int, int]]]]:
        """Return the records of a chunk, and by channel each message's log time and offset."""
        parts: list[bytes] = []
        size = 0
        schemas: set[int] = {0}
        entries: dict[int, list[tuple[int, int]]] = {}
        for channel, log_time_ns, head, payload in messages:
            if channel not in entries:
                schema, definition = self._channels[channel]
                if schema not in schemas:
                    schemas.add(schema)
                    definition = self._schemas[schema] + definition
                parts.append(definition)
                size += len(definition)
                entries[channel] = []
            entries[channel].append((log_time_ns, size))
            parts += (head, payload)
            size += len(head) + len(payload)
        return b"".join(parts), entries

    def add_attachment(self, name: str, media_type: str, data: bytes, stamp_ns: int) -> None:
        """Append an attachment."""
        record = _packed(Attachment(stamp_ns, stamp_ns, name, media_type, data))
        start = self._written
        self._append(record)
        self._attachment_indexes.append(
            AttachmentIndex(start, len(record), stamp_ns, stamp_ns, len(data), name, media_type)
        )

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record."""
        record = _packed(Metadata(name, dict(values)))
        start = self._written
        self._append(record)
        self._metadata_indexes.append(MetadataIndex(start, len(record), name))

    def finish(self) -> None:
        """Write what waits, the summary and the closing bytes; the file stays open."""
        self.flush()
        end = _packed(DataEnd(self._crc))
        start = self._written + len(end)
        summary, offsets_start = self._summary(start)
        # the footer's own bytes up to the checksum belong to what is summed
        footer = _packed(Footer(start, offsets_start, 0))[:-4]
        checksum = struct.pack("<I", zlib.crc32(footer, zlib.crc32(summary)))
        self._append(end, summary, footer, checksum, MAGIC)

    def _summary(self, start: int) -> tuple[bytes, int]:
        """Return the summary section, and where in the file its offsets will be."""
        used = {schema for number, (schema, _) in self._channels.items() if number in self._counts}
        groups: list[tuple[Opcode, list[bytes]]] = [
            (Opcode.SCHEMA, [self._schemas[number] for number in sorted(used - {0})]),
            (Opcode.CHANNEL, [self._channels[number][1] for number in sorted(self._counts)]),
            (Opcode.STATISTICS, [_packed(self._statistics(len(used - {0})))]),
            (Opcode.CHUNK_INDEX, [bytes(self._chunk_indexes)]),
            (Opcode.ATTACHMENT_INDEX, [_packed(item) for item in self._attachment_indexes]),
            (Opcode.METADATA_INDEX, [_packed(item) for item in self._metadata_indexes]),
        ]
        section, offsets = b"", b""
        for opcode, records in groups:
            group = b"".join(records)
            if group:
                offsets += _packed(SummaryOffset(opcode, start + len(section), len(group)))
                section += group
        return section + offsets, start + len(section)

    def _statistics(self, schemas: int) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._counts),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=min(self._times, default=0),
            message_end_time=max(self._times, default=0),
            schema_count=schemas,
        )

    def _append(self, *parts: bytes) -> None:
        """Write whole records; on an error the file may end inside one, past intact_bytes."""
        for part in parts:
            view = memoryview(part)
            while view:  # a disk that is almost full takes a part
                view = view[self._file.write(view) :]
        for part in parts:
            self._crc = zlib.crc32(part, self._crc)
            self._written += len(part)


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return _taken(builder)


def _taken(builder: RecordBuilder) -> bytes:
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # the library's own gap
