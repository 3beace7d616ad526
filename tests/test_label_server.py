"""The labelling server: serves its own page what it may have, and refuses everything else."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from tests.helpers.labelling import ANA, Answer, Served, ask, serving
from tests.helpers.logs import (
    FRAME_NS,
    IMAGE_TOPIC,
    Log,
    decoded,
    image_of,
    jpeg_of,
    stamp_of,
    wrist_parts,
    write_log,
    write_true_labels,
)
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.book import TipLabel
from tooltip_cli.labels.guard import MAX_BODY_BYTES
from tooltip_cli.labels.server import LabelServer, listen
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.stages.label import Labeler, Selection, open_session


@pytest.fixture
def served(wrist: Log) -> Iterator[Served]:
    with serving(wrist.path) as found:
        yield found


def root(served: Served) -> str:
    return urlsplit(served.url).path


def origin(served: Served) -> str:
    return served.url[: -len(root(served))]


def change(served: Served, **changes: Any) -> dict[str, Any]:
    label = {"state": "visible", "u": 12.5, "v": 30.25}
    document = {
        "recording": served.session.recording.sha256,
        "stamp_ns": str(stamp_of(3)),
        "revision": 0,
        "label": label,
    }
    return {**document, **changes}


def post(served: Served, document: Any, **headers: str | None) -> Answer:
    given = {"Origin": origin(served), "Content-Type": "application/json"}
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    sent = {name: value for name, value in {**given, **named}.items() if value is not None}
    body = document if isinstance(document, bytes) else json.dumps(document).encode()
    return ask(served.url, root(served) + "label", "POST", body, sent)


def test_a_change_is_saved_and_answered(served: Served) -> None:
    answer = post(served, change(served))
    assert answer.status == 200
    label = {"state": "visible", "u": 12.5, "v": 30.25, "labeler": "ana"}
    assert answer.document == {"revision": 1, "label": label}
    assert served.label(3) == TipLabel("visible", (12.5, 30.25), "ana")
    state = ask(served.url, root(served) + "state").document
    assert state["frames"][3]["label"] == label
    hidden = post(served, change(served, revision=1, label={"state": "out_of_view"}))
    assert hidden.document["label"]["u"] is None
    assert post(served, change(served, revision=2, label=None)).document["label"] is None
    assert served.rows == {}


def test_the_state_is_all_that_the_page_needs(served: Served) -> None:
    state = ask(served.url, root(served) + "state").document
    assert state["name"] == "wrist"
    assert state["file"] == "wrist.labels.csv"
    assert (state["width"], state["height"], state["images"]) == (160, 120, 40)
    assert [frame["image"] for frame in state["frames"]] == list(range(40))
    assert state["frames"][7]["stamp_ns"] == str(stamp_of(7))


def test_images_pass_byte_for_byte(served: Served) -> None:
    for frame in (0, 17, 39):
        answer = ask(served.url, f"{root(served)}image/{frame}")
        assert answer.headers["content-type"] == "image/jpeg"
        assert answer.body == jpeg_of(frame)


def test_a_recording_that_vanishes_is_said(served: Served) -> None:
    served.session.recording.path.unlink()
    answer = ask(served.url, f"{root(served)}image/0")
    assert answer.status == 500
    assert "cannot be read any more" in answer.document["error"]


def test_raw_images_become_png(tmp_path: Path) -> None:
    parts = wrist_parts(3)
    parts["images"] = [raw_image(frame) for frame in range(3)]
    path = write_log(tmp_path / "raw.mcap", parts)
    with serving(path) as served:
        answer = ask(served.url, f"{root(served)}image/1")
    assert answer.headers["content-type"] == "image/png"
    assert np.array_equal(decoded(answer.body), image_of(1))


def raw_image(frame: int) -> Message:
    height, width = image_of(frame).shape
    fields = {
        "header": messages.header(stamp_of(frame), "camera"),
        "height": height,
        "width": width,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": width,
        "data": image_of(frame).tobytes(),
    }
    payload = messages.encode(messages.IMAGE, fields)
    return Message(IMAGE_TOPIC, messages.IMAGE, stamp_of(frame), payload)


def test_only_frames_to_label_and_their_neighbours_are_served(wrist: Log) -> None:
    with serving(wrist.path, selection=None) as served:
        chosen = served.session.frames.tolist()
        assert len(chosen) == 8
        near = {frame + step for frame in chosen for step in (-1, 0, 1)} & set(range(40))
        for frame in range(40):
            status = ask(served.url, f"{root(served)}image/{frame}").status
            assert status == (200 if frame in near else 404)


def test_it_listens_on_loopback_only(served: Served) -> None:
    port = urlsplit(served.url).port or 0
    outside = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), port)}
    for address in outside - {"127.0.0.1", "127.0.1.1", "::1"}:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((str(address), port), timeout=2).close()
    with listen(0) as listening:
        assert listening.getsockname()[0] == "127.0.0.1"


def test_a_taken_port_is_said(wrist: Log) -> None:
    with listen(0) as listening:
        port = listening.getsockname()[1]
        with (
            open_session(wrist.path, ANA) as session,
            pytest.raises(TooltipError, match=f"port {port} cannot be opened .*--port"),
        ):
            LabelServer(session, port)


def test_every_answer_carries_the_policy(served: Served) -> None:
    for path, status in (("", 200), ("state", 200), ("image/1", 200), ("nothing", 404)):
        answer = ask(served.url, root(served) + path)
        assert answer.status == status
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cache-control"] == "no-store"
        assert "server" not in answer.headers


def test_the_page_holds_nothing_that_the_policy_forbids() -> None:
    folder = resources.files("tooltip_cli.labels") / "page"
    page = (folder / "index.html").read_text()
    assert not re.search(r"<script>|<style|\sstyle=|\son\w+=", page)
    for file in folder.iterdir():
        text = file.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "://" not in text
        assert not re.search(r"\beval\(|innerHTML|insertAdjacentHTML|document\.write", text)


def test_every_asset_is_served(served: Served) -> None:
    folder = resources.files("tooltip_cli.labels") / "page"
    for file in folder.iterdir():
        name = "" if file.name == "index.html" else file.name
        answer = ask(served.url, root(served) + name)
        assert (answer.status, answer.body) == (200, file.read_bytes()), file.name


# Who may talk to it.


@pytest.mark.parametrize("path", ["/", "/state", "/label.css", "/wrong/state", "//state", "/%2e/"])
def test_a_wrong_token_finds_nothing(path: str, served: Served) -> None:
    answer = ask(served.url, path)
    assert answer.status == 404
    assert b"wrist" not in answer.body


def test_a_token_that_is_nearly_right_finds_nothing(served: Served) -> None:
    token = root(served).strip("/")
    assert len(token) >= 32
    for wrong in (token[:-1], token + "A", token.swapcase(), ""):
        assert ask(served.url, f"/{wrong}/state").status == 404


def test_tokens_differ(wrist: Log) -> None:
    with open_session(wrist.path, ANA) as session:
        urls = {urlsplit(LabelServer(session).url).path for _ in range(5)}
    assert len(urls) == 5


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "[::1]:{port}", ""]
)
def test_another_host_is_refused(host: str, served: Served) -> None:
    port = urlsplit(served.url).port
    answer = ask(served.url, root(served) + "state", headers={"Host": host.format(port=port)})
    assert answer.status in (400, 403)  # an empty one is no HTTP
    assert b"frames" not in answer.body


def test_localhost_is_this_machine_too(served: Served) -> None:
    host = f"localhost:{urlsplit(served.url).port}"
    assert ask(served.url, root(served) + "state", headers={"Host": host}).status == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": None},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
    ids=str,
)
def test_a_change_from_another_site_is_refused(
    headers: dict[str, str | None], served: Served
) -> None:
    assert post(served, change(served), **headers).status == 403
    assert served.rows == {}


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", None])
def test_what_a_form_could_send_is_refused(kind: str | None, served: Served) -> None:
    assert post(served, change(served), Content_Type=kind).status == 415
    assert served.rows == {}


def test_another_site_cannot_read(served: Served) -> None:
    for name, value in (("Origin", "https://evil.example"), ("Sec-Fetch-Site", "cross-site")):
        answer = ask(served.url, root(served) + "state", headers={name: value})
        assert answer.status == 403
        assert "access-control-allow-origin" not in answer.headers


# What may be asked for.


@pytest.mark.parametrize(
    "path",
    [
        "../label.css",
        "..%2f..%2fguard.py",
        "%2e%2e/%2e%2e/etc/passwd",
        "image/../../../../etc/passwd",
        "image/..%2f..%2fwrist.mcap",
        "image/-1",
        "image/40",
        "image/1e1",
        "image/%D9%A3",
        "image/" + "9" * 400,
        "image/1/2",
        "wrist.mcap",
        "main.js%00.css",
        "page/main.js",
    ],
)
def test_no_path_leads_to_a_file(path: str, served: Served) -> None:
    answer = ask(served.url, root(served) + path)
    assert answer.status in (400, 404)
    assert b"root:" not in answer.body


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_other_methods_do_nothing(method: str, served: Served) -> None:
    answer = ask(served.url, root(served) + "label", method, headers={"Origin": origin(served)})
    assert answer.status in (404, 405)
    assert served.rows == {}


def test_a_body_that_is_too_large_is_refused(served: Served) -> None:
    padded = json.dumps(change(served)).encode().ljust(MAX_BODY_BYTES + 1)
    assert post(served, padded).status == 413
    assert post(served, change(served), Content_Length="99999999999").status in (400, 413)
    chunked = post(served, b"5\r\n     \r\n0\r\n\r\n", Transfer_Encoding="chunked")
    assert chunked.status == 411
    assert served.rows == {}
    assert post(served, padded[:MAX_BODY_BYTES]).status == 200


def test_a_header_that_is_too_large_is_refused(served: Served) -> None:
    try:
        answer = ask(served.url, root(served) + "state", headers={"X-Padding": "x" * 1_000_000})
    except ConnectionError:  # it was hung up on while it was still sending
        return
    assert answer.status == 400


def test_a_label_of_another_recording_is_refused(served: Served) -> None:
    answer = post(served, change(served, recording="0" * 64))
    assert answer.status == 422
    assert "another recording" in answer.document["error"]
    wrong = post(served, change(served, stamp_ns=str(stamp_of(3) + FRAME_NS // 2)))
    assert wrong.status == 422
    assert "no frame to label has the stamp" in wrong.document["error"]
    assert served.rows == {}


@pytest.mark.parametrize(
    "document",
    [
        {"label": {"state": "visible"}},
        {"label": {"state": "visible", "u": "1", "v": 2}},
        {"label": {"state": "visible", "u": True, "v": 2}},
        {"label": {"state": "visible", "u": float("nan"), "v": 2}},
        {"label": {"state": "visible", "u": 10**400, "v": 2}},
        {"label": {"state": "visible", "u": -0.6, "v": 2}},
        {"label": {"state": "visible", "u": 1, "v": 119.6}},
        {"label": {"state": "gone"}},
        {"label": {"state": ["visible"]}},
        {"label": []},
        {"stamp_ns": stamp_of(3)},
        {"stamp_ns": ["x"]},
        {"revision": "0"},
        {"revision": 1.5},
    ],
    ids=str,
)
def test_what_is_no_label_is_refused(document: dict[str, Any], served: Served) -> None:
    answer = post(served, change(served, **document))
    assert answer.status == 422
    assert answer.document["error"]
    assert served.rows == {}


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b"null", b"\xff", b"[" * 4000])
def test_what_is_no_change_is_refused(body: bytes, served: Served) -> None:
    assert post(served, body).status == 422


def test_an_old_revision_is_a_conflict(served: Served) -> None:
    assert post(served, change(served)).status == 200
    other = change(served, label={"state": "occluded"})
    answer = post(served, other)
    assert answer.status == 409
    assert answer.document["label"]["u"] == 12.5
    assert post(served, {**other, "revision": answer.document["revision"]}).status == 200


def test_a_label_file_that_breaks_is_said(served: Served) -> None:
    served.session.book.path.write_text("broken\n")
    answer = post(served, change(served))
    assert answer.status == 500
    assert "expected the header" in answer.document["error"]
    assert served.session.book.path.read_text() == "broken\n"


# Which frames, whose labels, and what may be shown.


def test_it_shows_the_test_frames_of_the_split(wrist: Log) -> None:
    from tooltip_cli.method.evaluation import split_frames

    with open_session(wrist.path, ANA) as session:
        assert session.frames.tolist() == split_frames(40).test.tolist()
    with open_session(wrist.path, ANA, selection=Selection(test=10, seed=3)) as session:
        assert session.frames.tolist() == split_frames(40, test=10, seed=3).test.tolist()
    with open_session(wrist.path, ANA, selection=Selection(frames=5)) as session:
        assert session.frames.tolist() == [0, 10, 20, 29, 39]


def test_a_blind_labeller_gets_the_same_frames_and_nothing_else(wrist: Log) -> None:
    write_true_labels(wrist.labels, [2, 3, 30])
    with serving(wrist.path, Labeler("ben", blind=True), None) as served:
        state = ask(served.url, root(served) + "state").document
        assert state["file"] == "wrist.labels.ben.csv"
        assert [frame["image"] for frame in state["frames"]] == [2, 3, 30]
        assert all(frame["label"] is None for frame in state["frames"])
        assert not state["hints"]
        assert ask(served.url, root(served) + "hints").status == 403
        assert post(served, change(served)).document["label"]["labeler"] == "ben"
        assert wrist.labels.read_text().count("ben") == 0


def test_labels_of_other_frames_are_kept(wrist: Log) -> None:
    with open_session(wrist.path, ANA) as session:
        other = next(frame for frame in range(40) if frame not in session.frames)
    write_true_labels(wrist.labels, [other])
    with serving(wrist.path, selection=None) as served:
        shown = str(served.session.stamps_ns[0])
        assert post(served, change(served, stamp_ns=shown)).status == 200
        assert set(served.rows) == {stamp_of(other), int(shown)}


def test_labels_of_another_recording_are_not_opened(wrist: Log, tmp_path: Path) -> None:
    wrist.labels.write_text("stamp_ns,u,v,state,labeler\n12,1.00,2.00,visible,me\n")
    with pytest.raises(TooltipError, match="another recording"), open_session(wrist.path, ANA):
        pass
    assert not list(tmp_path.glob("*.journal"))


@pytest.mark.parametrize("name", ["../up", "a/b", "", "-x", ".", "x" * 65, "a\nb"])
def test_a_name_that_is_no_file_name_is_refused(name: str, wrist: Log) -> None:
    with (
        pytest.raises(TooltipError, match="--labeler"),
        open_session(wrist.path, Labeler(name, blind=True)),
    ):
        pass


def test_hints_are_what_the_stages_found(wrist: Log) -> None:
    from tooltip_cli.stages.detect import detect
    from tooltip_cli.stages.estimate import estimate

    with serving(wrist.path) as served:
        empty = ask(served.url, root(served) + "hints").document
        assert not empty["detections"]
        assert "tooltip detect wrist.mcap" in empty["notes"][0]
        assert "tooltip estimate wrist.mcap" in empty["notes"][1]
        found = detect(wrist.path).detections
        write_true_labels(wrist.labels.with_name("all.csv"), range(40))
        tip = estimate(wrist.path, from_labels=wrist.labels.with_name("all.csv"))
        assert tip.estimate.position is not None
        hints = ask(served.url, root(served) + "hints").document
    assert len(hints["detections"]) == int(found.valid.sum())
    assert hints["notes"] == []
    from tests.helpers.logs import true_pixels

    predicted = np.array([hints["predictions"][str(frame)] for frame in range(40)])
    assert np.abs(predicted - true_pixels()).max() < 0.5
