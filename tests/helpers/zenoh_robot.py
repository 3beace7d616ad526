"""A robot that speaks ``rmw_zenoh``, as the network sees it: a peer process that publishes.

python -m tests.helpers.zenoh_robot ROUTER KIND WIDTH HEIGHT FPS JOINT_HZ SECONDS

Its router, a process of its own::

python -m tests.helpers.zenoh_robot ROUTER
"""

from __future__ import annotations

import struct
import sys
import time
from typing import Any

import zenoh
from zenoh.ext import CacheConfig, declare_advanced_publisher

from tests.helpers.pacing import pace, play_file
from tests.helpers.robot import CAMERA, CAMERA_FRAME, URDF
from tests.helpers.ros2_robot import (
    IMAGE,
    INFO,
    RAW,
    ROBOT,
    START_NS,
    STATES,
    image_payload,
    joint_payload,
)
from tooltip_cli.log import messages

DOMAIN = 0
HASH = "RIHS01_5f6b3cd9d4a5b5b0b8a44e65c2e5bb1b0d1f9f0f6a5f8e7d6c5b4a39281706f5"
_MATCHED_S = 30.0
SENSOR, DEFAULT, LATCHED = "2::,5:,:,:,,", "::,10:,:,:,,", ":1:,1:,:,:,,"


def session(mode: str, **endpoints: str) -> Any:
    """Return a session that knows of no others than those at its endpoints."""
    config = zenoh.Config()
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", f'["{endpoints.get("listen", "tcp/127.0.0.1:0")}"]')
    if "connect" in endpoints:
        config.insert_json5("connect/endpoints", f'["{endpoints["connect"]}"]')
    config.insert_json5("timestamping/enabled", "true")
    return zenoh.open(config)


class Publisher:
    """Announces a topic and publishes ready-made CDR bytes on it, numbered."""

    def __init__(
        self, peer: Any, name: str, datatype: str, qos: str = DEFAULT, type_hash: str = HASH
    ) -> None:
        package, _, kind = datatype.partition("/msg/")
        wire = f"{package}::msg::dds_::{kind}_"
        key = f"{DOMAIN}{name}/{wire}/{type_hash}"
        token = f"@ros2_lv/{DOMAIN}/{peer.zid()}/0/{abs(hash(name)) % 99}/MP/%/%/robot"
        token += f"/{name.replace('/', '%')}/{wire}/{type_hash}/{qos}"
        self.publisher: Any
        if qos == LATCHED:
            self.publisher = declare_advanced_publisher(
                peer, key, cache=CacheConfig(1), publisher_detection=True
            )
        else:
            block = zenoh.CongestionControl.BLOCK  # so that a test knows what must arrive
            self.publisher = peer.declare_publisher(key, congestion_control=block)
        self._token = peer.liveliness().declare_token(token)
        self._identifier = hash(token).to_bytes(16, "little", signed=True)
        self.number = 0

    def send(self, payload: bytes) -> None:
        self.number += 1
        attachment = struct.pack("<qqB", self.number, time.time_ns(), 16) + self._identifier
        self.publisher.put(payload, attachment=attachment)


def heard(*publishers: Publisher) -> bool:
    """Return whether somebody subscribes to each of them."""
    return all(item.publisher.matching_status.matching for item in publishers)


def main(router: str, kind: str, width: int, height: int, fps: float, hz: float, s: float) -> None:
    peer = session("peer", connect=router)
    images = (
        Publisher(peer, IMAGE, messages.COMPRESSED_IMAGE, SENSOR)
        if kind == "jpeg"
        else Publisher(peer, RAW, messages.IMAGE, SENSOR)
    )
    infos = Publisher(peer, INFO, messages.CAMERA_INFO, SENSOR)
    states = Publisher(peer, STATES, messages.JOINT_STATE)
    robot = Publisher(peer, ROBOT, messages.STRING, LATCHED)
    robot.send(messages.string(URDF))
    payloads = [image_payload(kind, width, height, number) for number in range(30)]
    end = time.monotonic() + _MATCHED_S
    while not heard(images, states):
        if time.monotonic() > end:
            raise SystemExit("nobody listens")
        time.sleep(0.01)
    time.sleep(0.5)

    def image(number: int) -> None:
        infos.send(messages.camera_info(START_NS + number * 10**7, CAMERA_FRAME, CAMERA))
        images.send(payloads[number % len(payloads)])

    print(*pace(fps, hz, s, image, lambda number: states.send(joint_payload(number))), flush=True)
    time.sleep(1.0)


def play(router: str, path: str) -> None:
    """Publish the messages of a file; see tests.helpers.pacing."""
    peer = session("peer", connect=router)
    play_file(path, lambda name, kind: Publisher(peer, name, kind).send)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        kept = session("router", listen=sys.argv[1])
        print("ready", flush=True)
        sys.stdin.read()  # until the test closes it
    elif sys.argv[2] == "play":
        play(sys.argv[1], sys.argv[3])
    else:
        where, kind, width, height, fps, hz, seconds = sys.argv[1:]
        main(where, kind, int(width), int(height), float(fps), float(hz), float(seconds))
