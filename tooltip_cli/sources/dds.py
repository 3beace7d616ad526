"""ROS 2 topics over DDS, without ROS: who publishes what, and samples as they came.

Names and types on the wire are ROS 2's: topic ``/joint_states`` is ``rt/joint_states``, the type
``sensor_msgs/msg/JointState`` is ``sensor_msgs::msg::dds_::JointState_``.

Source: the design article "Topic and Service name mapping to DDS" of ROS 2; cyclonedds' Python API,
in which a type's ``deserialize`` is given the CDR bytes of each sample.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.bus import SETTLED_S, HeardTopic
from tooltip_cli.sources.live import ArrivalClock, Deliver, Receiver
from tooltip_cli.sources.streams import missing_extra

FEATURE, EXTRA = "record ros2", "ros2"
_POLL_S = 0.25  # longest sleep between looks at whether to stop
_DEPTH = 200  # samples that wait in the middleware: 0.4 s at 500 Hz
_TAKE = 64
_ROOM = (
    "<CycloneDDS><Domain><Internal><SocketReceiveBufferSize max='16MB'/></Internal></Domain>"
    "</CycloneDDS>"
)
_PRIMITIVES = {
    "bool": "bool",
    "byte": "uint8",
    "char": "uint8",
    **{f"{kind}{bits}": f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)},
    "float32": "float32",
    "float64": "float64",
}


class _Sample:
    """What cyclonedds returns for a sample: the bytes, and what it adds about them."""

    __slots__ = ("payload", "sample_info")

    def __init__(self, payload: bytes) -> None:
        self.payload = payload
        self.sample_info: Any = None


def _dds() -> Any:
    """Return cyclonedds.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import cyclonedds.builtin
        import cyclonedds.core
        import cyclonedds.domain
        import cyclonedds.sub
        import cyclonedds.topic
    except ImportError as error:
        raise missing_extra(FEATURE, EXTRA, error) from error
    return cyclonedds


def dds_type_name(datatype: str) -> str:
    """Return ``sensor_msgs::msg::dds_::Image_`` for ``sensor_msgs/msg/Image``."""
    package, _, name = datatype.partition("/msg/")
    return f"{package}::msg::dds_::{name}_"


def ros_type_name(type_name: str) -> str | None:
    """Return ``sensor_msgs/msg/Image`` for ``sensor_msgs::msg::dds_::Image_``, else None."""
    package, found, name = type_name.partition("::msg::dds_::")
    return f"{package}/msg/{name[:-1]}" if found and name.endswith("_") else None


def dds_type(datatype: str) -> Any:
    """Return a new class of cyclonedds for one of our message definitions."""
    from cyclonedds import idl

    package, _, name = datatype.partition("/msg/")
    fields = {}
    for line in messages.definition(datatype).splitlines():
        words = line.partition("#")[0].split()
        if len(words) > 1 and "=" not in line.partition("#")[0]:
            fields[words[1]] = _field(words[0])
    return idl.make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)


_part_type = functools.cache(dds_type)


def _field(text: str) -> Any:
    from cyclonedds.idl import types

    base, bracket, count = text.partition("[")
    if base == "string":
        kind: Any = str
    elif base in _PRIMITIVES:
        kind = bool if base == "bool" else getattr(types, _PRIMITIVES[base])
    else:
        package, _, name = base.partition("/")
        kind = _part_type(f"{package}/msg/{name}")
    if not bracket:
        return kind
    size = count.rstrip("]")
    if size.isdecimal():
        return types.array[kind, int(size)]
    return types.sequence[kind]


@functools.cache
def _raw_type(datatype: str) -> Any:
    """Return the class of a type whose samples stay bytes."""
    kind = dds_type(datatype)
    # set, not inherited: a class derived from it would go by another name on the wire
    kind.deserialize = classmethod(_keep)
    return kind


def _keep(cls: Any, data: bytes, *arguments: Any, **options: Any) -> _Sample:
    return _Sample(data)


def _heard(dds: Any, endpoint: Any) -> HeardTopic | None:
    datatype = ros_type_name(endpoint.type_name)
    if not endpoint.topic_name.startswith("rt/") or datatype is None:
        return None
    policy = dds.core.Policy
    durability = endpoint.qos[policy.Durability]
    reliability = endpoint.qos[policy.Reliability]
    return HeardTopic(
        endpoint.topic_name[2:],
        datatype,
        latched=durability is not None and durability != policy.Durability.Volatile,
        reliable=isinstance(reliability, policy.Reliability.Reliable),
    )


def _room_for_images() -> None:
    """Ask for a socket buffer that holds some raw images, which come in a burst of packets."""
    settings = os.environ.get("CYCLONEDDS_URI", "")
    if _ROOM not in settings:
        os.environ["CYCLONEDDS_URI"] = f"{_ROOM},{settings}".rstrip(",")


class DdsBus:
    """The topics of a DDS domain.

    Args:
        domain: ``ROS_DOMAIN_ID`` of the robot.

    Raises:
        MissingExtraError: cyclonedds is not installed.
        TooltipError: the domain cannot be joined.
    """

    def __init__(self, domain: int) -> None:
        dds = _dds()
        self._domain = domain
        # ahead of the user's own settings, which win; the system may grant less
        # (net.core.rmem_max)
        _room_for_images()
        try:
            self._participant = dds.domain.DomainParticipant(domain)
        except dds.core.DDSException as error:
            raise TooltipError(
                f"{self.where} cannot be joined ({' '.join(str(error).split())}); check the "
                "network and CYCLONEDDS_URI"
            ) from error

    @property
    def where(self) -> str:
        """The domain."""
        return f"DDS domain {self._domain}"

    def heard(self, wait_s: float) -> list[HeardTopic]:
        """Return what is published in the domain."""
        dds = _dds()
        reader = dds.builtin.BuiltinDataReader(
            self._participant, dds.builtin.BuiltinTopicDcpsPublication
        )
        found: dict[tuple[str, str], HeardTopic] = {}
        start = latest = time.monotonic()
        while True:
            for endpoint in reader.take(_TAKE):
                topic = _heard(dds, endpoint) if endpoint.sample_info.valid_data else None
                if topic is not None:
                    key = topic.name, topic.datatype
                    before = found.get(key, topic)
                    found[key] = replace(
                        topic,
                        latched=topic.latched and before.latched,
                        reliable=topic.reliable and before.reliable,
                    )
                    latest = time.monotonic()
            now = time.monotonic()
            if now - start > wait_s or (found and now - latest > SETTLED_S):
                break
            time.sleep(0.02)
        return sorted(found.values(), key=lambda topic: (topic.name, topic.datatype))

    def receiver(self, topic: HeardTopic, clock: ArrivalClock, report: SourceReport) -> Receiver:
        """Return what takes a topic's samples as bytes."""
        return _TopicReceiver(self._participant, topic, clock)

    def robot_description(self) -> str | None:
        """Return None: the robot's description is a topic."""
        return None

    def metadata(self) -> Mapping[str, str]:
        """Return the domain and where its times come from."""
        return {
            "publish_time": "the DDS source timestamp, of the publisher's machine",
            "ros_domain_id": str(self._domain),
        }


class _TopicReceiver:
    """Takes the samples of one topic as bytes."""

    def __init__(self, participant: Any, topic: HeardTopic, clock: ArrivalClock) -> None:
        self.name = f"topic {topic.name}"
        self._participant, self._topic, self._clock = participant, topic, clock

    def run(self, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver samples; publishers may come and go."""
        dds, heard = _dds(), self._topic
        core, policy = dds.core, dds.core.Policy
        latched, reliable = heard.latched, heard.reliable
        qos = core.Qos(
            policy.Reliability.Reliable(0) if reliable else policy.Reliability.BestEffort,
            policy.Durability.TransientLocal if latched else policy.Durability.Volatile,
            policy.History.KeepLast(_DEPTH),
            # what ROS 2 writes; the other representation would be stored as if it were this one
            policy.DataRepresentation(use_cdrv0_representation=True),
        )
        topic = dds.topic.Topic(self._participant, f"rt{heard.name}", _raw_type(heard.datatype))
        reader = dds.sub.DataReader(self._participant, topic, qos=qos)
        waitset = core.WaitSet(self._participant)
        condition = core.ReadCondition(
            reader, core.ViewState.Any | core.InstanceState.Any | core.SampleState.Any
        )
        waitset.attach(condition)
        while not halt.is_set():
            waitset.wait(round(_POLL_S * 1e9))
            while samples := reader.take(_TAKE):
                arrival_ns = self._clock.now_ns()
                for sample in samples:
                    if isinstance(sample, _Sample):
                        deliver(self._message(sample, arrival_ns))

    def _message(self, sample: _Sample, arrival_ns: int) -> Message:
        published_ns = sample.sample_info.source_timestamp
        return Message(
            self._topic.name,
            self._topic.datatype,
            arrival_ns,
            sample.payload,
            published_ns if published_ns > 0 else arrival_ns,
        )
