"""Sending images and joints at steady rates."""

from __future__ import annotations

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
