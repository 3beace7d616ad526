"""What is left of an MCAP file: every part that is intact, and every gap between them.

The file is walked record by record. Where a record cannot be what it claims, the next intact one is
looked for: at the places that the summary names, where there is one, else by the shape of a chunk's
head, confirmed by its CRC.

Source: MCAP specification, sections "Records" and "Summary Section".
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Header, MessageIndex, Metadata, Statistics

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.container import open_log
from tooltip_cli.log.mcapfile import MAGIC
from tooltip_cli.log.records import (
    CRC,
    FRAME,
    MAX_CHUNK_BYTES,
    MAX_RECORD_BYTES,
    Definitions,
    RecordError,
    chunk_head,
    chunk_length,
    parsed,
    read_attachment,
    unpack,
)
from tooltip_cli.log.summary import is_closed, read_summary

_CHUNK_HEAD = re.compile(
    rb"\x06.{5}\0{3}.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd).{4}\0{4}", re.DOTALL
)
_FRAME_HEAD = re.compile(rb"[\x01-\x0f].{5}\0{3}", re.DOTALL)
_HEAD_BYTES = 64  # longest match, and more
_CHAIN = 4  # records in a row that are no accident
_BLOCK_BYTES = 1 << 22
_CHUNK_OPCODE = bytes([Opcode.CHUNK])
_LAST_OPCODE = 0x0F
_IN_SUMMARY = (
    Opcode.FOOTER,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
)
_PRIVATE_OPCODES = 0x80


@dataclass(frozen=True)
class Part:
    """A record that can be read."""

    opcode: int
    offset: int  # of the record in the file
    length: int  # of its content
    verified: bool  # a checksum of its own holds
    partial: bool = False  # the file ends inside it


@dataclass(frozen=True)
class Gap:
    """Bytes of the file that cannot be read."""

    offset: int
    length: int
    reason: str
    lost: dict[int, int] | None = None  # messages by channel, where an index says so


@dataclass
class Survey:
    """The parts and gaps of a file, in order."""

    path: Path
    size: int
    parts: list[Part | Gap] = field(default_factory=list)
    truncated: bool = False  # the file just ends
    damaged: bool = False  # something in it is not what was written
    notes: list[str] = field(default_factory=list)
    profile: str = ""
    library: str = ""
    checksums: bool = True  # every chunk and every message is covered by one
    definitions: Definitions = field(default_factory=Definitions)  # of the summary
    statistics: Statistics | None = None  # what the writer counted

    @property
    def whole(self) -> bool:
        """Whether nothing is wrong with the file."""
        return not self.truncated and not self.damaged


def survey(path: Path) -> Survey:
    """Walk a file and return what is left of it.

    Memory: one chunk at a time.

    Raises:
        TooltipError: it is missing, empty or unreadable, or nothing in it looks like MCAP.
    """
    try:
        file = path.open("rb")
        with file:
            size = file.seek(0, 2)
            return _Walk(path, file, size).run()
    except OSError as error:
        raise TooltipError(f"{path}: cannot be read ({error.strerror})") from error


class _Walk:
    """One pass over a file."""

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size
        self._found = Survey(path, size)
        self._places: list[int] = []  # where the summary says that chunks and attachments start
        self._crc: int | None = zlib.crc32(MAGIC)  # of the data section; None once out of step

    def run(self) -> Survey:
        found = self._found
        if self._read(0, len(MAGIC)) != MAGIC:
            if self._next_intact(0) is None:
                open_log(found.path).close()  # says what the file is instead
            found.notes.append("the first bytes of the file are damaged")
            found.damaged, self._crc = True, None
        self._take_summary()
        position: int | None = len(MAGIC)
        while position is not None:
            position = self._step(position)
        return found

    def _take_summary(self) -> None:
        """Take definitions, places and counts from the summary, if there is one that is intact."""
        found = self._found
        try:
            summary = read_summary(self._file, self._size)
        except RecordError as error:
            found.notes.append(str(error))
            found.damaged = True
            return
        if summary is not None:
            self._places = summary.places
            found.definitions, found.statistics = summary.definitions, summary.statistics

    def _step(self, position: int) -> int | None:
        """Take the record at a position; return where the next one is, None at the end."""
        found = self._found
        frame = self._read(position, FRAME.size)
        if len(frame) < FRAME.size:
            self._end(position)
            return None
        opcode, length = _frame(frame)
        ended = position + FRAME.size + CRC.size <= self._size
        if opcode == Opcode.DATA_END and length == CRC.size and ended:
            self._check_end(position)
            return None
        if not _possible(opcode) or opcode in _IN_SUMMARY:
            return self._resume(position, f"no record starts at byte {position}")
        if opcode == Opcode.CHUNK:
            length = self._chunk_length(position, length)
        after = position + FRAME.size + length
        if after > self._size:
            return self._resume(position, f"a record claims {length} bytes")
        if length > MAX_RECORD_BYTES:
            self._crc = None
            found.notes.append(f"a record of {length} bytes is passed over")
            return after
        data = self._read(position + FRAME.size, length)
        try:
            verified = self._check(opcode, data)
        except RecordError as error:
            return self._resume(position, str(error), after)
        if not verified and not self._plausible(after):
            return self._resume(position, f"no record follows the one at byte {position}")
        found.parts.append(Part(opcode, position, length, verified))
        if self._crc is not None:
            self._crc = zlib.crc32(data, zlib.crc32(frame, self._crc))
        return after

    def _chunk_length(self, position: int, length: int) -> int:
        """Return a chunk's length; by its own fields where the frame's leads nowhere."""
        if self._plausible(position + FRAME.size + length, strictly=True):
            return length
        inner = self._inner_length(position)
        if inner is None or not self._plausible(position + FRAME.size + inner, strictly=True):
            return length
        self._found.damaged, self._crc = True, None
        self._found.notes.append(f"the chunk at byte {position} claims a wrong length")
        return inner

    def _inner_length(self, position: int) -> int | None:
        """Return a chunk's length by its own fields; None where these are none of a chunk."""
        try:
            return chunk_length(self._read(position + FRAME.size, _HEAD_BYTES))
        except RecordError:
            return None

    def _check(self, opcode: int, data: bytes) -> bool:
        """Return whether a record's own checksum holds; False: it has none.

        Raises:
            RecordError: it fails its checksum or is no such record.
        """
        found = self._found
        if opcode == Opcode.CHUNK:
            head = chunk_head(memoryview(data))
            unpack(head)
            found.checksums &= head.crc != 0
            return head.crc != 0
        if opcode == Opcode.ATTACHMENT:
            read_attachment(data)
            return CRC.unpack(data[-CRC.size :]) != (0,)
        if opcode == Opcode.HEADER:
            header = parsed(Header, data)
            found.profile, found.library = header.profile, header.library
        elif opcode == Opcode.MESSAGE:
            found.checksums = False
        elif opcode == Opcode.MESSAGE_INDEX:
            if len(data) < 6 or int.from_bytes(data[2:6], "little") != len(data) - 6:
                raise RecordError("a message index has the wrong length")
        elif opcode == Opcode.METADATA:
            parsed(Metadata, data)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            Definitions().take(opcode, data)
        elif opcode == Opcode.DATA_END:
            raise RecordError("the end of the data section has the wrong length")
        elif _is_chunk(data):
            raise RecordError(f"a chunk bears the number {opcode} of another record")
        return False

    def _resume(self, position: int, reason: str, after: int | None = None) -> int | None:
        """Note a gap and return where to go on; ``after``: where the bad record would end."""
        found = self._found
        self._crc = None
        if after is not None and self._plausible(after):
            lost = self._indexed(after)
            found.parts.append(Gap(position, after - position, reason, lost))
            found.damaged = True
            return after
        # what stands in a chunk that the file's end cuts off does not stand alone
        chunk = self._read(position, 1) == _CHUNK_OPCODE and self._inner_length(position)
        following = self._next_intact(position + 1, lone=not chunk)
        if following is None:
            self._end(position, reason)
            return None
        found.parts.append(Gap(position, following - position, reason))
        found.damaged = True
        return following

    def _check_end(self, position: int) -> None:
        """Check what the data section's end says, and that the file is closed."""
        found = self._found
        (stored,) = CRC.unpack(self._read(position + FRAME.size, CRC.size))
        if stored and self._crc is not None and stored != self._crc:
            found.notes.append("the data section fails its CRC")
            found.damaged = True
        if not is_closed(self._file, self._size):
            found.notes.append("the file does not end as it should; all data stand before that")
            found.truncated = True

    def _end(self, position: int, reason: str = "") -> None:
        """Note that nothing follows: the file was cut off here, or its end is damaged."""
        found = self._found
        rest = self._size - position
        frame = self._read(position, FRAME.size)
        opcode, length = _frame(frame) if len(frame) == FRAME.size else (0, 0)
        cut = position + FRAME.size + length > self._size or rest < FRAME.size
        if is_closed(self._file, self._size) or not (cut or self._zeros(position)):
            found.parts.append(Gap(position, rest, reason or "the end of the file is damaged"))
            found.damaged = True
            return
        found.truncated = True
        if not rest:
            return
        if opcode == Opcode.CHUNK and cut:
            found.parts.append(
                Part(opcode, position, rest - FRAME.size, verified=False, partial=True)
            )
        else:
            found.parts.append(Gap(position, rest, "the file ends inside a record"))

    def _zeros(self, position: int) -> bool:
        """Whether the file ends in zeros: a power cut leaves room that was never written."""
        return not any(self._read(max(position, self._size - 512), 512))

    def _plausible(self, position: int, *, strictly: bool = False) -> bool:
        """Whether a record can start here, even one that the file's end cuts off.

        Args:
            strictly: whether a length that no record has speaks against it.
        """
        frame = self._read(position, FRAME.size)
        if len(frame) < FRAME.size:
            return position <= self._size and (not frame or _possible(frame[0]))
        opcode, length = _frame(frame)
        if position + FRAME.size + length <= self._size:
            return _possible(opcode)
        return 0 < opcode <= _LAST_OPCODE and (length <= MAX_RECORD_BYTES or not strictly)

    def _indexed(self, position: int) -> dict[int, int] | None:
        """Count the messages that the indexes behind a damaged chunk list, by channel."""
        counts: dict[int, int] = {}
        while True:
            frame = self._read(position, FRAME.size)
            if len(frame) < FRAME.size:
                break
            opcode, length = _frame(frame)
            if opcode != Opcode.MESSAGE_INDEX or length > MAX_CHUNK_BYTES:
                break
            try:
                data = self._read(position + FRAME.size, length)
                index = parsed(MessageIndex, data)
            except RecordError:
                break
            counts[index.channel_id] = len(index.records)
            position += FRAME.size + length
        return counts or None

    def _next_intact(self, position: int, *, lone: bool = False) -> int | None:
        """Return where the next intact chunk or attachment starts; None: nowhere.

        Args:
            lone: look for messages outside chunks, too, where there are no chunks.
        """
        if self._places:
            candidates: Iterator[int] = iter([place for place in self._places if place >= position])
        else:
            candidates = self._matches(_CHUNK_HEAD, position)
        for place in candidates:
            frame = self._read(place, FRAME.size)
            if len(frame) < FRAME.size:
                continue
            opcode, length = _frame(frame)
            if opcode == Opcode.CHUNK:
                length = self._chunk_length(place, length)
            if length > MAX_RECORD_BYTES or place + FRAME.size + length > self._size:
                continue
            try:
                if self._check(opcode, self._read(place + FRAME.size, length)):
                    return place
            except RecordError:
                continue
        chunked = any(
            isinstance(part, Part) and part.opcode == Opcode.CHUNK for part in self._found.parts
        )
        if self._places or chunked or not lone:
            return None
        return next(filter(self._chain, self._matches(_FRAME_HEAD, position)), None)

    def _chain(self, position: int) -> bool:
        """Whether several records follow one another from here, or up to the file's end."""
        for _ in range(_CHAIN):
            frame = self._read(position, FRAME.size)
            if len(frame) < FRAME.size:
                return not frame
            opcode, length = _frame(frame)
            if not _possible(opcode) or length > self._size - position:
                return False
            position += FRAME.size + length
        return True

    def _matches(self, pattern: re.Pattern[bytes], position: int) -> Iterator[int]:
        """Yield where the bytes of the file match a pattern."""
        while position < self._size:
            block = self._read(position, _BLOCK_BYTES + _HEAD_BYTES)
            start = 0
            while (match := pattern.search(block, start)) is not None:
                if match.start() >= _BLOCK_BYTES:
                    break
                yield position + match.start()
                start = match.start() + 1
            position += _BLOCK_BYTES

    def _read(self, offset: int, length: int) -> bytes:
        if offset >= self._size:  # wherever a length has led
            return b""
        self._file.seek(offset)
        return self._file.read(length)


def _frame(data: bytes) -> tuple[int, int]:
    """Return opcode and length of a record."""
    opcode, length = FRAME.unpack(data)
    return opcode, length


def _possible(opcode: int) -> bool:
    return 0 < opcode <= _LAST_OPCODE or opcode >= _PRIVATE_OPCODES


def _is_chunk(data: bytes) -> bool:
    try:
        head = chunk_head(memoryview(data))
        unpack(head)
    except RecordError:
        return False
    return head.crc != 0
