"""The labelling page in a browser, driven by mouse and keyboard as a person would."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.helpers.labelling import Hand, Served, label_all, serving
from tests.helpers.logs import (
    Log,
    decoded,
    encoded,
    image_message,
    stamp_of,
    true_pixels,
    wrist_parts,
    write_log,
    write_true_labels,
)
from tests.helpers.robot import CAMERA
from tooltip_cli.labels.book import TipLabel, rows_of
from tooltip_cli.labels.files import read_labels
from tooltip_cli.stages.label import Labeler

SIZE = (CAMERA.width, CAMERA.height)
DOT = (37, 81)  # the pixel that is lit in the images below
LAPTOP = {"width": 1366, "height": 768}
ZOOMED = {"width": 640, "height": 360}  # a small laptop's screen at 200 %


@pytest.fixture
def served(wrist: Log) -> Iterator[Served]:
    with serving(wrist.path) as found:
        yield found


@contextmanager
def tab(browser: Any, strict: bool = True, **options: Any) -> Iterator[Any]:
    """Yield a tab; what the browser complains about, and requests elsewhere, fail the test."""
    context = browser.new_context(**{"viewport": LAPTOP, **options})
    context.set_default_timeout(15_000)
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    context.on(
        "request",
        lambda call: None if call.url.startswith("http://127.0.0.1:") else complaints.append(call),
    )
    yield page
    context.close()
    assert complaints == [] or not strict


@pytest.fixture
def hand(browser: Any, served: Served) -> Iterator[Hand]:
    with tab(browser) as page:
        yield Hand(page).open(served.url)


def dot_log(path: Path, orientation: int | None = None) -> Path:
    """Write a recording whose images are black but for one pixel."""
    image = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    image[DOT[1], DOT[0]] = 255
    parts = wrist_parts(4)
    data, kind = encoded(image, ".png"), "png"
    if orientation is not None:
        data, kind = _turned(encoded(image, ".jpg"), orientation), "jpeg"
    parts["images"] = [image_message(stamp_of(i), data, image_format=kind) for i in range(4)]
    return write_log(path, parts)


def _turned(jpeg: bytes, orientation: int) -> bytes:
    """Insert an EXIF segment that tells viewers to turn the image."""
    entry = b"\x12\x01\x03\x00\x01\x00\x00\x00" + bytes([orientation, 0, 0, 0])
    tiff = b"II*\x00\x08\x00\x00\x00\x01\x00" + entry + b"\x00\x00\x00\x00"
    body = b"Exif\x00\x00" + tiff
    return jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:]


def dot_on(page: Any) -> tuple[float, float]:
    """Return where on the page the lit pixel is, by what the screen shows."""
    ratio = page.evaluate("devicePixelRatio")
    shot = decoded(page.screenshot(), cv2.IMREAD_COLOR).min(axis=2).astype(float)
    box = page.locator("#view").bounding_box()
    left, top, width, height = (round(box[key] * ratio) for key in ("x", "y", "width", "height"))
    light = np.zeros_like(shot)
    # what lies around the canvas is bright, and the zoom is written on its lower edge
    inside = np.s_[top + 4 : top + height - round(60 * ratio), left + 4 : left + width - 4]
    light[inside] = np.where(shot[inside] > 100, shot[inside], 0.0)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
    assert light.sum() > 0, "the dot is not to be seen"
    x, y = (float((grid * light).sum() / light.sum()) + 0.5 for grid in (columns, rows))
    return x / ratio, y / ratio


# Label, nudge, zoom.


def test_a_click_places_the_point_where_it_is(hand: Hand, served: Served) -> None:
    for frame in range(3):
        tip = true_pixels()[frame]
        hand.click(*hand.fitted(tip, SIZE))
        hand.saved()
        label = served.label(frame)
        assert label is not None
        assert label.pixel == pytest.approx(tip, abs=0.1)  # the mouse moves by whole pixels
        assert label.labeler == "ana"
        hand.key("f")
        hand.image_is_here()
    assert hand.actions == 6


def test_arrow_keys_move_the_point(hand: Hand, served: Served) -> None:
    hand.click(*hand.fitted((50, 60), SIZE))
    hand.saved()
    label = served.label(0)
    assert label is not None
    assert label.pixel is not None
    u, v = label.pixel
    hand.key("ArrowRight", "ArrowRight", "ArrowDown", "Shift+ArrowLeft", "Control+ArrowUp")
    hand.saved()
    assert served.label(0) == TipLabel(
        "visible", (round(u + 2 - 0.1, 2), round(v + 1 - 10, 2)), "ana"
    )
    hand.key(*["Control+ArrowUp"] * 12)
    hand.saved()
    edge = served.label(0)
    assert edge is not None
    assert edge.pixel is not None
    assert edge.pixel[1] == -0.5  # it stays inside the image


@pytest.mark.parametrize("ratio", [1, 1.25, 2])
def test_a_click_is_right_to_a_fraction_of_a_pixel_at_every_zoom(
    ratio: float, browser: Any, tmp_path: Path
) -> None:
    path = dot_log(tmp_path / "dot.mcap")
    small = {"width": 800, "height": 500}  # less to take pictures of
    with (
        serving(path) as served,
        tab(browser, device_scale_factor=ratio, viewport=small) as page,
    ):
        hand = Hand(page).open(served.url)
        for _ in range(6):
            place = hand.fitted(DOT, SIZE) if hand.actions == 0 else dot_on(page)
            hand.click(*place)
            hand.saved()
            label = served.label(0)
            assert label is not None
            scale = hand.zoom
            assert label.pixel == pytest.approx(DOT, abs=0.6 / scale), f"at {scale}"
            hand.key("Delete")
            hand.wheel(place[0] + 20, place[1] - 12, -240)
        assert scale > 10


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_cameras_note_on_orientation_turns_nothing(
    orientation: int, browser: Any, tmp_path: Path
) -> None:
    path = dot_log(tmp_path / "dot.mcap", orientation)
    with serving(path) as served, tab(browser) as page:
        hand = Hand(page).open(served.url)
        hand.wheel(*hand.fitted(DOT, SIZE), -240)
        hand.click(*dot_on(page))
        hand.saved()
        label = served.label(0)
        assert label is not None
        assert label.pixel == pytest.approx(DOT, abs=0.5)


def test_the_wheel_zooms_about_the_cursor_and_space_drags(hand: Hand, served: Served) -> None:
    x, y = hand.fitted((40, 30), SIZE)
    for _ in range(5):
        hand.wheel(x, y, -200)
    hand.click(x, y)
    hand.saved()
    first = served.label(0)
    assert first is not None
    assert first.pixel == pytest.approx((40, 30), abs=0.2)
    scale = hand.zoom
    hand.page.keyboard.down(" ")
    hand.page.mouse.move(x, y)
    hand.page.mouse.down()
    hand.page.mouse.move(x - 100, y - 50, steps=4)
    hand.page.mouse.up()
    hand.page.keyboard.up(" ")
    hand.saved()
    assert served.label(0) == first  # a drag is no click
    hand.click(x, y)
    hand.saved()
    moved = served.label(0)
    assert moved is not None
    assert moved.pixel == pytest.approx((40 + 100 / scale, 30 + 50 / scale), rel=0.02, abs=0.2)
    hand.key("0")
    hand.click(*hand.fitted((40, 30), SIZE))
    hand.saved()
    again = served.label(0)
    assert again is not None
    assert again.pixel == pytest.approx((40, 30), abs=0.1)


def test_a_press_can_be_adjusted_before_it_is_let_go(hand: Hand, served: Served) -> None:
    hand.page.mouse.move(*hand.fitted((50, 50), SIZE))
    hand.page.mouse.down()
    hand.page.mouse.move(*hand.fitted((60, 55), SIZE), steps=3)
    assert served.label(0) is None
    hand.page.mouse.up()
    hand.saved()
    label = served.label(0)
    assert label is not None
    assert label.pixel == pytest.approx((60, 55), abs=0.1)


def test_a_click_beside_the_image_is_no_label(hand: Hand, served: Served) -> None:
    hand.click(hand.box[0] + 3, hand.box[1] + 100)
    hand.key("f", "d")
    assert hand.state == "not labelled"
    assert served.rows == {}


def test_the_loupe_shows_the_point_eightfold(browser: Any, tmp_path: Path) -> None:
    with serving(dot_log(tmp_path / "dot.mcap")) as served, tab(browser) as page:
        hand = Hand(page).open(served.url)
        hand.page.mouse.move(*hand.fitted(DOT, SIZE))
        hand.page.evaluate("() => new Promise(requestAnimationFrame)")
        box = page.locator("#loupe").bounding_box()
        shot = decoded(page.screenshot(clip=box), cv2.IMREAD_COLOR)
        # the cross leaves the middle open
        middle = shot[shot.shape[0] // 2 - 3 :][:6, shot.shape[1] // 2 - 3 :][:, :6]
        assert middle.min() > 200
        lit = (shot[:, shot.shape[1] // 2 + 2] > 200).all(axis=1)
        assert 6 <= lit.sum() <= 10


def test_a_hundred_frames_take_two_actions_each(
    browser: Any, reference_data: Path, tmp_path: Path
) -> None:
    folder = reference_data / "reference"
    truth = json.loads((folder / "hammer.truth.json").read_text())
    with serving(folder / "hammer.mcap", selection=None, out=tmp_path) as served:
        with tab(browser) as page:
            hand = Hand(page).open(served.url)
            label_all(hand, served, truth)
        rows = served.rows
        assert list(rows) == served.session.stamps_ns
        assert len(rows) == 100
        assert hand.actions <= 2 * len(rows)
    true = dict(zip(truth["stamps_ns"], truth["uv"], strict=True))
    seen = {stamp: row.pixel for stamp, row in rows.items() if row.pixel is not None}
    assert 80 < len(seen) < 100
    for stamp, pixel in seen.items():
        assert pixel == pytest.approx(true[stamp], abs=0.05)


# States, undo, jumps.


def test_states_and_the_way_back(hand: Hand, served: Served) -> None:
    hand.key("q")
    hand.saved()
    assert served.label(0) == TipLabel("occluded", None, "ana")
    hand.key("o")
    hand.click(*hand.fitted((50, 50), SIZE))
    hand.key("ArrowLeft", "f", "r", "Delete", "q")
    hand.saved()
    assert served.label(1) == TipLabel("occluded", None, "ana")
    seen = []
    for _ in range(7):
        hand.key("z")
        hand.saved()
        seen.append((hand.frame, hand.state))
    first, second = "Frame 1 of 40", "Frame 2 of 40"
    assert seen == [
        (second, "not labelled"),
        (second, "visible at 49.0, 50.0"),
        (second, "not labelled"),
        (first, "visible at 50.0, 50.0"),
        (first, "out of view"),
        (first, "occluded"),
        (first, "not labelled"),
    ]
    assert served.rows == {}
    hand.key("z")
    assert hand.page.locator("#message").inner_text() == "There is nothing to undo."
    hand.key(*["Shift+z"] * 4, "Control+y", "Control+Shift+Z", "Shift+Z")
    hand.saved()
    assert served.label(1) == TipLabel("occluded", None, "ana")
    label = served.label(0)
    assert label is not None
    assert label.pixel == pytest.approx((49, 50), abs=0.1)


def test_a_held_key_is_undone_at_once(hand: Hand, served: Served) -> None:
    hand.click(*hand.fitted((50, 50), SIZE))
    for _ in range(9):  # a key that is down repeats
        hand.page.keyboard.down("ArrowRight")
    hand.page.keyboard.up("ArrowRight")
    assert hand.state.startswith("visible at 59")
    hand.key("z")
    assert hand.state == "visible at 50.0, 50.0"
    hand.key("z")
    hand.saved()
    assert hand.state == "not labelled"


def test_undo_outlives_a_reload(hand: Hand, served: Served) -> None:
    hand.key("q", "f", "o")
    hand.saved()
    hand.page.reload()
    hand.image_is_here()
    hand.key("z", "z")
    hand.saved()
    assert served.rows == {}


def test_jumps(hand: Hand, served: Served) -> None:
    hand.key("q", "f", "q", "End")
    assert hand.frame == "Frame 40 of 40"
    hand.key("f")
    assert hand.page.locator("#message").inner_text() == "This is the last frame."
    hand.key("n")
    assert hand.frame == "Frame 3 of 40"
    hand.page.get_by_role("button", name="Frame 20, image 19: not labelled").click()
    assert hand.frame == "Frame 20 of 40"
    hand.image_is_here()
    hand.click(*hand.fitted((50, 50), SIZE))
    hand.key("ArrowUp")  # keys mean the image again after a jump
    hand.saved()
    label = served.label(19)
    assert label is not None
    assert label.pixel == pytest.approx((50, 49), abs=0.1)
    assert hand.page.get_by_role("button", name="Frame 20, image 19: visible").count() == 1
    hand.key("Home", "d")
    assert hand.page.locator("#message").inner_text() == "This is the first frame."


def test_all_labelled_is_said(browser: Any, tmp_path: Path) -> None:
    with serving(dot_log(tmp_path / "dot.mcap")) as served, tab(browser) as page:
        hand = Hand(page).open(served.url)
        hand.key("q", "f", "q", "f", "q", "f", "q", "n")
        assert page.locator("#message").inner_text() == "Every frame is labelled."
        assert page.locator("#done").inner_text() == "4 of 4 labelled"
        hand.saved()
        assert len(served.rows) == 4


def test_a_neighbour_is_flashed_and_cannot_be_labelled(hand: Hand, served: Served) -> None:
    canvas = "() => document.getElementById('view').toDataURL()"
    before = hand.page.evaluate(canvas)
    hand.page.keyboard.down("s")
    badge = hand.page.locator("#badge", has_text="Image 1, not the one to label")
    badge.wait_for()
    hand.page.locator("#badge", has_text="Loading").wait_for(state="hidden")
    assert hand.page.evaluate(canvas) != before
    hand.page.mouse.click(*hand.fitted((50, 50), SIZE))
    hand.page.keyboard.up("s")
    assert hand.page.evaluate(canvas) == before
    assert served.rows == {}
    hand.page.get_by_role("button", name="Flash next image").click()
    badge.wait_for()
    badge.wait_for(state="hidden")


def test_hints_are_hidden_until_they_are_asked_for(wrist: Log, browser: Any) -> None:
    from tooltip_cli.stages.detect import detect

    detect(wrist.path)
    with serving(wrist.path) as served, tab(browser) as page:
        asked: list[str] = []
        page.on("request", lambda call: asked.append(call.url.rsplit("/", 1)[-1]))
        hand = Hand(page).open(served.url)
        canvas = "() => document.getElementById('view').toDataURL()"
        before = page.evaluate(canvas)
        assert "hints" not in asked
        button = page.get_by_role("button", name="Hints")
        assert button.get_attribute("aria-pressed") == "false"
        hand.key("h")
        page.locator("[data-action=hints][aria-pressed=true]").wait_for()
        assert page.evaluate(canvas) != before
        assert "can bias you" in page.locator("#hint-note").inner_text()
        hand.key("h")
        page.locator("[data-action=hints][aria-pressed=false]").wait_for()
        assert page.evaluate(canvas) == before


def test_a_blind_labeller_has_no_hints(wrist: Log, browser: Any) -> None:
    write_true_labels(wrist.labels, [1, 2])
    with serving(wrist.path, Labeler("ben", True), None) as served, tab(browser) as page:
        hand = Hand(page).open(served.url)
        assert hand.frame == "Frame 1 of 2"
        assert hand.state == "not labelled"
        assert not page.locator("[data-action=hints]").is_visible()
        hand.key("h", "q")
        hand.saved()
        assert served.label(0) == TipLabel("occluded", None, "ben")


# Images.


def test_the_next_frames_are_there_before_they_are_asked_for(browser: Any, served: Served) -> None:
    with tab(browser) as page:
        arrived: list[str] = []
        page.on("requestfinished", lambda call: arrived.append(call.url.rsplit("/", 1)[-1]))
        hand = Hand(page).open(served.url)
        while not {"1", "2", "3"} <= set(arrived):
            page.wait_for_event("requestfinished")
        page.wait_for_timeout(200)  # to decode what has arrived
        hand.key("f")
        assert not page.locator("#badge").is_visible()  # painted in the same breath
        hand.saved()


def test_a_click_before_the_image_is_here_is_no_label(browser: Any, served: Served) -> None:
    with tab(browser) as page:
        held: list[Any] = []
        page.route(re.compile(r"image/9$"), lambda route: held.append(route))  # noqa: PLW0108
        hand = Hand(page).open(served.url)
        page.get_by_role("button", name="Frame 10, image 9: not labelled").click()
        assert page.locator("#badge").inner_text() == "Loading …"
        page.mouse.click(*hand.fitted((50, 50), SIZE))
        assert page.locator("#message").inner_text() == "The image is not here yet."
        for _ in range(1500):
            if held:  # images before it come first
                break
            page.wait_for_timeout(10)
        assert held
        for route in held:
            route.continue_()
        hand.image_is_here()
        assert hand.state == "not labelled"
        hand.click(*hand.fitted((50, 50), SIZE))
        hand.saved()
        assert list(served.rows) == [stamp_of(9)]


def test_an_image_that_cannot_be_decoded_is_said(browser: Any, tmp_path: Path) -> None:
    parts = wrist_parts(3)
    parts["images"][1] = image_message(stamp_of(1), b"\xff\xd8\xff no image")
    path = write_log(tmp_path / "broken.mcap", parts)
    with serving(path) as served, tab(browser, strict=False) as page:
        hand = Hand(page).open(served.url)
        hand.key("f")
        page.locator("#badge", has_text="Image 1 cannot be shown").wait_for()
        page.mouse.click(*hand.fitted((50, 50), SIZE))
        hand.key("f")
        hand.image_is_here()
        assert served.rows == {}


# Reload, tabs, crashes.


def test_a_point_is_repeated_also_after_a_reload(hand: Hand, served: Served) -> None:
    hand.key("r")
    assert hand.page.locator("#message").inner_text() == "No point has been placed yet."
    hand.click(*hand.fitted((50, 60), SIZE))
    hand.key("f", "q", "f")
    hand.saved()
    hand.page.goto("about:blank")
    hand.open(served.url)
    assert hand.frame == "Frame 3 of 40"
    hand.key("r")
    hand.saved()
    assert served.label(2) == served.label(0)


def test_a_reload_resumes(hand: Hand, served: Served) -> None:
    hand.key("q", "f", "o", "f", "f")
    hand.saved()
    hand.page.wait_for_timeout(300)  # the address follows when the keys have come to rest
    hand.page.reload()
    hand.image_is_here()
    assert hand.frame == "Frame 4 of 40"
    hand.page.goto("about:blank")
    hand.open(served.url)
    assert hand.frame == "Frame 3 of 40"  # the first without a label
    hand.key("d")
    assert hand.state == "out of view"


def test_two_tabs_cannot_overwrite_each_other_unseen(browser: Any, served: Served) -> None:
    with tab(browser, strict=False) as page:  # a conflict is a 409, which Chromium logs
        other = Hand(page.context.new_page()).open(served.url)
        mine = Hand(page).open(served.url)
        mine.click(*mine.fitted((50, 50), SIZE))
        mine.saved()
        first = served.label(0)
        assert first is not None
        other.page.route("**/state", lambda route: route.abort())  # it has not noticed
        other.key("q")
        alert = other.page.get_by_role("alert")
        alert.get_by_text("Frame 1 was changed elsewhere").wait_for()
        assert served.label(0) == first
        assert other.state == "visible at 50.0, 50.0"
        alert.get_by_role("button", name="Keep theirs").click()
        assert not alert.is_visible()
        assert served.label(0) == first
        other.key("f", "q")  # another frame is no conflict
        other.saved()
        assert served.label(1) == TipLabel("occluded", None, "ana")
        mine.page.route("**/state", lambda route: route.abort())
        mine.key("f", "o")
        alert = mine.page.get_by_role("alert")
        alert.get_by_role("button", name="Use mine").click()
        mine.saved()
        assert served.label(1) == TipLabel("out_of_view", None, "ana")


def test_a_tab_that_comes_back_shows_what_others_did(browser: Any, served: Served) -> None:
    with tab(browser) as page:
        hand = Hand(page).open(served.url)
        stamp = served.session.stamps_ns[0]
        served.session.book.change(stamp, 0, TipLabel("occluded", None, "ben"))
        page.evaluate("() => window.dispatchEvent(new Event('focus'))")
        page.locator("#state", has_text="occluded").wait_for()
        hand.key("o")
        hand.saved()
        assert served.label(0) == TipLabel("out_of_view", None, "ana")


class Program:
    """``tooltip label`` in a process of its own."""

    def __init__(self, path: Path) -> None:
        command = [sys.executable, "-m", "tooltip_cli.cli.main", "label", str(path)]
        self.process = subprocess.Popen(
            [*command, "--frames", "all", "--no-browser", "--labeler", "ana"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[1],
            env=os.environ,
        )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        assert self.url.startswith("http://127.0.0.1:"), self.process.communicate()

    def end(self, how: signal.Signals) -> tuple[int, str]:
        """End it; returns the exit code and what it said."""
        self.process.send_signal(how)
        _, said = self.process.communicate(timeout=30)
        return self.process.returncode, said


def test_nothing_is_lost_when_the_server_is_killed(wrist: Log, browser: Any) -> None:
    program = Program(wrist.path)
    journal = wrist.labels.with_name(wrist.labels.name + ".journal")
    with tab(browser, strict=False) as page:
        hand = Hand(page).open(program.url)
        hand.key("q", "f")
        hand.click(*hand.fitted((50, 50), SIZE))
        hand.saved()
        program.end(signal.SIGKILL)
        before = dict(rows_of(read_labels(wrist.labels)))
        assert set(before) == {stamp_of(0), stamp_of(1)}
        assert journal.exists()
        hand.key("ArrowRight")
        alert = page.get_by_role("alert")
        alert.get_by_text("The server does not answer").wait_for()
        assert "One change is not saved yet" in alert.inner_text()
        assert page.locator("#saved").inner_text() == "Not saved"
        hand.key("f", "q", "z")  # takes no more labels that would be lost
        assert hand.frame == "Frame 3 of 40"
        assert hand.state == "not labelled"
        assert hand.page.locator("#done").inner_text() == "2 of 40 labelled"
    program = Program(wrist.path)
    with tab(browser) as page:
        hand = Hand(page).open(program.url)
        assert hand.frame == "Frame 3 of 40"
        assert dict(rows_of(read_labels(wrist.labels))) == before
        hand.key("o")
        hand.saved()
    code, said = program.end(signal.SIGINT)
    assert code == 0, said
    assert "3 of 40 frames labelled" in said
    assert not journal.exists()


def test_what_waited_is_sent_once_the_server_answers(browser: Any, served: Served) -> None:
    with tab(browser, strict=False) as page:
        hand = Hand(page).open(served.url)
        page.route("**/label", lambda route: route.abort())
        hand.key("q")
        alert = page.get_by_role("alert")
        alert.get_by_text("does not answer").wait_for()
        assert served.rows == {}
        page.unroute("**/label")
        hand.saved()
        assert not alert.is_visible()
        assert served.label(0) == TipLabel("occluded", None, "ana")


# By keyboard alone, and for every eye.


def test_by_keyboard_alone(browser: Any, served: Served) -> None:
    with tab(browser) as page:
        hand = Hand(page).open(served.url)
        hand.key("ArrowLeft")
        assert "press Enter" in page.locator("#message").inner_text()
        hand.key("Enter", "Control+ArrowRight", "ArrowDown", "f")
        hand.saved()
        label = served.label(0)
        assert label is not None
        assert label.pixel == pytest.approx((79.5 + 10, 59.5 + 1), abs=0.1)
        hand.key("r", "+", "+", "Shift+ArrowRight", "f", "q", "f")
        hand.saved()
        assert served.label(2) == TipLabel("occluded", None, "ana")
        hand.key("?")
        dialog = page.get_by_role("dialog", name="Keys and mouse")
        assert dialog.is_visible()
        hand.key("q")
        hand.key("?")
        assert not dialog.is_visible()
        assert served.label(3) is None
        focused = "() => document.activeElement.textContent || document.activeElement.id"
        reached = []
        for _ in range(20):
            hand.key("Tab")
            reached.append(page.evaluate(focused))
        assert any(text.startswith("Out of view") for text in reached)
        assert any(text.startswith("Undo") for text in reached)
        page.locator("#strip [aria-current=true]").focus()
        hand.key("ArrowRight", "ArrowRight", "Enter")
        assert hand.frame == "Frame 6 of 40"
        assert page.evaluate("() => document.activeElement.id") == "view"
        page.get_by_role("button", name="Occluded", exact=True).focus()
        hand.key("Enter")
        hand.saved()
        assert served.label(5) == TipLabel("occluded", None, "ana")


def test_the_focus_is_seen(hand: Hand) -> None:
    for _ in range(4):
        hand.key("Tab")
        style = hand.page.evaluate(
            "() => { const style = getComputedStyle(document.activeElement);"
            " return [style.outlineStyle, parseFloat(style.outlineWidth)]; }"
        )
        assert style[0] != "none"
        assert style[1] >= 2


def test_what_a_screen_reader_is_told(hand: Hand) -> None:
    view = hand.page.get_by_role("application")
    assert view.get_attribute("aria-label") == "Frame 1 of 40, not labelled"
    hand.key("q")
    assert view.get_attribute("aria-label") == "Frame 1 of 40, occluded"
    assert hand.page.locator("#spoken").inner_text() == "occluded"
    hand.key("f")
    assert hand.page.locator("#spoken").inner_text() == "Frame 2 of 40, not labelled"
    for button in hand.page.get_by_role("button").all():
        name = button.get_attribute("aria-label") or button.inner_text()
        assert name.strip()


def test_the_browsers_own_keys_stay_its_own(hand: Hand, served: Served) -> None:
    hand.page.evaluate(
        "() => { window.kept = []; addEventListener('keydown', (event) => {"
        " if (event.defaultPrevented) window.kept.push(event.key); }); }"
    )
    hand.key("Control+d", "Alt+ArrowLeft", "Meta+o", "Control+q")
    assert hand.page.evaluate("() => window.kept") == []
    assert served.rows == {}


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("viewport", [LAPTOP, ZOOMED], ids=["laptop", "200 %"])
def test_everything_has_its_place(
    viewport: dict[str, int], scheme: str, browser: Any, served: Served
) -> None:
    ratio = 2 if viewport is ZOOMED else 1
    with tab(browser, viewport=viewport, device_scale_factor=ratio, color_scheme=scheme) as page:
        hand = Hand(page).open(served.url)
        hand.click(*hand.fitted((123.4, 111.2), SIZE))
        hand.saved()
        assert hand.state.startswith("visible at")
        inside = page.evaluate(
            "() => [...document.querySelectorAll('header *, aside button, #strip button')]"
            ".filter((item) => { const box = item.getBoundingClientRect();"
            " return item.scrollWidth > item.clientWidth + 1 && item.tagName === 'BUTTON'"
            " || box.right > innerWidth + 0.5 || box.left < 0; }).map((item) => item.outerHTML)"
        )
        assert inside == []
        assert page.evaluate("() => document.documentElement.scrollWidth") <= viewport["width"]
        assert hand.box[2] > 0.6 * viewport["width"]
        assert hand.box[3] > 0.6 * viewport["height"]
        page.locator("[data-action=hints]").scroll_into_view_if_needed()
        assert page.locator("[data-action=hints]").is_visible()
        for text, back in contrasts(page):
            assert text >= 4.5, back


def contrasts(page: Any) -> list[tuple[float, str]]:
    """Return the contrast of texts with what is behind them (WCAG 2.2, 1.4.3)."""
    rows = json.loads(
        page.evaluate(
            """() => JSON.stringify([...document.querySelectorAll(
                 'h1, #labeler, #frame, #state, #done, #saved, aside button, kbd, #cursor')]
               .filter((item) => item.getClientRects().length)
               .map((item) => {
                 let back = item;
                 while (getComputedStyle(back).backgroundColor === 'rgba(0, 0, 0, 0)'
                        && back !== document.body) back = back.parentElement;
                 return [item.id || item.textContent, getComputedStyle(item).color,
                         getComputedStyle(back).backgroundColor];
               }))"""
        )
    )
    return [(_contrast(front, back), name) for name, front, back in rows]


def _contrast(first: str, second: str) -> float:
    lights = []
    for color in (first, second):
        values = np.array([float(item) for item in re.findall(r"[\d.]+", color)[:3]]) / 255
        linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
        lights.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    low, high = sorted(lights)
    return (high + 0.05) / (low + 0.05)
