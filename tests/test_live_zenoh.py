"""``tooltip record zenoh``: a router and a peer that publishes, each a process of its own."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh")

from tests.helpers import zenoh_robot
from tests.helpers.cli import tooltip
from tests.helpers.live import free_port
from tests.helpers.recorder import by_topic, ended, grown, recorder, wait_for
from tests.helpers.robot import URDF
from tests.helpers.robots import Router, network_at
from tests.helpers.ros2_robot import (
    IMAGE,
    ROBOT,
    STATES,
    image_payload,
    joint_payload,
)
from tests.helpers.zenoh_robot import Publisher, heard, session
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.bus import HeardTopic
from tooltip_cli.sources.live import ArrivalClock
from tooltip_cli.sources.zenoh_bus import ZenohBus, key_of_topic, topic_of_token

ANNOUNCED = (
    "@ros2_lv/7/1a2b/0/11/MP/%/%arm/driver/%arm%joint_states/"
    "sensor_msgs::msg::dds_::JointState_/RIHS01_ab/"
)


@pytest.fixture
def router(monkeypatch: pytest.MonkeyPatch) -> Iterator[Router]:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.delenv("ZENOH_SESSION_CONFIG_URI", raising=False)
    router = Router()
    yield router
    router.stop()


@pytest.fixture
def peer(router: Router) -> Iterator[Any]:
    peer = session("peer", connect=router.address)
    yield peer
    peer.close()


def test_topics_are_found_and_latched_ones_are_read(
    router: Router, peer: Any, tmp_path: Path
) -> None:
    images = Publisher(peer, IMAGE, messages.COMPRESSED_IMAGE, zenoh_robot.SENSOR)
    states = Publisher(peer, STATES, messages.JOINT_STATE)
    described = Publisher(peer, ROBOT, messages.STRING, zenoh_robot.LATCHED)
    described.send(messages.string(URDF))
    listener = recorder("zenoh", tmp_path / "out.mcap", "--router", router.address)
    wait_for(lambda: heard(images, states), "a subscription to both")
    for i in range(50):
        images.send(image_payload("jpeg", 32, 24, i))
        states.send(joint_payload(i))
        time.sleep(0.01)
    time.sleep(0.5)
    ended(listener, signal.SIGINT)
    found = by_topic(tmp_path / "out.mcap")
    assert set(found) == {IMAGE, STATES, ROBOT}
    assert len(found[IMAGE]) == len(found[STATES]) == 50
    assert [m.payload for m in found[ROBOT]] == [messages.string(URDF)]


def test_publisher_and_router_may_go_and_come_back(router: Router, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    names = ("--image", IMAGE, "--joints", STATES, "--reconnect")
    listener = recorder("zenoh", out, "--router", router.address, *names)
    first = network_at("zenoh", router.address).start("jpeg", 320, 240, 30, 100, 60)
    wait_for(grown(out, 100_000), "a recording")
    maps = Path(f"/proc/{listener.pid}/maps")
    # what is mapped of a publisher stays when that has gone
    assert not maps.exists() or ".zenoh" not in maps.read_text()
    first.kill()
    first.communicate()
    router.stop()
    time.sleep(2)  # so that the silence is noticed
    router.start()
    second = network_at("zenoh", router.address).start("jpeg", 320, 240, 30, 100, 1.5)
    second.communicate(timeout=90)
    err = ended(listener, signal.SIGINT)
    payloads = [m.payload for m in by_topic(out)[IMAGE]]
    assert payloads.count(image_payload("jpeg", 320, 240, 0)) >= 2
    assert f"nothing on {IMAGE} any more" in err
    assert f"{IMAGE} is heard again after" in err


def test_a_topic_of_the_wrong_type_is_named(router: Router, peer: Any, tmp_path: Path) -> None:
    kept = (
        Publisher(peer, IMAGE, messages.COMPRESSED_IMAGE, zenoh_robot.SENSOR),
        Publisher(peer, STATES, messages.POSE_STAMPED),
    )
    out, options = tmp_path / "out.mcap", ("--router", router.address, "--joints", STATES)
    done = tooltip("record", "zenoh", out, *options)
    assert len(kept) == 2
    assert done.code == 1
    assert (
        f"{STATES} carries geometry_msgs/msg/PoseStamped, expected sensor_msgs/msg/JointState"
        in done.error
    )
    assert not list(tmp_path.iterdir())


def test_what_the_network_lost_or_is_no_cdr_is_counted(router: Router, peer: Any) -> None:
    states = Publisher(peer, STATES, messages.JOINT_STATE)
    bus, report, taken = ZenohBus(0, router.address), SourceReport(), list[bytes]()
    halt = threading.Event()
    receiver = bus.receiver(HeardTopic(STATES, messages.JOINT_STATE), ArrivalClock(), report)
    thread = threading.Thread(
        target=receiver.run, args=(lambda message: taken.append(message.payload), halt)
    )
    thread.start()
    wait_for(lambda: heard(states), "a subscription")
    states.send(joint_payload(0))
    states.number += 3  # as if three had been sent
    states.send(joint_payload(1))
    states.publisher.put(
        joint_payload(2), attachment=b"what an older release attached, of another length"
    )
    states.send(b"{}")
    wait_for(lambda: len(report.dropped) == 2, "both losses")
    halt.set()
    thread.join()
    assert taken == [joint_payload(0), joint_payload(1), joint_payload(2)]
    assert report.dropped == {
        f"messages on {STATES} that were lost on the way here": 3,
        f"messages on {STATES} that are not plain CDR": 1,
    }


def test_no_thread_is_left_that_would_take_a_sample(router: Router) -> None:
    """One that is still on its way out when the interpreter ends aborts the process."""
    bus, halt, before = ZenohBus(0, router.address), threading.Event(), set(threading.enumerate())
    topics = [HeardTopic(f"/{i}", messages.STRING, latched=i % 2 == 0) for i in range(20)]
    receivers = [bus.receiver(topic, ArrivalClock(), SourceReport()) for topic in topics]
    threads = [
        threading.Thread(target=receiver.run, args=(lambda message: None, halt), daemon=True)
        for receiver in receivers
    ]
    for thread in threads:
        thread.start()
    wait_for(lambda: len(set(threading.enumerate()) - before) == 2 * len(threads), "all to listen")
    halt.set()
    for thread in threads:
        thread.join()
    assert set(threading.enumerate()) == before
    bus.heard(0.1)
    assert set(threading.enumerate()) == before


def test_without_a_router_the_line_says_what_to_do(tmp_path: Path) -> None:
    place = f"tcp/127.0.0.1:{free_port()}"
    done = tooltip("record", "zenoh", tmp_path / "out.mcap", "--router", place)
    assert done.code == 1
    assert f"Zenoh cannot be joined at {place}" in done.error
    assert "--router tcp/ROBOT:7447" in done.error
    assert not list(tmp_path.iterdir())


def test_a_configuration_file_is_taken(router: Router, peer: Any, tmp_path: Path) -> None:
    published = Publisher(peer, STATES, messages.JOINT_STATE)
    file = tmp_path / "session.json5"
    file.write_text(
        f'{{mode: "client", connect: {{endpoints: ["{router.address}"]}}, '
        "scouting: {multicast: {enabled: false}}}"
    )
    found = ZenohBus(0, config=file).heard(3.0)
    assert published.number == 0
    assert [topic.name for topic in found] == [STATES]
    with pytest.raises(TooltipError, match=r"Zenoh cannot be joined at .*missing\.json5"):
        ZenohBus(0, config=tmp_path / "missing.json5")


def test_without_zenoh_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    done = tooltip("record", "zenoh", "out.mcap")
    assert done.code == 1
    assert "pip install 'tooltip-cli[zenoh]'" in done.error


@pytest.mark.parametrize(
    ("qos", "latched", "reliable"),
    [
        ("::,10:,:,:,,", False, True),
        (":1:,1:,:,:,,", True, True),
        ("2:2:,5:,:,:,,", False, False),
        ("1:1:1,1:0,0:0,0:1,0,0", True, True),
    ],
)
def test_tokens_name_topics(qos: str, latched: bool, reliable: bool) -> None:
    assert topic_of_token(ANNOUNCED + qos) == HeardTopic(
        "/arm/joint_states", messages.JOINT_STATE, latched, reliable
    )


@pytest.mark.parametrize(
    "token",
    ["", "@ros2_lv/7/1a2b/0/0/NN/%/%/driver", ANNOUNCED[:-1], ANNOUNCED.replace("MP", "MS") + "::"],
)
def test_other_tokens_name_none(token: str) -> None:
    assert topic_of_token(token) is None


def test_keys_hold_domain_topic_and_type() -> None:
    topic = HeardTopic("/arm/joint_states", messages.JOINT_STATE)
    assert key_of_topic(7, topic) == "7/arm/joint_states/sensor_msgs::msg::dds_::JointState_/*"
