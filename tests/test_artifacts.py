"""The cache: equal work is reused, changed work is done again, and exactly that."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.logs import Log, wrist_parts, write_log, write_true_labels
from tests.helpers.robot import CAMERA, RIG, SPHERES, TIP
from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.detections import read_detections, read_provenance
from tooltip_cli.log.recording import read_recording
from tooltip_cli.method.detector import DetectorParams
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.near import NearParams
from tooltip_cli.method.voting.params import MovingParams
from tooltip_cli.rig.rigfile import Rig, Sphere, rig_files
from tooltip_cli.stages.artifacts import (
    artifact_path,
    canonical,
    digest,
    ensure_directory,
    known_places,
    plain,
    read_json,
    stage_key,
    write_whole,
)
from tooltip_cli.stages.detect import detect
from tooltip_cli.stages.estimate import Estimated, estimate, estimate_from_document


@dataclass(frozen=True)
class Point:
    """Something that a stage may depend on."""

    x: float
    name: str = "p"


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4)
    ),
    max_leaves=8,
)


@settings(max_examples=100)
@given(value=VALUES)
def test_canonical_text_is_json_and_does_not_depend_on_order(value: Any) -> None:
    def reversed_mappings(item: Any) -> Any:
        if isinstance(item, dict):
            return {key: reversed_mappings(item[key]) for key in reversed(list(item))}
        return [reversed_mappings(part) for part in item] if isinstance(item, list) else item

    text = canonical(value)
    assert canonical(reversed_mappings(value)) == text
    assert canonical(json.loads(text)) == text


def test_values_are_taken_apart() -> None:
    value = {
        "point": Point(1.5),
        "array": np.array([[1, 2], [3, 4]]),
        "number": np.float64(0.1),
        "count": np.int64(3),
        "path": Path("a/b"),
        "pair": (1, 2),
        3: "key",
        "nothing": float("nan"),
        "endless": np.array([np.inf, 1.0]),
    }
    assert plain(value) == {
        "point": {"x": 1.5, "name": "p"},
        "array": [[1, 2], [3, 4]],
        "number": 0.1,
        "count": 3,
        "path": "a/b",
        "pair": [1, 2],
        "3": "key",
        "nothing": None,
        "endless": [None, 1.0],
    }


def test_keys_change_with_everything_that_they_stand_for() -> None:
    base: dict[str, Any] = {
        "stage": "s",
        "version": 1,
        "parents": {"a": "1"},
        "parameters": Point(0.1),
    }
    key = stage_key(**base)
    assert key == stage_key(**base)
    assert len(key) == 64
    others: list[dict[str, Any]] = [
        {"stage": "t"},
        {"version": 2},
        {"parents": {"a": "2"}},
        {"parents": {"b": "1"}},
        {"parents": {}},
        {"parameters": Point(0.1 + 1e-16 * 2)},
        {"parameters": Point(0.1, "q")},
    ]
    keys = {stage_key(**{**base, **change}) for change in others}
    assert len(keys | {key}) == len(others) + 1


def test_digests_tell_arrays_apart() -> None:
    arrays = [
        np.arange(6),
        np.arange(6).reshape(2, 3),
        np.arange(6).astype(float),
        np.arange(6)[::-1],
        np.zeros(0),
    ]
    assert len({digest(array) for array in arrays}) == len(arrays)
    assert digest(np.arange(12)[::2]) == digest(np.arange(0, 12, 2))
    assert digest(Point(1.0)) != digest(Point(2.0))


def test_places() -> None:
    recording = Path("/data/run.1.mcap")
    assert artifact_path(recording, ".tip.json", None) == Path("/data/run.1.tip.json")
    assert known_places(recording, ".x", Path("/out")) == [
        Path("/out/run.1.x"),
        Path("/data/run.1.x"),
    ]
    assert known_places(recording, ".x", Path("/data")) == [Path("/data/run.1.x")]


def test_files_are_whole_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "deep" / "a.json"
    write_whole(path, "first")
    write_whole(path, b"second")
    assert path.read_bytes() == b"second"

    def fail(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(TooltipError, match=r"a\.json: cannot be written \(No space left"):
        write_whole(path, "third")
    assert path.read_bytes() == b"second"
    assert [item.name for item in path.parent.iterdir()] == ["a.json"]


def test_directories_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TooltipError, match=r"file: cannot be created"):
        ensure_directory(tmp_path / "file")
    with pytest.raises(TooltipError, match="cannot be created"):
        write_whole(tmp_path / "file" / "a", "x")
    with pytest.raises(TooltipError, match="cannot be written"):
        write_whole(tmp_path / ("x" * 300), "x")


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_json_that_is_none(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(data)
    assert read_json(tmp_path / "a.json") is None
    assert read_json(tmp_path / "missing.json") is None
    assert read_json(tmp_path) is None


PAPER = EstimatorParams(method="kmeans")


def run(wrist: Log, **changes: Any) -> Estimated:
    return estimate(wrist.path, **{"params": PAPER, **changes})


def did(found: Estimated) -> tuple[bool, bool]:
    """Return whether detection and estimation were computed."""
    return (found.detected is not None and not found.detected.reused, not found.reused)


def test_a_second_run_reuses_both_stages(wrist: Log) -> None:
    first, second = run(wrist), run(wrist)
    assert did(first) == (True, True)
    assert did(second) == (False, False)
    assert first.document == second.document
    assert first.estimate.position is not None
    assert second.estimate.position is not None
    assert np.array_equal(first.estimate.position, second.estimate.position)
    assert np.linalg.norm(first.estimate.position - TIP) < 0.015


def test_detections_read_back_the_same(wrist: Log) -> None:
    first, second = detect(wrist.path), detect(wrist.path)
    assert (first.reused, second.reused) == (False, True)
    for field in dataclasses.fields(first.detections):
        one, two = getattr(first.detections, field.name), getattr(second.detections, field.name)
        if isinstance(one, tuple):
            assert one == two
        else:
            assert one.dtype.kind == two.dtype.kind
            assert np.array_equal(one, two, equal_nan=True), field.name


def test_the_number_of_threads_changes_nothing(wrist: Log, tmp_path: Path) -> None:
    one = detect(wrist.path, out=tmp_path / "one", jobs=1)
    many = detect(wrist.path, out=tmp_path / "many", jobs=4)
    assert np.array_equal(one.detections.pixels, many.detections.pixels, equal_nan=True)
    assert np.array_equal(one.detections.weights, many.detections.weights)
    assert one.key == many.key


def test_progress_is_told_for_every_pair(wrist: Log) -> None:
    told: list[int] = []
    detect(wrist.path, on_pair=lambda: told.append(1))
    assert len(told) == wrist.frames - 1
    detect(wrist.path, on_pair=lambda: told.append(1))
    assert len(told) == wrist.frames - 1


def other_value(value: Any) -> Any:
    if isinstance(value, str):
        return {"kmeans": "map"}.get(value, value + "x")
    return value + 2 if isinstance(value, int) else value * 1.1 + 0.001


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(DetectorParams)])
def test_every_parameter_of_the_detector_redoes_everything(name: str, wrist: Log) -> None:
    run(wrist)
    changed = replace(DetectorParams(), **{name: other_value(getattr(DetectorParams(), name))})
    assert did(run(wrist, detector=changed)) == (True, True)


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(EstimatorParams)])
def test_every_parameter_of_the_estimator_redoes_the_estimate_alone(name: str, wrist: Log) -> None:
    if name == "voting":
        pytest.skip("a method of its own, which the paper's do not depend on")
    run(wrist)
    changed = replace(PAPER, **{name: other_value(getattr(PAPER, name))})
    assert did(run(wrist, params=changed)) == (False, True)
    assert did(run(wrist, params=changed)) == (False, False)


RIG_CHANGES: dict[str, tuple[Rig, bool]] = {
    # what changes in the rig, and whether the estimate depends on it
    "geometry": (replace(RIG, urdf=str(RIG.urdf).replace("0.42", "0.43")), True),
    "spheres": (replace(RIG, spheres=(*SPHERES, Sphere((0.0, 0.0, 0.02), 0.01))), True),
    "time offset": (replace(RIG, time_offset_s=0.004), True),
    "a link's name": (replace(RIG, urdf=str(RIG.urdf).replace("finger", "digit")), False),
    "a far joint": (replace(RIG, urdf=str(RIG.urdf).replace('"grip"', '"grasp"')), False),
}


@pytest.mark.parametrize("case", RIG_CHANGES)
def test_editing_the_rig_never_redoes_detection_among_all_edges(
    case: str, wrist: Log, tmp_path: Path
) -> None:
    rig, depends = RIG_CHANGES[case]
    run(wrist, preset="paper")
    for name, text in rig_files(rig).items():
        (tmp_path / name).write_text(text)
    assert did(run(wrist, rig=tmp_path / "rig.yaml", preset="paper")) == (False, depends)


NEAR_CHANGES: dict[str, tuple[Rig, bool]] = {
    # what changes in the rig, and whether the hand is elsewhere in the images
    "the hand": (replace(RIG, urdf=str(RIG.urdf).replace("0.42", "0.47")), True),
    "time offset": (replace(RIG, time_offset_s=0.1), True),
    "the camera": (replace(RIG, camera=replace(CAMERA, cx=CAMERA.cx + 3)), True),
    "spheres": (replace(RIG, spheres=(*SPHERES, Sphere((0.0, 0.0, 0.02), 0.01))), False),
    "less than a pixel": (replace(RIG, urdf=str(RIG.urdf).replace("0.42", "0.4200001")), False),
}


@pytest.mark.parametrize("case", NEAR_CHANGES)
def test_detection_near_the_hand_is_redone_where_the_hand_moves_in_the_images(
    case: str, wrist: Log, tmp_path: Path
) -> None:
    rig, depends = NEAR_CHANGES[case]
    run(wrist)
    for name, text in rig_files(rig).items():
        (tmp_path / name).write_text(text)
    assert did(run(wrist, rig=tmp_path / "rig.yaml"))[0] == depends


def test_the_presets_take_detections_of_their_own(wrist: Log) -> None:
    near = run(wrist)
    everywhere = run(wrist, preset="paper")
    assert did(everywhere) == (True, True)
    assert everywhere.detected is not None
    assert everywhere.detected.key == detect(wrist.path).key  # which knows of no rig
    assert detect(wrist.path).reused
    again = run(wrist)
    assert did(again) == (True, True)
    assert again.key == near.key != everywhere.key
    assert detect(wrist.path, preset="voting").reused


def test_writing_the_same_rig_differently_redoes_nothing(wrist: Log, tmp_path: Path) -> None:
    run(wrist)
    for name, text in rig_files(RIG).items():
        (tmp_path / name).write_text(f"# a comment\n{text}" if name.endswith("yaml") else text)
    assert did(run(wrist, rig=tmp_path / "rig.yaml")) == (False, False)


def test_another_recording_under_the_same_name_redoes_everything(wrist: Log) -> None:
    run(wrist)
    wrist.path.unlink()
    write_log(wrist.path, wrist_parts(30))
    assert did(run(wrist)) == (True, True)


def test_force_redoes(wrist: Log) -> None:
    run(wrist)
    assert did(run(wrist, force=True)) == (False, True)
    assert not detect(wrist.path, force=True).reused


def test_new_labels_take_their_frames_out_of_the_estimate(wrist: Log) -> None:
    before = run(wrist)
    write_true_labels(wrist.labels, range(0, 40, 4))
    after = run(wrist)
    assert did(after) == (False, True)
    assert after.estimate.frames_used < before.estimate.frames_used
    assert did(run(wrist)) == (False, False)
    wrist.labels.unlink()
    assert did(run(wrist)) == (False, True)


def test_estimates_from_labels_depend_on_the_labels(wrist: Log, tmp_path: Path) -> None:
    labels = write_true_labels(tmp_path / "mine.csv", range(0, 40, 3))
    first = run(wrist, from_labels=labels)
    assert did(first) == (False, True)
    assert first.detected is None
    assert not list(tmp_path.glob("*.detections.mcap"))
    assert did(run(wrist, from_labels=labels)) == (False, False)
    text = labels.read_text().replace(",me", ",somebody else")
    labels.write_text(text)
    assert did(run(wrist, from_labels=labels)) == (False, False)
    write_true_labels(labels, range(0, 40, 2))
    assert did(run(wrist, from_labels=labels)) == (False, True)
    assert first.estimate.position is not None
    assert np.linalg.norm(first.estimate.position - TIP) < 0.001


def test_results_go_under_out_and_are_found_beside_the_recording(
    wrist: Log, tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "out"
    assert did(run(wrist, out=out)) == (True, True)
    assert sorted(path.name for path in out.iterdir()) == [
        "wrist.detections.mcap",
        "wrist.tip.json",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep", "wrist.mcap"]
    assert did(run(wrist)) == (True, True)  # a run without --out does not know that place
    elsewhere = run(wrist, out=tmp_path / "other")
    assert did(elsewhere) == (False, False)
    assert elsewhere.path.parent == tmp_path


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: b"",
        lambda data: data[:100],
        lambda data: data[: len(data) // 2],
        lambda data: data[:-5],
        lambda data: b"hello",
        lambda data: bytes([*data[:2000], data[2000] ^ 1, *data[2001:]]),
        lambda data: bytes([*data[:-60], data[-60] ^ 1, *data[-59:]]),
    ],
    ids=["empty", "start", "half", "without end", "text", "flipped", "flipped end"],
)
def test_damaged_detections_are_made_anew(spoil: Any, wrist: Log) -> None:
    found = run(wrist)
    assert found.detected is not None
    place = found.detected.path
    whole = place.read_bytes()
    place.write_bytes(spoil(whole))
    again = run(wrist)
    assert did(again) == (True, False)
    stamps = read_recording(wrist.path).image_stamps_ns
    assert len(read_detections(place, stamps).frames) == wrist.frames - 1


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: "",
        lambda text: text[:50],
        lambda text: "[]",
        lambda text: "3",
        lambda text: "null",
        lambda text: '{"provenance": 3}',
        lambda text: '{"provenance": {}}',
        lambda text: json.dumps({"provenance": json.loads(text)["provenance"]}),
        lambda text: text.replace('"candidates"', '"candidate"'),
        lambda text: text.replace('"frames_used": ', '"frames_used": "x", "x": '),
        lambda text: text.replace('"position_m": [', '"position_m": ["a", '),
        lambda text: text.replace('"covariance_m2"', '"covariance"'),
    ],
)
def test_damaged_estimates_are_made_anew(spoil: Any, wrist: Log) -> None:
    found = run(wrist)
    text = found.path.read_text()
    found.path.write_text(spoil(text))
    again = run(wrist)
    assert did(again) == (False, True)
    assert again.document["tip"] == found.document["tip"]


def test_detections_of_another_recording_are_refused(wrist: Log, tmp_path: Path) -> None:
    found = detect(wrist.path)
    shorter = read_recording(write_log(tmp_path / "b.mcap", wrist_parts(10)))
    with pytest.raises(TooltipError, match="holds detections of another recording"):
        read_detections(found.path, shorter.image_stamps_ns)
    with pytest.raises(TooltipError, match="holds detections of another recording"):
        read_detections(found.path, np.zeros(0, dtype=np.int64))


def test_provenance_says_where_a_result_comes_from(wrist: Log) -> None:
    found = run(wrist)
    recording = read_recording(wrist.path)
    assert found.detected is not None
    for origin, params in (
        (read_provenance(found.detected.path), NearParams(DetectorParams(), MovingParams())),
        (found.document["provenance"], {"method": "kmeans", "settings": PAPER}),
    ):
        assert origin is not None
        assert origin["recording"] == "wrist.mcap"
        assert origin["recording_sha256"] == recording.sha256
        assert origin["version"] == __version__
        assert origin["parameters"] == plain(params)
        assert origin["created"].endswith("+00:00")
    assert read_provenance(wrist.path) is None
    assert read_provenance(wrist.path.with_name("missing")) is None


def test_the_tip_file_is_the_contracts(wrist: Log) -> None:
    found = run(wrist)
    document = json.loads(found.path.read_text())
    assert document == found.document
    assert list(document) == [
        "status",
        "tip",
        "candidates",
        "reasons",
        "method",
        "frames_used",
        "provenance",
    ]
    assert document["status"] == "ok"
    assert document["tip"]["frame"] == "hand"
    assert np.array(document["tip"]["position_m"]).shape == (3,)
    assert np.array(document["tip"]["covariance_m2"]).shape == (3, 3)
    assert {"position_m", "support"} == set(document["candidates"][0])
    back = estimate_from_document(document, found.path)
    assert back.position is not None
    assert found.estimate.position is not None
    assert np.array_equal(back.position, found.estimate.position)
    assert back.frames_used == found.estimate.frames_used


def test_a_refusal_is_written_with_reasons_and_no_position(wrist: Log, tmp_path: Path) -> None:
    labels = write_true_labels(tmp_path / "few.csv", [3])
    found = run(wrist, from_labels=labels)
    document = json.loads(found.path.read_text())
    assert document["status"] == "refused"
    assert document["tip"] is None
    assert document["reasons"][0]["code"] == "too_few_views"
    assert set(document["reasons"][0]) == {"code", "text"}
    again = run(wrist, from_labels=labels)
    assert again.reused
    assert again.estimate == found.estimate


def test_no_document_is_no_estimate() -> None:
    with pytest.raises(TooltipError, match=r"x\.tip\.json is not a tip file"):
        estimate_from_document({"tip": 3}, Path("x.tip.json"))


def test_images_whose_pose_is_unknown_are_noted(wrist: Log) -> None:
    wrist.path.unlink()
    parts = wrist_parts(20)
    parts["joints"] = parts["joints"][:60]
    write_log(wrist.path, parts)
    (note,) = run(wrist).notes
    assert "the hand's pose is unknown at" in note
    assert "of 20 images, which are left out" in note
