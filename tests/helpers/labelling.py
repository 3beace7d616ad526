"""A labelling server and its page, driven as a person would."""

from __future__ import annotations

import http.client
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

from tooltip_cli.labels.book import TipLabel, rows_of
from tooltip_cli.labels.files import read_labels
from tooltip_cli.labels.server import LabelServer
from tooltip_cli.labels.session import Session
from tooltip_cli.stages.label import Labeler, Selection, open_session

ALL = Selection(frames=0)
ANA = Labeler("ana")
PLACING = re.compile("Arrow|^Enter$|^r$")  # without the image the page does not place a point


@dataclass(frozen=True)
class Served:
    """A server in a thread of this process."""

    url: str
    session: Session

    @property
    def rows(self) -> dict[int, TipLabel]:
        """What the label file holds by now, by stamp."""
        path = self.session.book.path
        return dict(rows_of(read_labels(path))) if path.exists() else {}

    def label(self, place: int) -> TipLabel | None:
        """What the label file holds for a frame."""
        return self.rows.get(self.session.stamps_ns[place])


@contextmanager
def serving(
    path: Path, labeler: Labeler = ANA, selection: Selection | None = ALL, out: Path | None = None
) -> Iterator[Served]:
    """Serve a recording's labelling page."""
    with open_session(path, labeler, selection=selection, out=out) as session:
        server = LabelServer(session)
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        try:
            yield Served(server.url, session)
        finally:
            server.stop()
            thread.join(20)
        assert not thread.is_alive()


@dataclass(frozen=True)
class Answer:
    """What a server answered."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def document(self) -> Any:
        """The body as JSON."""
        return json.loads(self.body)


def ask(
    url: str,
    path: str,
    method: str = "GET",
    body: bytes | None = None,
    headers: dict[str, str] | None = None,
) -> Answer:
    """Send a request to a server, with exactly these headers beside Host; ``path`` is absolute."""
    host = urlsplit(url).netloc
    given = {"Host": host, **(headers or {})}
    connection = http.client.HTTPConnection(host, timeout=20)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in given.items():
            connection.putheader(name, value)
        if body is not None and "Transfer-Encoding" not in given:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders()
        if body is not None:
            connection.send(body)
        answer = connection.getresponse()
        return Answer(answer.status, dict(answer.getheaders()), answer.read())
    finally:
        connection.close()


@dataclass
class Hand:
    """A person at the page: every click, key and turn of the wheel is counted."""

    page: Any
    actions: int = 0
    box: tuple[float, float, float, float] = field(default=(0, 0, 0, 0))

    def open(self, url: str) -> Hand:
        """Open the page and wait for its first image."""
        self.page.goto(url)
        self.image_is_here()
        found = self.page.locator("#view").bounding_box()
        self.box = found["x"], found["y"], found["width"], found["height"]
        return self

    def image_is_here(self) -> None:
        """Wait for the frame's image."""
        self.page.locator("#badge").wait_for(state="hidden")

    def saved(self) -> None:
        """Wait until everything is saved."""
        self.page.locator("#saved", has_text=re.compile("^Saved$")).wait_for()

    def key(self, *names: str) -> None:
        """Press keys one after the other; those that place a point once the image is here."""
        for name in names:
            if PLACING.search(name):
                self.image_is_here()
            self.actions += 1
            self.page.keyboard.press(name)

    def click(self, x: float, y: float) -> None:
        """Click at a place of the page once the image is here."""
        self.image_is_here()
        self.actions += 1
        self.page.mouse.click(x, y)

    def wheel(self, x: float, y: float, turn: float) -> None:
        """Turn the wheel at a place of the page until the zoom changes; negative zooms in."""
        self.actions += 1
        before = self.zoom
        self.page.mouse.move(x, y)
        self.page.mouse.wheel(0, turn)
        while self.zoom == before:  # the wheel is not waited for
            self.page.wait_for_timeout(10)

    @property
    def zoom(self) -> float:
        """Screen pixels an image pixel, to two digits."""
        return float(self.page.locator("#zoom").inner_text().rstrip("×"))

    def fitted(self, pixel: npt.ArrayLike, size: tuple[int, int]) -> tuple[float, float]:
        """Return where on the page a pixel (u, v) lies while the whole image is shown."""
        x, y, width, height = self.box
        scale = min(width / size[0], height / size[1])
        middle = np.array([x + width / 2, y + height / 2])
        place = middle + (np.asarray(pixel) + 0.5 - np.array(size) / 2) * scale
        return float(place[0]), float(place[1])

    @property
    def state(self) -> str:
        """What the page says of the frame's label."""
        return str(self.page.locator("#state").inner_text())

    @property
    def frame(self) -> str:
        """Which frame the page shows."""
        return str(self.page.locator("#frame").inner_text())


def frame_times_ms(page: Any) -> list[float]:
    """Return how long each frame so far took from being asked for to being painted."""
    entries = "performance.getEntriesByName('shown').map(entry => entry.duration)"
    return [float(value) for value in page.evaluate(entries)]


def label_all(hand: Hand, served: Served, truth: dict[str, Any], pause_ms: float = 0) -> None:
    """Place the true pixel, or say that the tip is hidden, in every frame.

    Args:
        truth: ``stamps_ns``, ``uv`` and where it is known ``visible``, of every image.
    """
    known = {stamp: place for place, stamp in enumerate(truth["stamps_ns"])}
    places = [known[stamp] for stamp in served.session.stamps_ns]
    shown = truth.get("visible") or [True] * len(truth["stamps_ns"])
    size = served.session.size
    for place in places:
        hand.image_is_here()
        u, v = truth["uv"][place]
        inside = -0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5
        if shown[place] and inside:
            hand.click(*hand.fitted((u, v), size))
        else:
            hand.key("q")
        hand.saved()
        hand.page.wait_for_timeout(pause_ms)
        hand.key("f")
