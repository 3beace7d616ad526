"""``tooltip label`` on the command line, and what a second labeller tells ``evaluate``."""

from __future__ import annotations

import builtins
import getpass
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.cli import tooltip
from tests.helpers.labelling import ask
from tests.helpers.logs import Log, stamp_of, true_pixels, write_true_labels
from tooltip_cli.labels.book import TipLabel, labels_of
from tooltip_cli.labels.files import write_labels
from tooltip_cli.labels.server import LabelServer
from tooltip_cli.stages.evaluate import evaluate


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let servers return at once; returns the addresses that were opened in the browser."""
    opened: list[str] = []
    monkeypatch.setattr(LabelServer, "run", lambda server: server._socket.close())
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setenv("DISPLAY", ":0")
    return opened


def test_it_prints_its_address_and_opens_it(wrist: Log, run: list[str]) -> None:
    done = tooltip("label", wrist.path, "--labeler", "ana")
    assert done.code == 0, done.err
    assert run == [done.out.strip()]
    assert done.out.startswith("http://127.0.0.1:")
    assert f"8 frames of {wrist.path}, into {wrist.labels}" in done.err
    assert f"{wrist.labels}: 0 of 8 frames labelled" in done.err
    assert not list(wrist.path.parent.glob("*.journal"))


def test_no_browser_is_started_in_the_terminal(
    wrist: Log, run: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert tooltip("label", wrist.path, "--no-browser").code == 0
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    done = tooltip("label", wrist.path)
    assert "no display was found" in done.err
    assert run == []


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ((), 8),
        (("--test", "400"), 20),
        (("--frames", "all"), 40),
        (("--frames", "7"), 7),
        (("--split", "blocks"), 8),
    ],
    ids=str,
)
def test_which_frames(options: tuple[str, ...], count: int, wrist: Log, run: list[str]) -> None:
    for arguments in (("label", wrist.path, *options), ("label", *options, wrist.path)):
        assert f"{count} frames of" in tooltip(*arguments).err


def test_a_number_of_frames_that_is_none(wrist: Log) -> None:
    for text in ("0", "some", "-1"):
        assert tooltip("label", wrist.path, f"--frames={text}").code == 2


def test_a_recording_that_is_called_like_a_command(
    wrist: Log, run: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wrist.path.rename(wrist.path.with_name("import"))
    monkeypatch.chdir(wrist.path.parent)
    assert tooltip("label", "import").code == 2
    for arguments in (("label", "./import"), ("label", "page", "import")):
        done = tooltip(*arguments)
        assert done.code == 0, done.err
        assert "8 frames of" in done.err


def test_results_can_go_elsewhere(wrist: Log, run: list[str], tmp_path: Path) -> None:
    done = tooltip("label", wrist.path, "--out", tmp_path / "new")
    assert str(tmp_path / "new" / "wrist.labels.csv") in done.err


def test_a_missing_extra_is_named(wrist: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "tooltip_cli.labels.server":
            raise ModuleNotFoundError("No module named 'uvicorn'", name="uvicorn")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    done = tooltip("label", wrist.path)
    assert done.code == 1
    assert "package 'uvicorn'" in done.error
    assert "tooltip-cli[label]" in done.error


def test_a_user_without_a_name(wrist: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    def nameless() -> str:
        raise OSError("No username set in the environment")

    monkeypatch.setattr(getpass, "getuser", nameless)
    assert "--labeler" in tooltip("label", wrist.path).error


def test_evaluate_reports_how_far_two_labellers_are_apart(wrist: Log) -> None:
    frames = [3, 7, 15, 22, 30, 36]
    write_true_labels(wrist.labels, frames)
    ours = true_pixels()[frames]
    # 3-4-5 triangles, and one frame in which the second sees nothing
    rows = {
        stamp_of(frame): TipLabel("visible", (u + 3, v + 4), "ben")
        for frame, (u, v) in zip(frames[1:], np.round(ours[1:], 2).tolist(), strict=True)
    }
    rows[stamp_of(frames[0])] = TipLabel("occluded", None, "ben")
    write_labels(wrist.path.with_name("wrist.labels.ben.csv"), labels_of(rows))
    report = evaluate([wrist.path])
    labels = report.recordings[0].labels
    assert labels is not None
    assert labels.second == "wrist.labels.ben.csv"
    assert labels.annotator_px is not None
    assert labels.annotator_px.mean == pytest.approx(5.0, abs=0.02)
    assert (labels.annotator_px.count, labels.disagreements) == (5, 1)
    said = "two labellers differ by 5.0 px on average over 5 frames, a floor for every error here"
    assert any(said in note for note in report.recordings[0].notes)
    shown = tooltip("evaluate", wrist.path)
    assert said in shown.err
    page = Path(report.page).read_text()
    assert "5.0 px" in page


def test_what_the_page_says_is_what_the_file_holds(wrist: Log) -> None:
    from tests.helpers.labelling import serving

    write_true_labels(wrist.labels, range(40))
    with serving(wrist.path) as served:
        root = "/" + served.url.split("/", 3)[3]
        for frame in ask(served.url, root + "state").document["frames"]:
            u, v = true_pixels()[frame["image"]]
            assert frame["label"]["u"] == pytest.approx(u, abs=0.006)
            assert frame["label"]["v"] == pytest.approx(v, abs=0.006)
            assert frame["label"]["labeler"] == "me"
