"""What the networks have in common that robots publish ROS messages on."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import IMAGE_TYPES
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.live import ArrivalClock, Receiver

DISCOVERY_S = 3.0
SETTLED_S = 1.0
"""Without a new topic for so long, everything has been heard of."""

RECORDED_TYPES = (
    *IMAGE_TYPES,
    messages.CAMERA_INFO,
    messages.JOINT_STATE,
    messages.POSE_STAMPED,
    messages.STRING,
)


@dataclass(frozen=True)
class HeardTopic:
    """A topic that somebody publishes."""

    name: str  # as ROS names it
    datatype: str  # as ROS 2 names it
    latched: bool = False  # every publisher keeps its last messages for late subscribers
    reliable: bool = False


class Bus(Protocol):
    """A network, joined, on which topics are published."""

    @property
    def where(self) -> str:
        """What to call it in messages, such as ``DDS domain 7``."""

    def heard(self, wait_s: float) -> list[HeardTopic]:
        """Return what is published, by name; ends early once nothing new turns up.

        Raises:
            TooltipError: the network is not there any more.
        """

    def receiver(self, topic: HeardTopic, clock: ArrivalClock, report: SourceReport) -> Receiver:
        """Return what receives a topic; its publishers may come and go."""

    def robot_description(self) -> str | None:
        """Return a URDF that is known without a topic, else None."""

    def metadata(self) -> Mapping[str, str]:
        """Return what tells this network from others, and whose its times are."""


def topic_rates(bus: Bus, listen_s: float) -> list[tuple[HeardTopic, float | None]]:
    """Return what is published, with messages a second where a recording can hold the type.

    Raises:
        TooltipError: the network is not there any more.
    """
    heard, halt = bus.heard(DISCOVERY_S), threading.Event()
    clock, report = ArrivalClock(), SourceReport()
    arrivals: dict[str, list[float]] = {}

    def count(message: Message) -> None:
        arrivals.setdefault(message.topic, []).append(time.monotonic())

    known = [topic for topic in heard if topic.datatype in RECORDED_TYPES]
    threads = [
        threading.Thread(target=bus.receiver(topic, clock, report).run, args=(count, halt))
        for topic in known
    ]
    for thread in threads:
        thread.start()
    halt.wait(listen_s)
    halt.set()
    for thread in threads:
        thread.join()
    return [
        (topic, _rate(arrivals.get(topic.name, [])) if topic in known else None) for topic in heard
    ]


def _rate(arrivals: Sequence[float]) -> float:
    spans = len(arrivals) - 1
    return spans / max(arrivals[-1] - arrivals[0], 1e-9) if spans > 0 else 0.0
