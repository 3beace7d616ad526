"""``offered_qos_profiles``: what ``ros2 bag play`` reads to offer a topic as its publisher did.

The value is YAML, a list with one profile for each publisher, in which every field must be there.
Policies are numbers: releases up to Iron read nothing else, later ones recognise them. Zero times
stand for "no limit". An empty value stands for rosbag2's default.

Source: rosbag2, ``rosbag2_storage/qos.cpp``; the numbers are those of ``rmw/types.h``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import yaml

_UNLIMITED = (0, 0)
_TRANSIENT_LOCAL, _VOLATILE = 1, 2
_LATCHED = ("robot_description", "tf_static", "scene")


@dataclass(frozen=True)
class Qos:
    """What a publisher offers."""

    history: int = 1  # keep last
    depth: int = 10
    reliability: int = 1  # reliable
    durability: int = _VOLATILE
    deadline: tuple[int, int] = _UNLIMITED  # seconds, nanoseconds
    lifespan: tuple[int, int] = _UNLIMITED
    liveliness: int = 1  # automatic
    liveliness_lease_duration: tuple[int, int] = _UNLIMITED
    avoid_ros_namespace_conventions: bool = False


def qos_yaml(profiles: Sequence[Qos]) -> str:
    """Return the value of ``offered_qos_profiles``."""
    return yaml.safe_dump([_document(profile) for profile in profiles], sort_keys=False)


def default_qos(topic: str) -> str:
    """Return the value for topics of our own.

    Reliable publishers satisfy every subscriber. What is said once is kept for those that come
    later, as ``robot_state_publisher`` and ``tf2`` do.
    """
    if topic.rsplit("/", 1)[-1] in _LATCHED:
        return qos_yaml([Qos(depth=1, durability=_TRANSIENT_LOCAL)])
    return qos_yaml([Qos()])


def _document(profile: Qos) -> dict[str, Any]:
    return {
        "history": profile.history,
        "depth": profile.depth,
        "reliability": profile.reliability,
        "durability": profile.durability,
        "deadline": _duration(profile.deadline),
        "lifespan": _duration(profile.lifespan),
        "liveliness": profile.liveliness,
        "liveliness_lease_duration": _duration(profile.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
    }


def _duration(time: tuple[int, int]) -> dict[str, int]:
    return {"sec": time[0], "nsec": time[1]}
