"""Joint states in bulk: a robot's messages differ in stamps and numbers alone."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from tooltip_cli.log.messages import JOINT_STATE, decode_foreign, header_stamp_ns, ns_from_time

_ENCAPSULATION = 4  # bytes, in front of what alignment counts from
_STAMP = slice(4, 12)


@dataclass(frozen=True)
class JointSample:
    """What one message says."""

    stamp_ns: int
    names: Sequence[str]
    positions: Sequence[float]  # of the first names; may be fewer


@dataclass(frozen=True)
class _Layout:
    """Where the numbers of a message are, and what such messages have in common."""

    length: int
    fixed: tuple[tuple[slice, bytes], ...]
    names: Sequence[str]
    positions: struct.Struct
    at: int

    def fits(self, payload: bytes) -> bool:
        return len(payload) == self.length and all(payload[at] == what for at, what in self.fixed)


def joint_samples(payloads: Iterable[bytes], source: str) -> Iterator[JointSample]:
    """Decode ``sensor_msgs/JointState``, a message like the one before by its layout.

    Raises:
        TooltipError: a message is none of that type; ``source`` says where it stands.
    """
    layout: _Layout | None = None
    for payload in payloads:
        if layout is not None and layout.fits(payload):
            stamp_ns = header_stamp_ns(payload) or 0
            positions = layout.positions.unpack_from(payload, layout.at)
            yield JointSample(stamp_ns, layout.names, positions)
            continue
        message = decode_foreign(JOINT_STATE, payload, source)
        names = [str(name) for name in message.name]
        sample = JointSample(
            ns_from_time(message.header.stamp), names, [float(x) for x in message.position]
        )
        layout = _layout(payload, message, sample)
        yield sample


def _layout(payload: bytes, message: Any, sample: JointSample) -> _Layout | None:
    """Return the layout of a decoded message; None where it is not that of classic CDR."""
    if not sample.positions:
        return None
    at = _after(_STAMP.stop, message.header.frame_id) + 4  # and how many names there are
    for name in sample.names:
        at = _after(at, name)
    numbers = struct.Struct(f"{'<' if payload[1] & 1 else '>'}{len(sample.positions)}d")
    first = _aligned(_aligned(at, 4) + 4, 8)
    at = first + numbers.size
    fixed = [slice(0, _STAMP.start), slice(_STAMP.stop, first)]
    for values in (message.velocity, message.effort):
        fixed.append(slice(at, at + 4))  # how many there are
        at = _aligned(at + 4, 8) + 8 * len(values) if len(values) else at + 4
    if at != len(payload) or numbers.pack(*sample.positions) != payload[first:][: numbers.size]:
        return None
    parts = tuple((part, bytes(payload[part])) for part in fixed)
    return _Layout(len(payload), parts, sample.names, numbers, first)


def _after(at: int, text: str) -> int:
    """Return where the next number of four bytes is after a string that begins here or soon."""
    return _aligned(_aligned(at, 4) + 4 + len(text.encode()) + 1, 4)


def _aligned(at: int, size: int) -> int:
    return at + (_ENCAPSULATION - at) % size
