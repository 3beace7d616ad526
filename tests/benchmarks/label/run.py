"""Label a recording's test frames in headless Chromium as fast as the page allows.

    python -m tests.benchmarks.label.run REC TRUTH.json [--pictures DIR]

TRUTH.json holds ``stamps_ns`` and ``uv``, the true pixel in every image; ``visible`` where it is
known. Each frame takes a click on the tip, or Q where it is hidden, and F. Prints the actions a
frame, the time from a key to the next frame on the screen (where it was fetched ahead, and after a
jump to one that was not), the time of a saved change, and how far the labels lie from the truth.
Pictures of the page are taken in light and dark, on a desk, a laptop, and at 200 %.
Needs playwright and a Chromium.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from tests.helpers.labelling import Hand, Served, frame_times_ms, label_all, serving

ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking")
SIZES = {"desk": (1440, 900, 1), "laptop": (1366, 768, 1), "zoom200": (683, 384, 2)}


def summary(times: list[float]) -> str:
    """Return the statistics of times in ms."""
    middle, high = np.percentile(times, [50, 95])
    return f"median {middle:.0f} ms, 95 % below {high:.0f} ms, longest {max(times):.0f} ms"


def report(hand: Hand, served: Served, truth: dict[str, Any], seconds: float) -> None:
    """Print what was measured."""
    frames = len(served.session.frames)
    times = frame_times_ms(hand.page)
    print(f"{frames} frames, {hand.actions} actions: {hand.actions / frames:.2f} a frame")
    print(f"{seconds:.0f} s in all; next frame, asked for to painted: {summary(times[1:])}")
    hand.page.reload()
    hand.image_is_here()
    hand.page.evaluate("performance.clearMeasures()")
    for place in range(8, frames, max(frames // 10, 6)):
        hand.page.locator(f"#strip li:nth-child({place}) button").click()
        hand.image_is_here()
        hand.page.wait_for_timeout(300)
    print(f"jump to a frame that was not fetched: {summary(frame_times_ms(hand.page))}")
    true = dict(zip(truth["stamps_ns"], truth["uv"], strict=True))
    apart = [
        float(np.hypot(*np.subtract(row.pixel, true[stamp])))
        for stamp, row in served.rows.items()
        if row.pixel is not None
    ]
    print(f"{len(served.rows)} labels; distance to the truth: largest {max(apart):.3f} px")


def look(browser: Browser, served: Served, folder: Path) -> None:
    """Take pictures of the page."""
    folder.mkdir(exist_ok=True)
    for name, (width, height, ratio) in SIZES.items():
        for scheme in ("light", "dark"):
            context = browser.new_context(
                viewport={"width": width, "height": height},
                device_scale_factor=ratio,
                color_scheme="dark" if scheme == "dark" else "light",
            )
            hand = Hand(context.new_page()).open(served.url)
            hand.page.screenshot(path=folder / f"{name}-{scheme}.png")
            hand.key("?")
            hand.page.screenshot(path=folder / f"{name}-{scheme}-help.png")
            context.close()


def main() -> None:
    """Label a copy of the recording, and report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    truth = json.loads(options.truth.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=list(ARGUMENTS)
        )
        with serving(options.recording, selection=None, out=Path(folder)) as served:
            context = browser.new_context(viewport={"width": 1366, "height": 768})
            hand = Hand(context.new_page()).open(served.url)
            start = time.monotonic()
            # a person looks at each frame; the page fetches ahead meanwhile
            label_all(hand, served, truth, pause_ms=150)
            report(hand, served, truth, time.monotonic() - start)
            if options.pictures:
                look(browser, served, options.pictures)
        browser.close()


if __name__ == "__main__":
    main()
