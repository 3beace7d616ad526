"""Messages of one log into another, with their own schemas, channels and sequence numbers."""

from __future__ import annotations

from tooltip_cli.log.container import LoggedMessage
from tooltip_cli.log.mcapfile import McapFile
from tooltip_cli.log.qos import known_qos
from tooltip_cli.log.records import LoggedChannel, LoggedSchema


class Copier:
    """Appends logged messages to a file as they are.

    Args:
        plain_qos: whether to write QoS so that it is read without the source's other records.
    """

    def __init__(self, mcap: McapFile, *, plain_qos: bool) -> None:
        self._mcap, self._plain_qos = mcap, plain_qos
        self._schemas: dict[LoggedSchema, int] = {}
        # by identity; kept with the channel, so that no other gets the same one
        self._channels: dict[int, tuple[LoggedChannel, int]] = {}

    def copy(self, message: LoggedMessage) -> None:
        """Append a message."""
        known = self._channels.get(id(message.channel))
        if known is None:
            known = self._channels[id(message.channel)] = (
                message.channel,
                self._add_channel(message.channel),
            )
        self._mcap.add_message(
            known[1],
            message.log_time_ns,
            message.publish_time_ns,
            message.payload,
            message.sequence,
        )

    def _add_channel(self, channel: LoggedChannel) -> int:
        schema = channel.schema
        if schema is not None and schema not in self._schemas:
            self._schemas[schema] = self._mcap.add_schema(schema.name, schema.encoding, schema.text)
        metadata = dict(channel.metadata)
        if channel.encoding == "cdr":  # required of the profile ros2
            stated = metadata.setdefault("offered_qos_profiles", "")
            if self._plain_qos:
                metadata["offered_qos_profiles"] = known_qos(stated) or ""
        number = self._schemas[schema] if schema is not None else 0
        return self._mcap.add_channel(channel.topic, channel.encoding, number, metadata)
