"""The documentation says what is so: commands run, links lead somewhere, tables are current."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import json
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest
import yaml

from tests.helpers.cli import tooltip
from tests.helpers.logs import Log, wrist_parts, write_log, write_true_labels
from tests.helpers.robot import CAMERA, URDF
from tests.test_source_bag import stream, write_ros2
from tests.test_source_lerobot import write_v2
from tests.test_source_video import JOINTS, write_video
from tooltip_cli.cli.main import main
from tooltip_cli.labels.files import COLUMNS, STATES, read_labels
from tooltip_cli.log.messages import MOVING_EDGES, SILHOUETTE, TIP_DETECTION, definition
from tooltip_cli.method import detector
from tooltip_cli.method.evaluation import split_frames
from tooltip_cli.method.voting.params import MovingParams, PairingParams, TrustParams
from tooltip_cli.report.model import EvaluationReport
from tooltip_cli.rig.camera import camera_yaml
from tooltip_cli.rig.rigfile import parse_rig
from tooltip_cli.stages.estimate import estimate

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *DOCS.glob("*.md"),
        *ROOT.glob("calib/*/*.md"),
        *(page for page in ROOT.glob("tests/**/*.md") if "node_modules" not in page.parts),
    ]
)
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
SLOW = ("tooltip demo", "tooltip record sim")  # tested elsewhere


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def script(name: str) -> ModuleType:
    """Return a script of the documentation as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the fenced blocks of a page that are in one of some languages."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [text for language, text in found if language in languages]


def commands_in(text: str) -> list[str]:
    """Return the lines of a block that call the program."""
    lines = (line.partition("  #")[0].strip() for line in text.splitlines())
    return [line for line in lines if line.startswith("tooltip ")]


def every_command() -> Iterator[tuple[str, click.Command, click.Context]]:
    yield from script("make_cli_reference").commands(main, "tooltip")


def shown_commands() -> list[str]:
    """Return every call of the program that help or documentation shows, each once."""
    shown = {
        line
        for page in PAGES
        if page.name != "cli.md"
        for text in blocks(page, "", "sh", "console")
        for line in commands_in(text)
    }
    for _, command, _ in every_command():
        shown.update(commands_in(command.help or ""))
    return sorted(shown)


def parse(words: list[str]) -> None:
    """Let click read a call without carrying it out."""
    context = click.Context(main, help_option_names=["-h", "--help"])
    command: click.Command = main
    while isinstance(command, click.Group):
        _, found, words = command.resolve_command(context, words)
        assert found is not None
        command = found
    command.make_context(command.name, words, parent=context)


@pytest.mark.parametrize("line", shown_commands())
def test_every_command_that_is_shown_is_read_without_complaint(line: str) -> None:
    parse(shlex.split(line)[1:])


def test_every_command_has_an_example_of_itself() -> None:
    for path, command, _ in every_command():
        if path != "tooltip":
            starts = [line for line in commands_in(command.help or "") if line.startswith(path)]
            assert starts, f"{path} --help shows no example"


def test_the_command_reference_is_current() -> None:
    assert read("docs/cli.md") == script("make_cli_reference").page(), "run make docs"


def test_the_parameter_tables_are_current() -> None:
    text = read("docs/paper-to-code.md")
    assert text == script("make_parameter_tables").page(text), "run make docs"


def test_the_parameter_tables_hold_every_parameter() -> None:
    text = script("make_parameter_tables").tables()
    for field in dataclasses.fields(detector.DetectorParams):
        assert f"| `{field.name}` | {field.default!r} |" in text
    assert "| `tau` | 200.0 | 3.1, footnote 1 | grey levels |" in text
    assert "| `canny_low` | 50.0 | no |" in text


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with everything that the documented commands name."""
    folder = tmp_path_factory.mktemp("desk")
    write_log(folder / "pliers.mcap", wrist_parts())
    write_true_labels(folder / "pliers.labels.csv", split_frames(40).test)
    write_ros2(folder / "rosbag2_folder", stream())
    write_v2(folder / "dataset")
    write_video(folder / "pliers.mp4", range(0, 50, 10))
    (folder / "joints.csv").write_text(JOINTS)
    (folder / "robot.urdf").write_text(URDF)
    (folder / "camera.yaml").write_text(camera_yaml(CAMERA))
    (folder / "rig.yaml").write_text(readme_rig())
    return folder


def readme_rig() -> str:
    (text,) = blocks(ROOT / "README.md", "yaml")
    return text


def scripts() -> list[Any]:
    """Return the shell blocks of every page that call the program."""
    return [
        pytest.param(text, id=f"{page_name(page)}-{number}")
        for page in PAGES
        for number, text in enumerate(blocks(page, "sh"))
        if any(not line.startswith(SLOW) for line in commands_in(text))
    ]


@pytest.mark.parametrize("text", scripts())
def test_documented_commands_run(
    text: str, desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(desk, tmp_path / "desk")
    monkeypatch.chdir(folder)
    for line in commands_in(text):
        if line.startswith(SLOW):
            continue
        words = shlex.split(line)[1:]
        if words[0] == "record":
            Path("pliers.mcap").unlink()
        done = tooltip(*words)
        # a picture of 160x120 pixels may be refused, and that is a right answer
        assert done.code in ((0,) if words[0] == "record" else (0, 3)), done.err
        assert done.out


def test_the_readmes_rig_is_the_wrists(desk: Path) -> None:
    rig = parse_rig(readme_rig(), lambda name: (desk / name).read_text(), "README.md")
    assert rig.camera == CAMERA
    assert rig.urdf == URDF


def test_the_documented_rig_names_every_key() -> None:
    texts = blocks(DOCS / "file-formats.md", "yaml")
    known = {"robot": URDF, "camera.yaml": camera_yaml(CAMERA), "robot.urdf": URDF}
    parse_rig(texts[0], lambda name: known[name], "file-formats.md")
    document = yaml.safe_load(texts[0])
    assert set(document) == {"robot", "camera", "hand", "joints", "time_offset"}
    assert set(document["camera"]) == {"frame", "info", "mount"}
    assert set(document["hand"]) == {"frame", "pose_topic", "spheres"}


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_lead_somewhere(page: Path) -> None:
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    for target in LINK.findall(text):
        assert "://" not in target, f"{target} needs a network"
        name, _, anchor = target.partition("#")
        linked = page.parent / name if name else page
        assert linked.exists(), target
        if anchor:
            assert anchor in anchors(linked), target


def anchors(page: Path) -> set[str]:
    """Return what a page's headings are linked by."""
    titles = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text()), re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", title.lower()) for title in titles]
    return {title.strip().replace(" ", "-") for title in plain}


def defined_in(path: Path) -> set[str]:
    """Return the names that a module defines at its top."""
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names.update(ast.unparse(target) for target in targets)
    return names


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_named_functions_and_tests_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name, place in re.findall(r"\[`(\w+)`\]\(([^)]+\.py)\)", text):
        assert name in defined_in(page.parent / place), f"{name} is not in {place}"
    for place, name in re.findall(r"`(tests/\w+\.py)::(\w+)`", text):
        assert name in defined_in(ROOT / place), f"{name} is not in {place}"


def test_the_tables_of_the_paper_name_functions_and_tests() -> None:
    text = read("docs/paper-to-code.md")
    assert len(re.findall(r"\[`\w+`\]\([^)]+\.py\)", text)) > 30
    assert len(re.findall(r"`tests/\w+\.py::\w+`", text)) > 30


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_named_targets_of_make_exist(page: Path) -> None:
    targets = set(re.findall(r"^(\w+):", read("Makefile"), re.MULTILINE))
    text = page.read_text(encoding="utf-8")
    for call in re.findall(r"(?:^|`)make ((?:[A-Z]+=\S+ )*)(\w+)", text, re.MULTILINE):
        assert call[1] in targets, call


def test_message_definitions_are_shown_as_they_are() -> None:
    shown = blocks(DOCS / "file-formats.md", "text")
    types = (TIP_DETECTION, MOVING_EDGES, SILHOUETTE)
    assert shown == [definition(datatype) for datatype in types]


def test_flags_and_codes_are_explained() -> None:
    text = read("docs/file-formats.md")
    for flag in (detector.FEW_EDGES, detector.SINGULAR, detector.NO_MOTION):
        assert f"`{flag}`" in text
    codes: set[str] = set()
    for module in (ROOT / "tooltip_cli").rglob("*.py"):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Reason":
                first = node.args[0]
                codes |= {str(first.value)} if isinstance(first, ast.Constant) else set()
    assert len(codes) > 5
    for code in codes - {"failed"}:  # a row of a report, not of an estimate
        assert f"| `{code}` |" in text, f"{code} is not explained"


def test_documented_labels_are_labels(tmp_path: Path) -> None:
    (text,) = blocks(DOCS / "file-formats.md", "csv")
    (tmp_path / "x.labels.csv").write_text(text)
    assert read_labels(tmp_path / "x.labels.csv").states == ("visible", "occluded")
    page = read("docs/file-formats.md")
    for word in (*COLUMNS, *STATES):
        assert f"`{word}`" in page


def test_the_documented_tip_file_has_the_keys_of_a_real_one(wrist: Log) -> None:
    (text,) = blocks(DOCS / "file-formats.md", "json")
    shown = json.loads(text)
    write_true_labels(wrist.labels, range(wrist.frames))
    real = estimate(wrist.path, from_labels=wrist.labels).document
    assert real["status"] == "ok"
    assert list(shown) == list(real)
    assert list(shown["tip"]) == list(real["tip"])
    assert set(shown["candidates"][0]) <= set(real["candidates"][0])
    assert set(shown["provenance"]) == set(real["provenance"])
    page = read("docs/file-formats.md")
    for key in (*real, *real["candidates"][0]):
        assert f"`{key}`" in page


def test_the_report_is_described() -> None:
    page = read("docs/file-formats.md")
    for field in dataclasses.fields(EvaluationReport):
        assert f"`{field.name}`" in page


def test_the_limits_are_those_of_the_code() -> None:
    text = " ".join(read("README.md").split())
    trust = TrustParams()
    assert f"about {trust.min_frames} images" in text
    assert f"{trust.min_view_angle_deg:.0f} degrees apart" in text
    assert f"less than about {PairingParams().fastest_px:.0f} pixels" in text
    assert f"searches to {MovingParams().reach} m" in text


def test_the_picture_is_small() -> None:
    picture = DOCS / "images" / "result.png"
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert picture.stat().st_size < 200_000
