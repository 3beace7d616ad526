"""The MCAP container read record by record, every checksum verified.

The library's readers verify no checksum unless told to and report a truncated file as a record of
impossible length. Here each record's declared length is compared with what is left of the file, and
with what a record may sensibly be, before anything is read; what is wrong is said as what it is.

Source: MCAP specification, sections "File Structure" and "Records".
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from tooltip_cli.errors import DamagedLogError, TooltipError
from tooltip_cli.log.mcapfile import MAGIC
from tooltip_cli.log.records import (
    CRC,
    FRAME,
    MAX_RECORD_BYTES,
    MESSAGE,
    Definitions,
    LoggedChannel,
    RecordError,
    chunk_head,
    inner_records,
    read_attachment,
    unpack,
)

_FOOTER = struct.Struct("<QQI")  # where summary and its offsets start, CRC
_BLOCK_BYTES = 1 << 20
_LOG = logging.getLogger(__name__)


@dataclass(slots=True)  # not frozen: that makes each of a million four times as slow to build
class LoggedMessage:
    """One message of a log, in file order."""

    channel: LoggedChannel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes
    chunk_offset: int  # where its chunk starts in the file; -1 when it stands alone
    offset: int  # of the payload, in the decompressed chunk or in the file

    @property
    def topic(self) -> str:
        """The channel's topic."""
        return self.channel.topic

    @property
    def datatype(self) -> str:
        """The schema's name; empty where there is none."""
        return self.channel.schema.name if self.channel.schema is not None else ""

    @property
    def encoding(self) -> str:
        """The message encoding, "cdr" for ROS 2."""
        return self.channel.encoding


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
    frame = file.read(FRAME.size)
    opcode, length = FRAME.unpack(frame) if len(frame) == FRAME.size else (0, 0)
    if opcode != Opcode.CHUNK or length > MAX_RECORD_BYTES:
        raise _damaged(path, offset, "a chunk is not where it was")
    try:
        return unpack(chunk_head(memoryview(file.read(length))))
    except RecordError as error:
        raise _damaged(path, offset, str(error)) from error


def iterate(path: Path) -> Iterator[LoggedMessage | LoggedAttachment]:
    """Yield messages and attachments in file order.

    Memory: one chunk at a time. Attachments too large for any use here are passed over.

    Raises:
        TooltipError: the file is missing, empty, unreadable, or not MCAP.
        DamagedLogError: it is truncated or a checksum fails; what was yielded before is intact.
    """
    with open_log(path) as file:
        definitions = Definitions()
        for opcode, offset, data in _records(file, path):
            try:
                if opcode == Opcode.CHUNK:
                    records = unpack(chunk_head(memoryview(data)))
                    yield from chunk_messages(records, offset, definitions)
                elif opcode == Opcode.ATTACHMENT:
                    attachment = read_attachment(data)
                    yield LoggedAttachment(attachment.name, attachment.media_type, attachment.data)
                elif opcode == Opcode.MESSAGE:
                    yield lone_message(data, offset, definitions)
                else:
                    definitions.take(opcode, data)
            except RecordError as error:
                raise _damaged(path, offset, str(error)) from error


def chunk_messages(
    records: bytes, offset: int, definitions: Definitions
) -> Iterator[LoggedMessage]:
    """Yield the messages of a chunk, taking its definitions.

    Args:
        records: the chunk, unpacked.
        offset: where it starts in the file.

    Raises:
        RecordError: it holds something else than whole records; earlier messages were whole.
    """
    for opcode, start, length in inner_records(records):
        if opcode == Opcode.MESSAGE:
            yield _message(records, start, length, definitions, (offset, start))
        else:
            definitions.take(opcode, records[start : start + length])


def lone_message(data: bytes, offset: int, definitions: Definitions) -> LoggedMessage:
    """Return a message that stands outside chunks.

    Args:
        data: the content of its record, which starts at ``offset`` in the file.

    Raises:
        RecordError: it is none, or its channel is not defined.
    """
    return _message(data, 0, len(data), definitions, (-1, offset + FRAME.size))


def _message(
    data: bytes, start: int, length: int, definitions: Definitions, place: tuple[int, int]
) -> LoggedMessage:
    """Return a message; ``place``: its chunk, and where its record's content starts."""
    if length < MESSAGE.size:
        raise RecordError(f"a record cannot be read (a message of {length} bytes)")
    number, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(data, start)
    return LoggedMessage(
        definitions.channel(number),
        sequence,
        log_time_ns,
        publish_time_ns,
        data[start + MESSAGE.size : start + length],
        place[0],
        place[1] + MESSAGE.size,
    )


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
        magic = file.read(len(MAGIC))
    except OSError as error:
        raise TooltipError(f"{path}: cannot be opened ({error.strerror})") from error
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
        frame = file.read(FRAME.size)
        if len(frame) < FRAME.size:
            raise _truncated(path, offset)
        opcode, length = FRAME.unpack(frame)
        if opcode == Opcode.FOOTER:
            raise _damaged(path, offset, "the end of the data section is missing")
        if length > size - offset - FRAME.size:
            raise _truncated(path, offset)
        if length > MAX_RECORD_BYTES:
            if opcode != Opcode.ATTACHMENT:
                raise _damaged(path, offset, f"a record claims {length} bytes")
            checksum = _pass_attachment(file, path, offset, length, zlib.crc32(frame, checksum))
            offset += FRAME.size + length
            continue
        data = file.read(length)
        if opcode == Opcode.DATA_END:
            if length != CRC.size:
                raise _damaged(path, offset, "the end of the data section has the wrong length")
            (stored,) = CRC.unpack(data)
            if stored and stored != checksum:
                raise _damaged(path, offset, "the data section fails its CRC")
            break
        checksum = zlib.crc32(data, zlib.crc32(frame, checksum))
        yield opcode, offset, data
        offset += FRAME.size + length
    _check_summary(file, path, size)


def _pass_attachment(file: BinaryIO, path: Path, offset: int, length: int, checksum: int) -> int:
    """Verify an attachment without keeping it; return the checksum of the data section so far."""
    own = 0
    left = length - CRC.size
    while left:
        block = file.read(min(left, _BLOCK_BYTES))
        if not block:
            raise _truncated(path, offset)
        own, checksum = zlib.crc32(block, own), zlib.crc32(block, checksum)
        left -= len(block)
    stored = file.read(CRC.size)
    if stored not in (CRC.pack(own), CRC.pack(0)):
        raise _damaged(path, offset, "an attachment fails its CRC")
    _LOG.warning("%s: an attachment of %d bytes is not read", path, length)
    return zlib.crc32(stored, checksum)


def _check_summary(file: BinaryIO, path: Path, size: int) -> None:
    """Verify what follows the data section: the summary's CRC and the closing magic bytes."""
    start = file.tell()
    footer_size = FRAME.size + _FOOTER.size
    left = size - start - footer_size - len(MAGIC)
    if left < 0:
        raise _truncated(path, start)
    checksum = 0
    while left:
        block = file.read(min(left, _BLOCK_BYTES))
        if not block:
            raise _truncated(path, start)
        checksum = zlib.crc32(block, checksum)
        left -= len(block)
    record, magic = file.read(footer_size), file.read(len(MAGIC))
    if magic != MAGIC:
        raise _truncated(path, start)
    opcode, length = FRAME.unpack_from(record)
    if opcode != Opcode.FOOTER or length != _FOOTER.size:
        raise _damaged(path, start, "the footer is not where it belongs")
    _, _, stored = _FOOTER.unpack_from(record, FRAME.size)
    # the footer's own bytes up to the checksum belong to what is summed
    if stored and zlib.crc32(record[: -CRC.size], checksum) != stored:
        raise _damaged(path, start, "the summary fails its CRC")


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
