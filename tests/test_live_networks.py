"""What holds for a robot on each network: DDS, Zenoh and ROS 1, each with processes of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.cli import tooltip
from tests.helpers.recorder import by_topic, ended, recorder
from tests.helpers.robots import (
    LOOPBACK,
    TRANSPORTS,
    Network,
    can_use,
    image_of,
    joint_of,
    network,
    own_domain,
)
from tests.helpers.ros1_robot import DESCRIPTION, IMAGE, INFO, RAW, STATES
from tooltip_cli.log import messages

pytestmark = pytest.mark.parametrize("transport", TRANSPORTS)


@pytest.fixture
def joined(transport: str, worker_id: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    if not can_use(transport):
        pytest.skip(f"what 'record {transport}' and its robot need is not installed")
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.delenv("ZENOH_SESSION_CONFIG_URI", raising=False)
    with network(transport, own_domain(worker_id)) as joined:
        yield joined


@pytest.mark.parametrize(
    ("kind", "topic", "datatype"),
    [("jpeg", IMAGE, messages.COMPRESSED_IMAGE), ("raw", RAW, messages.IMAGE)],
)
def test_every_message_arrives_byte_for_byte(
    kind: str, topic: str, datatype: str, transport: str, joined: Network, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    sender = joined.start(kind, 320, 240, 30, 200, 2.0)
    names = ("--image", topic, "--joints", STATES, "--patience", 3)
    listener = recorder(transport, out, *joined.options, *names)
    sent, _ = sender.communicate(timeout=90)
    ended(listener)
    images, joints = map(int, sent.split())
    found = by_topic(out)
    expected = image_of(transport, kind, 320, 240, 30)
    assert [m.payload for m in found[topic]] == [expected(i) for i in range(images)]
    assert [m.payload for m in found[STATES]] == [
        joint_of(transport, 200, i) for i in range(joints)
    ]
    assert {m.datatype for m in found[topic]} == {datatype}
    # the publisher's time where the network brings one, which is not simply the arrival's
    times = [(m.publish_time_ns, m.log_time_ns) for m in found[topic] + found[STATES]]
    assert all(0 <= arrived - published < 10**10 for published, arrived in times)
    assert any(published < arrived for published, arrived in times) == (transport != "ros1")


def test_list_shows_topics_types_and_rates(transport: str, joined: Network) -> None:
    sender = joined.start("jpeg", 64, 48, 20, 100, 4)
    command = ("record", "list", "--on", transport, *joined.options, "--json")
    done = tooltip(*command)
    for _ in range(10):  # until the robot is up
        if done.code == 0 and len(json.loads(done.out)) == 4:
            break
        done = tooltip(*command)
    sender.communicate(timeout=90)
    found = {item["topic"]: item for item in json.loads(done.out)}
    other, rate = ("/rosout", None) if transport == "ros1" else (DESCRIPTION, 0)
    assert set(found) == {IMAGE, INFO, STATES, other}
    assert {item["transport"] for item in found.values()} == {transport}
    assert found[IMAGE]["type"] == messages.COMPRESSED_IMAGE
    assert found[STATES]["hz"] > found[IMAGE]["hz"] > 1
    assert found[other]["hz"] == rate
