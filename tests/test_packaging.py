"""What is installed: a wheel carries the message definitions and the rigs, and finds them."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from tooltip_cli.resources import resource

ROOT = Path(__file__).parents[1]
PROBE = """
import json
from tooltip_cli.log.messages import schema_text
from tooltip_cli.resources import resource
print(json.dumps({
    "schemas": str(resource("schemas")),
    "rig": str(resource("calib", "bench")),
    "text": schema_text("tooltip_msgs/msg/TipDetection"),
}))
"""


def data_files(*folders: str) -> set[str]:
    """Return the data files of the checkout, relative to it."""
    return {
        str(path.relative_to(ROOT))
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel with the build backend that is installed, without a network."""
    if find_spec("hatchling") is None:
        pytest.skip("hatchling is not installed, so no wheel can be built without a network")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_the_wheel_holds_the_code_and_every_data_file(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    wanted = {f"tooltip_cli/{name}" for name in data_files("schemas", "calib")}
    assert {name for name in wanted if name.endswith(".msg")}
    assert {name for name in wanted if name.startswith("tooltip_cli/calib/bench/")}
    assert wanted <= names
    code = {str(path.relative_to(ROOT)) for path in (ROOT / "tooltip_cli").rglob("*.py")}
    assert code <= names
    assert data_files("tooltip_cli/labels/page") <= names


def test_the_wheel_holds_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
        strays = [name for name in archive.namelist() if "__pycache__" in name or "/tests/" in name]
        assert archive.testzip() is None
    assert {top.split("-")[0] for top in tops} == {"tooltip_cli"}
    assert not strays


def test_the_wheel_names_its_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (entry,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
        assert "tooltip = tooltip_cli.cli.main:main" in archive.read(entry).decode()


def test_an_installed_wheel_finds_its_files(wheel: Path, tmp_path: Path) -> None:
    target = tmp_path / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*command, "--target", str(target), str(wheel)], check=True)
    # the target comes before the editable installation's path
    script = f"import sys; sys.path.insert(0, {str(target)!r})\n{PROBE}"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    found = json.loads(done.stdout)
    assert Path(found["schemas"]) == target / "tooltip_cli" / "schemas"
    assert Path(found["rig"]) == target / "tooltip_cli" / "calib" / "bench"
    assert "float64 weight" in found["text"]


def test_a_checkout_finds_its_files() -> None:
    assert resource("schemas") == ROOT / "schemas"
    assert resource("calib", "bench") == ROOT / "calib" / "bench"


def test_what_is_missing_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="schemas/nothing is missing from the installation"):
        resource("schemas", "nothing")
