"""ROS 1 messages as ROS 2 CDR, by ``rosbags``."""

from __future__ import annotations

import functools
from typing import Any

from tooltip_cli.sources.streams import missing_extra

FEATURE, EXTRA = "record ros1", "ros1"


def cdr_from_ros1(payload: bytes, datatype: str) -> bytes:
    """Return a serialised ROS 1 message as ROS 2 CDR.

    The types that a recording keeps differ between ROS 1 and 2 only in the header's ``seq``,
    which the conversion leaves out.

    Raises:
        Exception: whatever ``rosbags`` meets in bytes that are not such a message.
    """
    return bytes(typestore("ROS2_HUMBLE").ros1_to_cdr(payload, datatype))


@functools.cache
def definition_sum(datatype: str) -> str:
    """Return the MD5 sum by which ROS 1 tells one definition of a type from another.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
    """
    return str(typestore("ROS1_NOETIC").generate_msgdef(datatype)[1])


def ros2_name(datatype: str) -> str:
    """Return ``pkg/msg/Name`` for it or for the ROS 1 form ``pkg/Name``."""
    parts = datatype.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else datatype


@functools.cache
def typestore(name: str) -> Any:
    """Return one of rosbags' sets of definitions.

    Raises:
        MissingExtraError: ``rosbags`` is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing_extra(FEATURE, EXTRA, error) from error
    return get_typestore(Stores[name])
