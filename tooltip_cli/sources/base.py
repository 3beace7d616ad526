"""What every source of a recording provides."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from tooltip_cli.log.messages import Message
from tooltip_cli.rig.rigfile import Rig


@dataclass
class SourceReport:
    """What a source read, left out and could not pair; filled while its messages are taken."""

    read: dict[str, int] = field(default_factory=dict)  # messages per topic written
    dropped: dict[str, int] = field(default_factory=dict)  # messages left out, by reason
    notes: list[str] = field(default_factory=list)  # sentences for a person

    def count(self, topic: str) -> None:
        """Count one message that was read."""
        self.read[topic] = self.read.get(topic, 0) + 1

    def drop(self, reason: str, count: int = 1) -> None:
        """Count messages that were left out."""
        self.dropped[reason] = self.dropped.get(reason, 0) + count


class Source(Protocol):
    """One source of a recording: yields messages as they should stand in the log."""

    @property
    def frames(self) -> int | None:
        """Number of images to come, for progress; None when unknown."""

    @property
    def image_topic(self) -> str | None:
        """The topic whose messages are counted as progress."""

    @property
    def rig(self) -> Rig | None:
        """A rig that the source itself knows, or None."""

    @property
    def report(self) -> SourceReport:
        """Filled while :meth:`messages` is consumed."""

    def messages(self) -> Iterator[Message]:
        """Yield the messages in log order.

        Raises:
            TooltipError: the input is missing, malformed or lacks a stream.
        """

    def attachments(self) -> Mapping[str, bytes]:
        """Return files to store beside the rig's; asked for after the last message."""
