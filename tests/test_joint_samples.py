"""Joint states in bulk against one message at a time."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import joints, messages
from tooltip_cli.log.joints import joint_samples
from tooltip_cli.log.messages import JOINT_STATE, decode, encode

NUMBERS = st.floats(width=64)
NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)


@st.composite
def states(draw: st.DrawFn) -> list[bytes]:
    """Return messages of one robot, with others in between."""
    payloads = []
    for _ in range(draw(st.integers(1, 3))):
        frame, names = draw(NAMES), draw(st.lists(NAMES, max_size=4))
        count = len(names) if draw(st.booleans()) else draw(st.integers(0, 5))
        speeds, efforts = (draw(st.sampled_from([0, count])) for _ in range(2))
        for _ in range(draw(st.integers(1, 4))):
            fields = {
                "header": messages.header(draw(st.integers(0, 2**60)), frame),
                "name": names,
                "position": draw(st.lists(NUMBERS, min_size=count, max_size=count)),
                "velocity": [0.5] * speeds,
                "effort": [1.5] * efforts,
            }
            payloads.append(encode(JOINT_STATE, fields))
    return payloads


@settings(max_examples=200, deadline=None)
@given(payloads=states())
def test_they_are_what_decoding_each_gives(payloads: list[bytes]) -> None:
    found = list(joint_samples(payloads, "x"))
    for payload, sample in zip(payloads, found, strict=True):
        message = decode(JOINT_STATE, payload)
        assert sample.stamp_ns == messages.ns_from_time(message.header.stamp)
        assert list(sample.names) == list(message.name)
        assert np.array_equal(np.array(sample.positions), np.array(message.position), True)


def arm(position: float = 0.25, **changes: Any) -> bytes:
    fields: dict[str, Any] = {
        "header": messages.header(1_700_000_000_123_456_789, "base"),
        "name": ["shoulder", "wrist"],
        "position": [position, -1.0],
        "velocity": [0.0, 0.0],
        "effort": [],
    }
    return encode(JOINT_STATE, {**fields, **changes})


def test_a_message_like_the_one_before_is_not_decoded_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    decoded: list[bytes] = []

    def counted(datatype: str, payload: bytes, source: str) -> Any:
        decoded.append(payload)
        return decode(datatype, payload)

    monkeypatch.setattr(joints, "decode_foreign", counted)
    payloads = [arm(x / 8) for x in range(20)]
    assert [sample.positions[0] for sample in joint_samples(payloads, "x")] == [
        x / 8 for x in range(20)
    ]
    assert len(decoded) == 1
    other = arm(name=["shoulder", "elbow"])  # as long as "wrist"
    assert [list(s.names)[1] for s in joint_samples([*payloads, other], "x")][-1] == "elbow"


@pytest.mark.parametrize("cut", [1, 4, 8, 17, 40])
def test_what_is_no_joint_state_is_refused_among_many(cut: int) -> None:
    payloads = [arm(), arm(), arm()[:-cut]]
    with pytest.raises(TooltipError, match=r"x: a message is not a sensor_msgs/msg/JointState"):
        list(joint_samples(payloads, "x"))


def test_a_wrong_count_is_not_passed_over() -> None:
    whole = arm()
    at = len(whole) - 4 - 16 - 8  # of the velocities
    assert struct.unpack_from("<I", whole, at)[0] == 2
    broken = whole[:at] + struct.pack("<I", 9) + whole[at + 4 :]
    with pytest.raises(TooltipError, match=r"x: a message is not"):
        list(joint_samples([whole, broken], "x"))
