"""Fixtures that several test modules share."""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.logs import FRAMES, Log, wrist_parts, write_log

# A shell starts what runs in the background with SIGINT ignored, and so all that this would start.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

REFERENCE = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def wrist_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of the wrist that nobody may change or write beside."""
    return write_log(tmp_path_factory.mktemp("wrist") / "wrist.mcap", wrist_parts())


@pytest.fixture
def wrist(wrist_file: Path, tmp_path: Path) -> Log:
    """Return a recording of the wrist in a directory of the test's own."""
    return Log(Path(shutil.copy(wrist_file, tmp_path / "wrist.mcap")), FRAMES)


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Return the folder of reference data; it lies beside the repository, never in it."""
    if not REFERENCE.is_dir():
        pytest.skip(f"the reference data is not at {REFERENCE}")
    return REFERENCE


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Yield a headless Chromium: Debian's, or the one that playwright installs."""
    api = pytest.importorskip("playwright.sync_api", reason="needs: pip install playwright")
    with api.sync_playwright() as playwright:
        try:
            opened = playwright.chromium.launch(
                executable_path=shutil.which("chromium"),
                args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"],
            )
        except api.Error as error:
            pytest.skip(f"needs a Chromium, e.g. apt-get install chromium ({error})")
        yield opened
        opened.close()
