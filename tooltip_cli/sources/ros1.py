"""ROS 1 topics from a master, without ROS: XML-RPC to ask who publishes, TCPROS for the messages.

Nothing is registered with the master: it is asked once a second who publishes. So nobody has to
reach this machine, whose name the robot need not know.

Source: ROS wiki, "Master API", "Slave API", "TCPROS" and "Connection Header".
"""

from __future__ import annotations

import http.client
import os
import socket
import struct
import threading
import time
import xmlrpc.client
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.qos import latched_qos
from tooltip_cli.log.records import MAX_RECORD_BYTES
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.bus import SETTLED_S, HeardTopic
from tooltip_cli.sources.live import ArrivalClock, Deliver, Receiver
from tooltip_cli.sources.ros1types import cdr_from_ros1, definition_sum, ros2_name
from tooltip_cli.sources.streams import one_line

MASTER = "http://localhost:11311"
_CALLER = f"/tooltip_{os.getpid()}"
_ASK_S = 1.0  # between questions to the master
_TIMEOUT_S = 3.0
_POLL_S = 0.2  # between looks at whether to stop
_MAX_HEADER_BYTES = 1 << 20
_LENGTH = struct.Struct("<I")
_DESCRIPTION = "robot_description"
# a machine that has lost its power is noticed after this many seconds without an answer
_KEEPALIVE = {"TCP_KEEPIDLE": 4, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}


class Ros1Bus:
    """The topics that a ROS 1 master knows of.

    Args:
        master: ``ROS_MASTER_URI`` of the robot.

    Raises:
        MissingExtraError: rosbags is not installed.
        TooltipError: it is no address, or no master answers there.
    """

    def __init__(self, master: str = MASTER) -> None:
        definition_sum(messages.JOINT_STATE)  # what is not installed is missed at once
        self._uri = master
        self._lock, self._silent = threading.Lock(), False
        parts = urlsplit(master)
        if parts.scheme != "http" or not parts.hostname:
            raise TooltipError(f"{master} is no ROS 1 master; expected e.g. http://robot:11311")
        self._ask("getUri")

    @property
    def where(self) -> str:
        """The master's address."""
        return f"the ROS 1 master at {self._uri}"

    def heard(self, wait_s: float) -> list[HeardTopic]:
        """Return what is published by the nodes that the master knows."""
        start = latest = time.monotonic()
        found: list[HeardTopic] = []
        while True:
            before, found = found, self._topics()
            now = time.monotonic()
            if found != before:
                latest = now
            if now - start > wait_s or (found and now - latest > SETTLED_S):
                return found
            time.sleep(_POLL_S)

    def receiver(self, topic: HeardTopic, clock: ArrivalClock, report: SourceReport) -> Receiver:
        """Return what receives a topic from all of its publishers."""
        return _TopicReceiver(self, topic, clock, report)

    def robot_description(self) -> str | None:
        """Return the URDF on the parameter server; None where there is none, or several."""
        names = [
            name
            for name in self._ask("getParamNames")
            if str(name).rsplit("/", 1)[-1] == _DESCRIPTION
        ]
        if len(names) != 1:
            return None
        text = self._ask("getParam", names[0])
        return text if isinstance(text, str) and "<robot" in text else None

    def metadata(self) -> Mapping[str, str]:
        """Return the master and where its times come from."""
        return {
            "publish_time": "arrival, for ROS 1 sends none",
            "ros_master_uri": self._uri,
            "converted": "from ROS 1 messages to ROS 2 CDR, without the header's seq",
        }

    def publishers(self, topic: str, report: SourceReport) -> list[str]:
        """Return the addresses of the nodes that publish a topic now.

        That the master does not answer is noted once; nobody can be found then.
        """
        try:
            state = self._ask("getSystemState")[0]
            nodes = [str(node) for name, names in state if name == topic for node in names]
            found = [str(self._ask("lookupNode", node)) for node in nodes]
        except TooltipError as error:
            self._note(f"{error}; who is connected is recorded on", report, silent=True)
            return []
        self._note(f"{self.where} answers again", report, silent=False)
        return found

    def _note(self, text: str, report: SourceReport, *, silent: bool) -> None:
        with self._lock:
            if silent != self._silent:
                self._silent = silent
                report.notes.append(text)

    def _topics(self) -> list[HeardTopic]:
        types = {str(name): str(kind) for name, kind in self._ask("getTopicTypes")}
        published = [str(name) for name, _ in self._ask("getSystemState")[0]]
        return [
            HeardTopic(name, ros2_name(types.get(name, "*")), reliable=True)
            for name in sorted(published)
        ]

    def _ask(self, method: str, *arguments: Any) -> Any:
        return _call(self._uri, self.where, method, *arguments)


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        """Return a connection that does not wait for ever."""
        return http.client.HTTPConnection(str(host), timeout=_TIMEOUT_S)


def _call(uri: str, who: str, method: str, *arguments: Any) -> Any:
    """Return what a master or a node answers.

    Raises:
        TooltipError: it does not answer, or refuses.
    """
    try:
        with xmlrpc.client.ServerProxy(uri, transport=_Transport()) as proxy:
            code, text, value = getattr(proxy, method)(_CALLER, *arguments)
    except (OSError, http.client.HTTPException) as error:
        raise TooltipError(
            f"{who} cannot be reached ({one_line(error)}); is it running, and is the name known "
            "here (ROS_MASTER_URI, /etc/hosts)?"
        ) from error
    except (xmlrpc.client.Error, ValueError, TypeError, SyntaxError) as error:
        raise TooltipError(f"{who} does not answer as ROS 1 does ({one_line(error)})") from error
    if code != 1:
        raise TooltipError(f"{who} refuses {method} ({text})")
    return value


class _TopicReceiver:
    """Receives a topic from whoever publishes it, a thread each."""

    def __init__(
        self, bus: Ros1Bus, topic: HeardTopic, clock: ArrivalClock, report: SourceReport
    ) -> None:
        self.name = f"topic {topic.name}"
        self._bus, self._topic, self._clock, self._report = bus, topic, clock, report
        self._told: set[str] = set()

    def run(self, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver messages; publishers and the master may come and go."""
        threads: dict[str, threading.Thread] = {}
        while not halt.is_set():
            for address in self._bus.publishers(self._topic.name, self._report):
                if address not in threads or not threads[address].is_alive():
                    threads[address] = threading.Thread(
                        target=self._listen, args=(address, deliver, halt), daemon=True
                    )
                    threads[address].start()
            halt.wait(_ASK_S)
        for thread in threads.values():
            thread.join(_TIMEOUT_S)

    def _listen(self, address: str, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver what one node publishes until it goes; it is tried again a little later."""
        try:
            with _Connection(address, self._topic, halt) as connection:
                qos = latched_qos() if connection.latching else None
                while (payload := connection.receive()) is not None:
                    self._deliver(payload, qos, deliver)
        except TooltipError as error:
            if str(error) not in self._told:
                self._told.add(str(error))
                self._report.notes.append(str(error))

    def _deliver(self, payload: bytes, qos: str | None, deliver: Deliver) -> None:
        arrival_ns = self._clock.now_ns()
        try:
            converted = cdr_from_ros1(payload, self._topic.datatype)
        except Exception:  # the decoder meets arbitrary bytes
            self._report.drop(f"messages on {self._topic.name} that are no {self._topic.datatype}")
            return
        deliver(Message(self._topic.name, self._topic.datatype, arrival_ns, converted, qos=qos))


class _Connection:
    """A TCPROS connection to one node that publishes a topic."""

    def __init__(self, address: str, topic: HeardTopic, halt: threading.Event) -> None:
        self._halt = halt
        self._who = f"{address}, which publishes {topic.name},"
        protocol = _call(address, self._who, "requestTopic", topic.name, [["TCPROS"]])
        try:
            kind, host, port = protocol
            if kind != "TCPROS":
                raise ValueError(kind)
            self._socket = socket.create_connection((str(host), int(port)), _TIMEOUT_S)
        except (TypeError, ValueError) as error:
            raise TooltipError(f"{self._who} offers no TCPROS connection ({protocol})") from error
        except OSError as error:
            raise TooltipError(
                f"{self._who} cannot be connected to at {host}:{port} ({one_line(error)}); its "
                "ROS_IP or ROS_HOSTNAME must be known here"
            ) from error
        try:
            self._greet(topic)
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> _Connection:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()

    def receive(self) -> bytes | None:
        """Return the next message; None: the node has closed the connection, or it is the end.

        Raises:
            TooltipError: it sends nonsense.
        """
        try:
            head = self._exactly(_LENGTH.size)
            if head is None:
                return None
            (length,) = _LENGTH.unpack(head)
            if length > MAX_RECORD_BYTES:
                raise TooltipError(f"{self._who} announces a message of {length} bytes")
            return self._exactly(length)
        except OSError:  # reset, or no sign of life: its return is waited for
            return None

    def _greet(self, topic: HeardTopic) -> None:
        package, _, name = topic.datatype.partition("/msg/")
        fields = {
            "callerid": _CALLER,
            "topic": topic.name,
            "type": f"{package}/{name}",
            "md5sum": definition_sum(topic.datatype),
            "tcp_nodelay": "1",
        }
        lines = [f"{key}={value}".encode() for key, value in fields.items()]
        packed = b"".join(_LENGTH.pack(len(line)) + line for line in lines)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in _KEEPALIVE.items():
                if hasattr(socket, option):  # not every system has all of them
                    self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
            self._socket.settimeout(_POLL_S)
            self._socket.sendall(_LENGTH.pack(len(packed)) + packed)
            head = self._exactly(_LENGTH.size)
            length = _LENGTH.unpack(head)[0] if head is not None else 0
            answer = self._exactly(length) if 0 < length <= _MAX_HEADER_BYTES else None
        except OSError as error:
            raise TooltipError(f"{self._who} was lost ({one_line(error)})") from error
        fields = _header_fields(answer or b"")
        if "error" in fields:
            raise TooltipError(f"{self._who} refuses: {' '.join(fields['error'].split())}")
        if not self._halt.is_set() and "md5sum" not in fields:
            raise TooltipError(f"{self._who} does not answer as TCPROS does")
        self.latching = fields.get("latching") == "1"

    def _exactly(self, count: int) -> bytes | None:
        """Return so many bytes; None: the connection or the recording has ended before."""
        data = bytearray(count)
        view, filled = memoryview(data), 0
        while filled < count:
            if self._halt.is_set():
                return None
            try:
                taken = self._socket.recv_into(view[filled:])
            except TimeoutError:
                continue
            if not taken:
                return None
            filled += taken
        return bytes(data)


def _header_fields(data: bytes) -> dict[str, str]:
    """Return the fields of a connection header; what does not fit in is left out."""
    fields, start = {}, 0
    while start + _LENGTH.size <= len(data):
        (length,) = _LENGTH.unpack_from(data, start)
        start += _LENGTH.size
        name, found, value = data[start : start + length].partition(b"=")
        if found:
            fields[name.decode(errors="replace")] = value.decode(errors="replace")
        start += length
    return fields
