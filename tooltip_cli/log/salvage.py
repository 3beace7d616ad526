"""Recovering a recording from a truncated or damaged MCAP file.

What carries a checksum is taken when the checksum holds. What carries none (messages outside
chunks, chunks whose writer made no CRC, the last chunk of a file that ends inside it) is taken from
a file that merely ends, and left out of one that is damaged, unless asked for: nobody could tell
whether the damage is in it.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from tooltip_cli import __version__
from tooltip_cli.errors import DamagedLogError, TooltipError
from tooltip_cli.log.container import (
    LoggedAttachment,
    LoggedMessage,
    chunk_messages,
    iterate,
    lone_message,
)
from tooltip_cli.log.copier import Copier
from tooltip_cli.log.mcapfile import McapFile
from tooltip_cli.log.records import (
    FRAME,
    Definitions,
    RecordError,
    chunk_beginning,
    chunk_head,
    parsed,
    unpack,
)
from tooltip_cli.log.survey import Gap, Part, Survey, survey
from tooltip_cli.log.whole import check_absent, disk_errors, whole_file

_NEVER_WRITTEN = re.compile(rb"\0{512}")  # what a power cut leaves; packed data have no such run


@dataclass
class Loss:
    """Something of the file that could not be read."""

    offset: int  # in the broken file
    length: int
    reason: str
    after_ns: int | None = None  # log time of the last message before it
    before_ns: int | None = None  # and of the first one behind it; None: nothing follows
    messages: Mapping[str, int] | None = None  # lost, by topic, where the file says so


@dataclass
class TopicCount:
    """What became of a topic's messages."""

    datatype: str
    recovered: int = 0
    lost: int | None = None  # None: the file does not say
    left_out: int = 0  # without a checksum, in a damaged file
    first_ns: int | None = None  # log times
    last_ns: int | None = None


@dataclass(frozen=True)
class Salvaged:
    """What was recovered, and what was lost."""

    state: str  # "whole", "truncated" or "damaged"
    topics: Mapping[str, TopicCount]
    losses: tuple[Loss, ...]
    attachments: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def messages(self) -> int:
        """How many were recovered."""
        return sum(count.recovered for count in self.topics.values())


def salvage(
    broken: Path, out: Path, *, overwrite: bool = False, unverified: bool = False
) -> Salvaged:
    """Write all that can be recovered of a file to another, and verify that by reading it.

    Args:
        unverified: take what carries no checksum, too, from a file that is damaged.

    Raises:
        TooltipError: nothing can be recovered, or ``out`` exists or cannot be written.
    """
    check_absent(out, overwrite=overwrite)
    found = survey(broken)
    with disk_errors(out):
        if out.exists() and out.samefile(broken):
            raise TooltipError(f"{out} is the broken file itself; give another name")
    tally = _Tally(found)
    with whole_file(out) as file:
        with disk_errors(out):
            target = _Target(McapFile(file, profile=found.profile, library=_library(found)))
            for item in recovered(found, unverified=unverified, tally=tally):
                target.take(item)
            target.mcap.finish()
        result = tally.result()
        if not result.messages:
            raise TooltipError(
                f"{broken} holds no message that can be recovered ({_reasons(result)})"
            )
        _verify(Path(file.name), target)
    return result


def recovered(
    found: Survey, *, unverified: bool = False, tally: _Tally | None = None
) -> Iterator[LoggedMessage | Attachment | Metadata]:
    """Yield what is left of a file, in its order.

    Memory: one chunk at a time.

    Raises:
        TooltipError: the file can no longer be read.
    """
    tally = tally or _Tally(found)
    definitions = found.definitions.copy()
    with found.path.open("rb") as file:
        for part in found.parts:
            if isinstance(part, Gap):
                tally.gap(part, definitions)
                continue
            taken = 0
            trusted = part.verified or unverified or not found.damaged
            file.seek(part.offset + FRAME.size)
            data = file.read(part.length)
            try:
                if part.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                    for message in _messages(part, data, definitions, trusted):
                        if trusted:
                            tally.message(message)
                            taken += 1
                            yield message
                        else:
                            tally.left_out(message)
                elif part.opcode == Opcode.ATTACHMENT and trusted:
                    yield tally.attachment(parsed(Attachment, data))
                elif part.opcode == Opcode.METADATA and trusted:
                    yield parsed(Metadata, data)
                elif trusted:
                    definitions.take(part.opcode, data)
            except RecordError as error:
                if not part.partial:
                    tally.gap(Gap(part.offset, part.length, str(error)), definitions)
            if part.partial:
                reason = "the file ends inside a chunk"
                if taken:
                    reason += f", of which {taken} whole messages were recovered"
                tally.gap(Gap(part.offset, part.length, reason), definitions)


def readable(found: Survey) -> Iterator[LoggedMessage | LoggedAttachment]:
    """Yield what is left of a file as :func:`iterate` does of one that is whole."""
    for item in recovered(found):
        if isinstance(item, Attachment):
            yield LoggedAttachment(item.name, item.media_type, item.data)
        elif isinstance(item, LoggedMessage):
            yield item


def _messages(
    part: Part, data: bytes, definitions: Definitions, trusted: bool
) -> Iterator[LoggedMessage]:
    if not trusted:
        definitions = definitions.copy()  # what it defines is trusted as little
    if part.opcode == Opcode.MESSAGE:
        yield lone_message(data, part.offset, definitions)
        return
    body = memoryview(data)
    if part.partial:
        never = _NEVER_WRITTEN.search(data)
        records = chunk_beginning(body[: never.start()] if never else body)
    else:
        records = unpack(chunk_head(body))
    yield from chunk_messages(records, part.offset, definitions)


class _Target:
    """The recovered file."""

    def __init__(self, mcap: McapFile) -> None:
        self.mcap = mcap
        self.digests: dict[str, int] = {}  # CRC of all payloads, by topic
        self._copier = Copier(mcap, plain_qos=False)

    def take(self, item: LoggedMessage | Attachment | Metadata) -> None:
        if isinstance(item, Attachment):
            self.mcap.add_attachment(item.name, item.media_type, item.data, item.log_time)
        elif isinstance(item, Metadata):
            self.mcap.add_metadata(item.name, item.metadata)
        else:
            digest = self.digests.get(item.topic, 0)
            self.digests[item.topic] = zlib.crc32(item.payload, digest)
            self._copier.copy(item)


@dataclass
class _Tally:
    """Counts what is recovered and lost on the way."""

    found: Survey
    topics: dict[str, TopicCount] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)
    attachments: list[str] = field(default_factory=list)
    last_ns: int | None = None

    def message(self, message: LoggedMessage) -> None:
        count = self._topic(message)
        time_ns = message.log_time_ns
        count.recovered += 1
        count.first_ns = time_ns if count.first_ns is None else min(count.first_ns, time_ns)
        count.last_ns = time_ns if count.last_ns is None else max(count.last_ns, time_ns)
        self.last_ns = time_ns if self.last_ns is None else max(self.last_ns, time_ns)
        for loss in reversed(self.losses):
            if loss.before_ns is not None:
                break
            loss.before_ns = time_ns

    def left_out(self, message: LoggedMessage) -> None:
        self._topic(message).left_out += 1

    def attachment(self, attachment: Attachment) -> Attachment:
        self.attachments.append(attachment.name)
        return attachment

    def gap(self, gap: Gap, definitions: Definitions) -> None:
        lost: dict[str, int] | None = None
        if gap.lost is not None:
            lost = {}
            for number, count in gap.lost.items():
                try:
                    topic = definitions.channel(number).topic
                except RecordError:
                    topic = f"channel {number}"
                lost[topic] = lost.get(topic, 0) + count
        self.losses.append(Loss(gap.offset, gap.length, gap.reason, self.last_ns, None, lost))

    def result(self) -> Salvaged:
        expected = self._expected()
        for topic, count in self.topics.items():
            if expected is not None:
                count.lost = max(expected.get(topic, 0) - count.recovered - count.left_out, 0)
            elif not self.found.truncated and all(loss.messages for loss in self.losses):
                count.lost = sum((loss.messages or {}).get(topic, 0) for loss in self.losses)
        state = "damaged" if self.found.damaged else "truncated"
        return Salvaged(
            "whole" if self.found.whole else state,
            self.topics,
            tuple(self.losses),
            tuple(self.attachments),
            tuple(self.found.notes),
        )

    def _topic(self, message: LoggedMessage) -> TopicCount:
        return self.topics.setdefault(message.topic, TopicCount(message.datatype))

    def _expected(self) -> dict[str, int] | None:
        """Return how many messages of each topic the writer counted."""
        statistics = self.found.statistics
        if statistics is None:
            return None
        counts: dict[str, int] = {}
        for number, count in statistics.channel_message_counts.items():
            try:
                channel = self.found.definitions.channel(number)
            except RecordError:
                return None
            counts[channel.topic] = counts.get(channel.topic, 0) + count
            datatype = channel.schema.name if channel.schema is not None else ""
            self.topics.setdefault(channel.topic, TopicCount(datatype))
        return counts


def _library(found: Survey) -> str:
    written = f" of a file by {found.library}" if found.library else ""
    return f"tooltip-cli/{__version__} salvage{written}"


def _reasons(result: Salvaged) -> str:
    reasons = [loss.reason for loss in result.losses[:3]] + list(result.notes[:3])
    left_out = sum(count.left_out for count in result.topics.values())
    if left_out:
        reasons.append(f"{left_out} messages carry no checksum; --unverified takes them")
    return "; ".join(reasons) or "it holds no messages"


def _verify(path: Path, target: _Target) -> None:
    """Read the recovered file back with all checks, and compare.

    Raises:
        TooltipError: it is not what was written.
    """
    digests: dict[str, int] = {}
    try:
        for item in iterate(path):
            if not isinstance(item, LoggedAttachment):
                digests[item.topic] = zlib.crc32(item.payload, digests.get(item.topic, 0))
    except DamagedLogError as error:
        raise TooltipError(f"what was recovered did not reach the disk intact: {error}") from error
    if digests != target.digests:
        raise TooltipError(f"{path} does not read back as it was written; try another disk")
