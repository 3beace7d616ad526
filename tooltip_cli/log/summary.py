"""The summary section at a log's end, read only where its CRC holds.

Source: MCAP specification, section "Summary Section".
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, Footer, Statistics

from tooltip_cli.log.mcapfile import MAGIC
from tooltip_cli.log.records import (
    CRC,
    FRAME,
    MAX_RECORD_BYTES,
    Definitions,
    RecordError,
    parsed,
)

_FOOTER_BYTES = FRAME.size + 20


@dataclass
class Summary:
    """What the writer of a file knew when it closed it."""

    definitions: Definitions = field(default_factory=Definitions)
    places: list[int] = field(default_factory=list)  # of chunks and attachments, ascending
    statistics: Statistics | None = None


def is_closed(file: BinaryIO, size: int) -> bool:
    """Whether footer and closing bytes are where they belong."""
    tail = _read(file, max(size - _FOOTER_BYTES - len(MAGIC), 0), _FOOTER_BYTES + len(MAGIC))
    return tail[_FOOTER_BYTES:] == MAGIC and FRAME.unpack_from(tail) == (Opcode.FOOTER, 20)


def read_summary(file: BinaryIO, size: int) -> Summary | None:
    """Return the summary; None where there is none, or nothing says that it is intact.

    Raises:
        RecordError: it is damaged.
    """
    if not is_closed(file, size):
        return None
    end = size - len(MAGIC) - _FOOTER_BYTES
    record = _read(file, end, _FOOTER_BYTES)
    footer = parsed(Footer, record[FRAME.size :])
    length = end - footer.summary_start
    if not footer.summary_start or not footer.summary_crc:
        return None
    if not 0 <= length <= MAX_RECORD_BYTES:
        raise RecordError("the footer names a place outside the file")
    section = _read(file, footer.summary_start, length)
    if zlib.crc32(record[: -CRC.size], zlib.crc32(section)) != footer.summary_crc:
        raise RecordError("the summary fails its CRC")
    found = Summary()
    position = 0
    while position + FRAME.size <= length:
        opcode, content = FRAME.unpack_from(section, position)
        position += FRAME.size
        _take(found, opcode, section[position : position + content])
        position += content
    found.places.sort()
    return found


def _take(found: Summary, opcode: int, data: bytes) -> None:
    if opcode == Opcode.CHUNK_INDEX:
        found.places.append(parsed(ChunkIndex, data).chunk_start_offset)
    elif opcode == Opcode.ATTACHMENT_INDEX:
        found.places.append(parsed(AttachmentIndex, data).offset)
    elif opcode == Opcode.STATISTICS:
        found.statistics = parsed(Statistics, data)
    else:
        found.definitions.take(opcode, data)


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)
