"""``offered_qos_profiles``: what ``ros2 bag play`` reads to offer a topic as its publisher did.

The value is YAML, a list with one profile for each publisher, in which every field must be there.
Policies are numbers: releases up to Iron read nothing else, later ones recognise them. Zero times
stand for "no limit". An empty value stands for rosbag2's default.

Source: rosbag2, ``rosbag2_storage/qos.cpp``; the numbers are those of ``rmw/types.h``.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import yaml

_UNLIMITED = (0, 0)
_MAX_TEXT = 100_000  # characters; one profile has 400
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
    return latched_qos() if topic.rsplit("/", 1)[-1] in _LATCHED else qos_yaml([Qos()])


def latched_qos() -> str:
    """Return the value for a publisher whose last message is kept for late subscribers."""
    return qos_yaml([Qos(depth=1, durability=_TRANSIENT_LOCAL)])


def qos_of_profiles(profiles: Sequence[Any]) -> str | None:
    """Return the value for profiles as ``rosbags`` reads them; None where there are none."""
    if not profiles:
        return None
    return qos_yaml(
        [
            Qos(
                history=profile.history.value,
                depth=profile.depth,
                reliability=profile.reliability.value,
                durability=profile.durability.value,
                deadline=tuple(profile.deadline),
                lifespan=tuple(profile.lifespan),
                liveliness=profile.liveliness.value,
                liveliness_lease_duration=tuple(profile.liveliness_lease_duration),
                avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
            )
            for profile in profiles
        ]
    )


@functools.lru_cache(maxsize=64)
def known_qos(text: str) -> str | None:
    """Return the value that a log states for a topic, policies as numbers.

    Releases from Jazzy on write the policies as words, and say so in a part of the file that is
    not taken over; without it the older ones would not read them.

    Returns:
        None where the text is empty or is no such list.
    """
    if not text.strip() or len(text) > _MAX_TEXT:
        return None
    try:
        profiles = [_profile(item) for item in yaml.safe_load(text)]
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):
        return None
    return qos_yaml(profiles) if profiles else None


def _profile(item: Any) -> Qos:
    return Qos(
        history=_policy(item["history"], ("system_default", "keep_last", "keep_all", "unknown")),
        depth=int(item["depth"]),
        reliability=_policy(item["reliability"], _words("reliable", "best_effort")),
        durability=_policy(item["durability"], _words("transient_local", "volatile")),
        deadline=_time(item["deadline"]),
        lifespan=_time(item["lifespan"]),
        liveliness=_policy(
            item["liveliness"], _words("automatic", "manual_by_node", "manual_by_topic")
        ),
        liveliness_lease_duration=_time(item["liveliness_lease_duration"]),
        avoid_ros_namespace_conventions=bool(item["avoid_ros_namespace_conventions"]),
    )


def _words(*policies: str) -> tuple[str, ...]:
    return ("system_default", *policies, "unknown", "best_available")


def _policy(value: Any, words: Sequence[str]) -> int:
    """Return the number of a policy; ``words`` in the order of their numbers."""
    number = words.index(value) if isinstance(value, str) else int(value)
    if not 0 <= number < len(words):
        raise ValueError(number)
    return number


def _time(value: Any) -> tuple[int, int]:
    return int(value["sec"]), int(value["nsec"])


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
