"""ROS 2 topics over Zenoh, as ``rmw_zenoh_cpp`` puts them there, without ROS.

A publisher announces itself with a liveliness token, ``/`` within its parts written as ``%``::

    @ros2_lv/DOMAIN/SESSION/NODE/ID/MP/ENCLAVE/NAMESPACE/NODE_NAME/TOPIC/TYPE/TYPE_HASH/QOS

and puts CDR bytes on ``DOMAIN/TOPIC/TYPE/TYPE_HASH``, with an attachment of its sequence number and
the time, little-endian 64-bit integers, and its 16-byte identifier behind a length. Policies of the
QoS that are rmw_zenoh's defaults are left empty.

Source: rmw_zenoh's design document; its ``liveliness_utils`` and ``attachment_helpers``.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import Message
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.bus import SETTLED_S, HeardTopic
from tooltip_cli.sources.dds import dds_type_name, ros_type_name
from tooltip_cli.sources.live import ArrivalClock, Deliver, Receiver
from tooltip_cli.sources.streams import missing_extra, one_line

FEATURE, EXTRA = "record zenoh", "zenoh"
ROUTER = "tcp/localhost:7447"
"""Where rmw_zenoh's router listens, seen from the robot itself."""

_CONNECT_MS = 5000
_LEAVE_S = 2.0  # for a thread of Zenoh's to end
_TOKEN_PARTS = 13
_RELIABLE, _TRANSIENT_LOCAL = ("", "1"), "1"  # in a token; reliable is rmw_zenoh's default
_KEPT = 1000  # messages of a latched topic, at most as many as its publishers keep
_CDR = (b"\x00\x00", b"\x00\x01")  # plain CDR, big-endian and little-endian
_ATTACHMENT = struct.Struct("<qqB16s")


def _zenoh() -> Any:
    """Return zenoh.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import zenoh
        import zenoh.ext
    except ImportError as error:
        raise missing_extra(FEATURE, EXTRA, error) from error
    return zenoh


@contextlib.contextmanager
def _heard_by(take: Callable[[Any], None], declare: Callable[[Any], Any]) -> Iterator[None]:
    """Let ``take`` have every sample, in a thread of Zenoh's; that has ended when this is left.

    Zenoh, which tells when it leaves from 1.9 on, does not wait for it. It is a daemon where a
    daemon declared the subscriber, and if it is still on its way out when the interpreter ends,
    the process aborts.

    Args:
        take: called with samples.
        declare: returns the subscriber of a handler.
    """
    gone, threads = threading.Event(), list[threading.Thread]()

    def leave() -> None:
        threads.append(threading.current_thread())
        gone.set()

    subscriber = declare(_zenoh().handlers.Callback(take, leave))
    try:
        yield
    finally:
        subscriber.undeclare()
        if gone.wait(_LEAVE_S):
            threads[0].join(_LEAVE_S)


def topic_of_token(token: str) -> HeardTopic | None:
    """Return the topic that a liveliness token says is published; None for any other token."""
    parts = token.split("/")
    if len(parts) != _TOKEN_PARTS or parts[5] != "MP":
        return None
    name, datatype = parts[9].replace("%", "/"), ros_type_name(parts[10].replace("%", "/"))
    reliability, _, others = parts[12].partition(":")
    if datatype is None:
        return None
    latched = others.partition(":")[0] == _TRANSIENT_LOCAL
    return HeardTopic(name, datatype, latched=latched, reliable=reliability in _RELIABLE)


def key_of_topic(domain: int, topic: HeardTopic) -> str:
    """Return the key expression of a topic, for whatever hash its type has."""
    return f"{domain}/{topic.name.strip('/')}/{dds_type_name(topic.datatype)}/*"


class ZenohBus:
    """The topics of a ROS 2 domain, seen through a Zenoh router.

    Args:
        domain: ``ROS_DOMAIN_ID`` of the robot.
        router: endpoint to connect to; None: :data:`ROUTER`, or what ``config`` says.
        config: a session's configuration file as rmw_zenoh takes it, in place of all defaults.

    Raises:
        MissingExtraError: eclipse-zenoh is not installed.
        TooltipError: no router is there, or the configuration is none.
    """

    def __init__(self, domain: int, router: str | None = None, config: Path | None = None) -> None:
        zenoh = _zenoh()
        self._domain = domain
        self._place = router or (str(config) if config is not None else ROUTER)
        try:
            self._session = zenoh.open(_configuration(zenoh, router, config))
        except zenoh.ZError as error:
            raise TooltipError(
                f"Zenoh cannot be joined at {self._place} ({_reason(error)}); is the robot's "
                "router running (ros2 run rmw_zenoh_cpp rmw_zenohd)? name it with --router "
                "tcp/ROBOT:7447"
            ) from error

    @property
    def where(self) -> str:
        """The domain and the router."""
        return f"Zenoh domain {self._domain} at {self._place}"

    def heard(self, wait_s: float) -> list[HeardTopic]:
        """Return what is published in the domain."""
        alive: dict[str, HeardTopic] = {}
        changed = threading.Event()
        dropped = _zenoh().SampleKind.DELETE

        def note(sample: Any) -> None:
            token = str(sample.key_expr)
            topic = topic_of_token(token)
            if sample.kind == dropped:
                alive.pop(token, None)
            elif topic is not None:
                alive[token] = topic
                changed.set()

        def declare(handler: Any) -> Any:
            return self._session.liveliness().declare_subscriber(
                f"@ros2_lv/{self._domain}/**", handler, history=True
            )

        with _heard_by(note, declare):
            end = time.monotonic() + wait_s
            while changed.wait(max(end - time.monotonic(), 0)) and time.monotonic() < end:
                changed.clear()
                if not changed.wait(SETTLED_S):
                    break
        found: dict[tuple[str, str], HeardTopic] = {}
        for topic in list(alive.values()):
            before = found.get((topic.name, topic.datatype), topic)
            found[topic.name, topic.datatype] = replace(
                topic,
                latched=topic.latched or before.latched,
                reliable=topic.reliable and before.reliable,
            )
        return sorted(found.values(), key=lambda topic: (topic.name, topic.datatype))

    def receiver(self, topic: HeardTopic, clock: ArrivalClock, report: SourceReport) -> Receiver:
        """Return what takes a topic's samples as bytes."""
        return _TopicReceiver(
            self._session, key_of_topic(self._domain, topic), topic, clock, report
        )

    def robot_description(self) -> str | None:
        """Return None: the robot's description is a topic."""
        return None

    def metadata(self) -> Mapping[str, str]:
        """Return the domain and where its times come from."""
        return {
            "publish_time": "rmw_zenoh's source timestamp, of the publisher's machine",
            "ros_domain_id": str(self._domain),
        }


def _configuration(zenoh: Any, router: str | None, config: Path | None) -> Any:
    """Return a client's configuration: everything passes through the router, nobody connects here.

    Raises:
        ZError: it cannot be read.
    """
    if config is not None:
        settings = zenoh.Config.from_file(os.fspath(config))
        if router is not None:
            settings.insert_json5("connect/endpoints", json.dumps([router]))
        return settings
    settings = zenoh.Config()
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("connect/endpoints", json.dumps([router or ROUTER]))
    settings.insert_json5("connect/timeout_ms", str(_CONNECT_MS))
    settings.insert_json5("scouting/multicast/enabled", "false")
    # a subscriber keeps what it has mapped of a publisher when that has gone: 2 MB of its own, and
    # shared ones, for each start of a robot (eclipse-zenoh 1.10)
    settings.insert_json5("transport/shared_memory/enabled", "false")
    return settings


def _reason(error: BaseException) -> str:
    """Return what a ZError says, without the places in zenoh's own source that it names."""
    return one_line(error).partition(" at /")[0]


class _TopicReceiver:
    """Takes the samples of one topic as bytes, in a thread of the session."""

    def __init__(
        self, session: Any, key: str, topic: HeardTopic, clock: ArrivalClock, report: SourceReport
    ) -> None:
        self.name = f"topic {topic.name}"
        self._session, self._key, self._topic = session, key, topic
        self._clock, self._report = clock, report
        self._numbers: dict[bytes, int] = {}  # the last one of each publisher

    def run(self, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver samples; publishers and the router may come and go."""
        zenoh = _zenoh()

        def take(sample: Any) -> None:
            message = self._message(sample)
            if message is not None:
                deliver(message)

        def declare(handler: Any) -> Any:
            if not self._topic.latched:
                return self._session.declare_subscriber(self._key, handler)
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=_KEPT)
            return zenoh.ext.declare_advanced_subscriber(
                self._session, self._key, handler, history=history
            )

        try:
            with _heard_by(take, declare):
                halt.wait()
        except zenoh.ZError as error:
            raise TooltipError(
                f"{self._topic.name} cannot be subscribed to ({_reason(error)})"
            ) from error

    def _message(self, sample: Any) -> Message | None:
        arrival_ns = self._clock.now_ns()
        payload = sample.payload.to_bytes()
        if payload[:2] not in _CDR:
            self._report.drop(f"messages on {self._topic.name} that are not plain CDR")
            return None
        published_ns = arrival_ns
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
        if len(attachment) == _ATTACHMENT.size:  # rmw_zenoh before 0.2.4 wrote another form
            number, published_ns, _, publisher = _ATTACHMENT.unpack(attachment)
            self._look_for_gap(publisher, number)
        return Message(
            self._topic.name,
            self._topic.datatype,
            arrival_ns,
            payload,
            published_ns if published_ns > 0 else arrival_ns,
        )

    def _look_for_gap(self, publisher: bytes, number: int) -> None:
        """Count what a publisher numbered and the network did not bring."""
        missing = number - self._numbers.get(publisher, number - 1) - 1
        self._numbers[publisher] = number
        if missing > 0:
            self._report.drop(
                f"messages on {self._topic.name} that were lost on the way here", missing
            )
