"""Sending images and joints at steady rates."""

from __future__ import annotations

import json
import time
from collections.abc import Callable


def pace(
    fps: float,
    hz: float,
    seconds: float,
    image: Callable[[int], object],
    joint: Callable[[int], object],
) -> tuple[int, int]:
    """Call both with running numbers at their rates; return how often."""
    start, images, joints = time.monotonic(), 0, 0
    while (now := time.monotonic() - start) < seconds:
        if now * fps >= images:
            image(images)
            images += 1
        if now * hz >= joints:
            joint(joints)
            joints += 1
        ahead = min(images / fps, joints / hz) - (time.monotonic() - start)
        if ahead > 0:
            time.sleep(ahead)
    return images, joints


def play_file(path: str, senders: Callable[[str, str], Callable[[bytes], object]]) -> None:
    """Send the messages of a file at their times.

    Args:
        path: for each message a line of JSON, with ``at_s``, ``topic``, ``type`` and ``bytes``, and
            behind it so many bytes.
        senders: returns what sends on a topic of a type; called for all of them before the first.
    """
    items: list[tuple[float, str, bytes]] = []
    known: dict[str, Callable[[bytes], object]] = {}
    with open(path, "rb") as file:  # noqa: PTH123 - also run by Pythons with nothing installed
        while line := file.readline():
            head = json.loads(line)
            if head["topic"] not in known:
                known[head["topic"]] = senders(head["topic"], head["type"])
            items.append((head["at_s"], head["topic"], file.read(head["bytes"])))
    time.sleep(5.0)  # until whoever listens has found all topics
    start = time.monotonic()
    for at_s, topic, data in items:
        time.sleep(max(start + at_s - time.monotonic(), 0))
        known[topic](data)
    time.sleep(1.0)
