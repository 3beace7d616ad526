"""Importing LeRobot data sets: small real ones of every layout, and four real episodes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.rigfile import Rig, load_rig
from tooltip_cli.sources.lerobot import LeRobotSource
from tooltip_cli.sources.streams import EPOCH_NS, read_urdf
from tooltip_cli.stages.record import Recorded, record

CAMERA, STATE = "observation.images.top", "observation.state"
FPS, WIDTH, HEIGHT = 10, 96, 64
NAMES = ["shoulder", "elbow", "wrist"]
ROOT = Path(__file__).parents[1]
G1 = ROOT / ".." / "shared" / "data" / "g1"
needs_g1 = pytest.mark.skipif(not G1.is_dir(), reason="../shared/data/g1 is not here")


def level(index: int) -> int:
    """Return the grey level of frame ``index``: what identifies it after two lossy codecs."""
    return 20 + 10 * (index % 20)


def picture(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.full((HEIGHT, WIDTH, 3), level(index), dtype=np.uint8)


def write_video(path: Path, indices: Sequence[int], codec: str = "libx264") -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this build of PyAV cannot encode with {codec}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = Fraction(1, FPS)
        if codec == "mpeg4":
            stream.bit_rate = 4_000_000
        for place, index in enumerate(indices):
            frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
            frame.pts, frame.time_base = place, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def state(episode: int, row: int) -> list[float]:
    return [episode + 0.25 * row, -0.5 * row, 0.125]


def table(episode: int, rows: int, first_index: int = 0) -> dict[str, Any]:
    return {
        STATE: [state(episode, row) for row in range(rows)],
        "timestamp": pa.array([row / FPS for row in range(rows)], pa.float32()),
        "frame_index": list(range(rows)),
        "episode_index": [episode] * rows,
        "index": list(range(first_index, first_index + rows)),
        "task_index": [0] * rows,
    }


def write_table(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def write_info(root: Path, version: str, **changes: Any) -> None:
    info: dict[str, Any] = {
        "codebase_version": version,
        "fps": FPS,
        "total_episodes": 3,
        "chunks_size": 2,
        "features": {
            STATE: {"dtype": "float32", "shape": [3], "names": NAMES},
            "action": {"dtype": "float32", "shape": [3], "names": NAMES},
            CAMERA: {"dtype": "video", "shape": [HEIGHT, WIDTH, 3]},
            "observation.images.depth": {
                "dtype": "video",
                "shape": [HEIGHT, WIDTH, 1],
                "info": {"video.is_depth_map": True},
            },
            "timestamp": {"dtype": "float32", "shape": [1]},
        },
    }
    if version == "v3.0":
        info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    else:
        info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        info["video_path"] = (
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        )
    info.update(changes)
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))


def v2_paths(root: Path, episode: int) -> tuple[Path, Path]:
    chunk = f"chunk-{episode // 2:03d}"
    name = f"episode_{episode:06d}"
    video = root / "videos" / chunk / CAMERA / f"{name}.mp4"
    return root / "data" / chunk / f"{name}.parquet", video


def write_v2(root: Path, version: str = "v2.1", codec: str = "libx264", rows: int = 5) -> Path:
    """Write three episodes of ``rows`` rows; frame i of episode e shows 3 e + i."""
    write_info(root, version)
    lines = []
    for episode in range(3):
        data, video = v2_paths(root, episode)
        write_table(data, table(episode, rows))
        write_video(video, range(3 * episode, 3 * episode + rows), codec)
        lines.append(json.dumps({"episode_index": episode, "length": rows}))
    (root / "meta" / "episodes.jsonl").write_text("\n".join(lines) + "\n")
    return root


def write_v3(root: Path, codec: str = "libx264") -> Path:
    """Write episodes of 4, 5 and 6 rows: the first two share files, the third has its own."""
    write_info(root, "v3.0")
    lengths = [4, 5, 6]
    first, second = table(0, 4), table(1, 5, 4)
    shared = {key: pa.concat_arrays([pa.array(first[key]), pa.array(second[key])]) for key in first}
    write_table(root / "data" / "chunk-000" / "file-000.parquet", shared)
    write_table(root / "data" / "chunk-000" / "file-001.parquet", table(2, 6, 9))
    videos = root / "videos" / CAMERA / "chunk-000"
    write_video(videos / "file-000.mp4", range(9), codec)
    write_video(videos / "file-001.mp4", range(9, 15), codec)
    starts = [0.0, 4 / FPS, 0.0]
    write_table(
        root / "meta" / "episodes" / "chunk-000" / "file-000.parquet",
        {
            "episode_index": [0, 1, 2],
            "length": lengths,
            "data/chunk_index": [0, 0, 0],
            "data/file_index": [0, 0, 1],
            f"videos/{CAMERA}/chunk_index": [0, 0, 0],
            f"videos/{CAMERA}/file_index": [0, 0, 1],
            f"videos/{CAMERA}/from_timestamp": starts,
            f"videos/{CAMERA}/to_timestamp": [4 / FPS, 9 / FPS, 6 / FPS],
        },
    )
    return root


def import_episode(root: Path, episode: int, **options: Any) -> tuple[Recording, Recorded]:
    done = record(LeRobotSource(root, episode, **options), root / "out.mcap", overwrite=True)
    return read_recording(done.path), done


def stamps(rows: int) -> list[int]:
    return [EPOCH_NS + round(float(np.float32(row / FPS)) * 1e9) for row in range(rows)]


def check_episode(recording: Recording, episode: int, rows: int, first_level: int) -> None:
    assert recording.image_stamps_ns.tolist() == stamps(rows)
    for row, image in enumerate(recording.images(range(rows))):
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert abs(float(image.mean()) - level(first_level + row)) < 4
    assert list(recording.joints) == NAMES
    for column, name in enumerate(NAMES):
        track = recording.joints[name]
        assert track.stamps_ns.tolist() == stamps(rows)
        assert track.positions.tolist() == [state(episode, row)[column] for row in range(rows)]


@pytest.mark.parametrize("version", ["v2.0", "v2.1"])
@pytest.mark.parametrize("codec", ["libx264", "libsvtav1", "mpeg4"])
def test_v2_episodes(tmp_path: Path, version: str, codec: str) -> None:
    write_v2(tmp_path, version, codec)
    for episode in (0, 2):
        recording, done = import_episode(tmp_path, episode)
        check_episode(recording, episode, 5, 3 * episode)
        assert done.report.dropped == {}
        assert not any("paired" in note for note in done.report.notes)


@pytest.mark.parametrize("codec", ["libx264", "libsvtav1"])
def test_v3_episodes_share_files(tmp_path: Path, codec: str) -> None:
    write_v3(tmp_path, codec)
    for episode, (rows, first) in enumerate(((4, 0), (5, 4), (6, 9))):
        recording, done = import_episode(tmp_path, episode)
        check_episode(recording, episode, rows, first)
        assert done.report.dropped == {}
        assert not any("paired" in note for note in done.report.notes)


def image_dataset(root: Path, cells: list[dict[str, Any]]) -> Path:
    columns = table(0, len(cells))
    columns[CAMERA] = pa.array(cells, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    features = {
        STATE: {"dtype": "float32", "shape": [3], "names": NAMES},
        CAMERA: {"dtype": "image", "shape": [HEIGHT, WIDTH, 3]},
    }
    write_info(root, "v2.1", total_episodes=1, features=features)
    write_table(v2_paths(root, 0)[0], columns)
    return root


def png(index: int, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, picture(index))[1].tobytes()


def test_images_in_the_table_stay_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "2.png").write_bytes(png(2))
    cells: list[dict[str, Any]] = [
        {"bytes": png(0), "path": "0.png"},
        {"bytes": png(1), "path": None},
        {"bytes": None, "path": "images/2.png"},
        {"bytes": png(3, ".bmp"), "path": None},
        {"bytes": b"no picture", "path": None},
        {"bytes": None, "path": "../outside.png"},
    ]
    recording, done = import_episode(image_dataset(tmp_path, cells), 0)
    stored = list(recording.image_messages(range(4)))
    assert [message.format for message in stored] == ["png"] * 4
    assert [bytes(message.data) for message in stored[:3]] == [png(0), png(1), png(2)]
    assert np.array_equal(next(recording.images([3])), picture(3))
    assert recording.image_stamps_ns.tolist() == stamps(6)[:4]
    assert len(recording.joints["elbow"].stamps_ns) == 6
    assert done.report.dropped == {"images that cannot be decoded": 2}


@pytest.mark.parametrize(
    ("names", "joints"),
    [
        (NAMES, NAMES),
        ([NAMES], NAMES),
        ({"motors": NAMES}, NAMES),
        ({"left": ["shoulder"], "right": ["elbow", "wrist"]}, NAMES),
        ({"wrist": 2, "shoulder": 0, "elbow": 1}, NAMES),
        (None, ["state_0", "state_1", "state_2"]),
    ],
)
def test_names_come_in_several_forms(tmp_path: Path, names: Any, joints: list[str]) -> None:
    write_v2(tmp_path)
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    info["features"][STATE]["names"] = names
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    recording, done = import_episode(tmp_path, 0)
    assert list(recording.joints) == joints
    assert any("has no names" in note for note in done.report.notes) == (names is None)


@pytest.mark.parametrize(("frames", "paired"), [(3, 3), (8, 5)])
def test_what_cannot_be_paired_is_said(tmp_path: Path, frames: int, paired: int) -> None:
    write_v2(tmp_path)
    write_video(v2_paths(tmp_path, 0)[1], range(frames))
    recording, done = import_episode(tmp_path, 0)
    assert recording.image_stamps_ns.tolist() == stamps(5)[:paired]
    assert len(recording.joints["wrist"].stamps_ns) == 5
    assert any(f"{paired} could be paired" in note for note in done.report.notes)


def test_rows_that_start_late_take_the_frames_of_their_time(tmp_path: Path) -> None:
    write_v2(tmp_path)
    data, video = v2_paths(tmp_path, 0)
    columns = table(0, 3)
    columns["timestamp"] = [0.2, 0.3, 0.4]
    write_table(data, columns)
    write_video(video, range(5))
    recording, _ = import_episode(tmp_path, 0)
    means = [float(image.mean()) for image in recording.images(range(3))]
    assert [round(mean / 10) for mean in means] == [level(index) // 10 for index in (2, 3, 4)]


def test_the_rig_is_written_beside_the_images(tmp_path: Path) -> None:
    camera = CameraModel(WIDTH, HEIGHT, 50, 50, 31.5, 23.5, "plumb_bob", ())
    rig = Rig(hand_frame="hand", camera_frame="optical", camera=camera)
    urdf = "<robot name='r'><link name='base'/></robot>"
    recording, done = import_episode(write_v2(tmp_path), 0, rig=rig, urdf=urdf)
    assert recording.camera == camera
    assert recording.image_frame == "optical"
    assert recording.urdf == urdf
    assert recording.attachments["robot.urdf"] == urdf.encode()
    assert done.report.read["/camera/camera_info"] == 5


def fails(match: str, root: Path, episode: int = 0, **options: Any) -> None:
    with pytest.raises(TooltipError, match=match) as caught:
        import_episode(root, episode, **options)
    assert "\n" not in str(caught.value)
    assert not (root / "out.mcap").exists()


def test_wrong_choices_list_the_valid_ones(tmp_path: Path) -> None:
    write_v2(tmp_path)
    fails(f"unknown camera 'nope'; known: {CAMERA}$", tmp_path, camera_key="nope")
    fails(
        "unknown camera 'observation.images.depth'", tmp_path, camera_key="observation.images.depth"
    )
    fails("unknown feature 'nope'; known: action", tmp_path, state_key="nope")
    fails("has no episode 7; listed: 0-2", tmp_path, 7)
    fails("has no episode -1; listed: 0-2", tmp_path, -1)
    fails("has no episode 3; listed: 0-2", write_v3(tmp_path / "v3"), 3)


def test_several_cameras_need_a_choice(tmp_path: Path) -> None:
    write_v2(tmp_path)
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    info["features"]["observation.images.wrist"] = {"dtype": "video"}
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    fails("several cameras: .*top, .*wrist; choose one with --camera", tmp_path)
    check_episode(import_episode(tmp_path, 0, camera_key=CAMERA)[0], 0, 5, 0)


def test_absent_files_are_named(tmp_path: Path) -> None:
    write_v2(tmp_path)
    data, video = v2_paths(tmp_path, 2)
    data.unlink()
    video.unlink()
    fails("episode 2 is listed, .*episode_000002.parquet, .*episode_000002.mp4", tmp_path, 2)
    (tmp_path / "meta" / "episodes.jsonl").unlink()
    fails("episode 2 is listed", tmp_path, 2)
    fails("no episode 3; listed: 0-2", tmp_path, 3)


@pytest.mark.parametrize("kind", ["empty", "text", "truncated"])
@pytest.mark.parametrize("which", [0, 1])
def test_damaged_files(tmp_path: Path, kind: str, which: int) -> None:
    path = v2_paths(write_v2(tmp_path), 0)[which]
    data = path.read_bytes()
    path.write_bytes(
        {"empty": b"", "text": b"a,b\n1,2\n", "truncated": data[: len(data) // 2]}[kind]
    )
    fails(path.name, tmp_path)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"timestamp": [0.0, float("nan"), 0.2]}, "timestamp of row 1 is no number"),
        ({"timestamp": [0.0, 0.2, 0.1]}, "timestamp of row 2 is not later"),
        ({"timestamp": [0.0, 0.1, 0.1]}, "timestamp of row 2 is not later"),
        ({"timestamp": [0.0, 0.1, 1e12]}, "check their unit"),
        ({"timestamp": [-1.7e9, 0.1, 0.2]}, "check its unit|check their unit"),
        ({"timestamp": [0.0, None, 0.2]}, "row 1 is no number"),
        ({STATE: [[1.0, 2.0]] * 3}, "has 2 values, expected 3"),
        ({STATE: [[1.0, 2.0, 3.0], [1.0], [2.0]]}, "cannot be read as a table"),
        ({STATE: ["a", "b", "c"]}, "cannot be read as a table"),
        ({"episode_index": [5, 5, 5]}, "no rows of episode 0"),
        ({"episode_index": None}, "lacks the columns episode_index"),
        ({STATE: None}, f"lacks the columns {STATE}"),
    ],
)
def test_malformed_tables(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    write_v2(tmp_path, rows=3)
    columns = {**table(0, 3), **changes}
    data = v2_paths(tmp_path, 0)[0]
    write_table(data, {key: value for key, value in columns.items() if value is not None})
    fails(match, tmp_path)


def test_joint_values_that_are_no_numbers_are_left_out_on_reading(tmp_path: Path) -> None:
    write_v2(tmp_path, rows=3)
    columns = table(0, 3)
    columns[STATE] = [[1.0, 2.0, 3.0], [1.0, float("nan"), 3.0], [1.0, 2.0, 3.0]]
    write_table(v2_paths(tmp_path, 0)[0], columns)
    recording, _ = import_episode(tmp_path, 0)
    assert len(recording.joints["elbow"].stamps_ns) == 2
    assert len(recording.joints["wrist"].stamps_ns) == 3


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"codebase_version": "v1.6"}, "version 'v1.6' is not read; known: v2.0, v2.1, v3.0"),
        ({"codebase_version": None}, "version None is not read"),
        ({"fps": 0}, "'fps' must be a positive number"),
        ({"fps": "30"}, "'fps' must be a positive number"),
        ({"features": []}, "'features' must map"),
        ({"features": {}}, "has no camera"),
        ({"data_path": "data/{nothing}.parquet"}, "'data_path' in meta/info.json is no path"),
        ({"data_path": "../{episode_index}.parquet"}, "leads out of the data set"),
        ({"video_path": "/etc/{episode_index}.mp4"}, "leads out of the data set"),
        ({"chunks_size": "many"}, "'chunks_size' in meta/info.json must be a whole number"),
        ({"data_path": "data/{episode_index:q}.parquet"}, "is no path template"),
    ],
)
def test_malformed_info(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    write_v2(tmp_path)
    write_info(tmp_path, "v2.1")
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    (tmp_path / "meta" / "info.json").write_text(json.dumps({**info, **changes}))
    fails(match, tmp_path)


@pytest.mark.parametrize(
    ("feature", "match"),
    [
        ({"shape": [3], "names": ["a", "b"]}, "has 3 values but 2 names"),
        ({"shape": [3], "names": ["a", "b", "a"]}, "names joints more than once: a"),
        ({"shape": [3, 2], "names": NAMES}, "a row of numbers"),
        ({"names": NAMES}, "a row of numbers"),
        ({"shape": [10**12], "names": None}, "a row of numbers"),
        ({"shape": [0], "names": None}, "a row of numbers"),
    ],
)
def test_malformed_state_features(tmp_path: Path, feature: dict[str, Any], match: str) -> None:
    write_v2(tmp_path)
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    info["features"][STATE] = {"dtype": "float32", **feature}
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    fails(match, tmp_path)


def test_folders_that_are_no_data_sets(tmp_path: Path) -> None:
    fails("is no LeRobot data set", tmp_path)
    fails("is no LeRobot data set", tmp_path / "absent")
    (tmp_path / "meta").mkdir()
    for text, match in (("", "not JSON"), ("{", "not JSON"), ("[]", "expected a JSON object")):
        (tmp_path / "meta" / "info.json").write_text(text)
        fails(match, tmp_path)
    (tmp_path / "meta" / "info.json").write_bytes(b"\xff\xfe")
    fails("cannot be read", tmp_path)
    write_v2(tmp_path / "v2")
    (tmp_path / "v2" / "meta" / "episodes.jsonl").write_text(
        '{"episode_index": 0}\n{"length": 3}\n'
    )
    fails(r"episodes.jsonl:2: not an episode", tmp_path / "v2")


def test_malformed_v3_lists(tmp_path: Path) -> None:
    write_v3(tmp_path)
    path = tmp_path / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    listed = pq.read_table(path)
    start = f"videos/{CAMERA}/from_timestamp"
    for value, match in ((float("nan"), "starts at nan s"), (None, "is listed without")):
        changed = pa.array([value, 0.4, 0.0], pa.float64())
        place = listed.column_names.index(start)
        pq.write_table(listed.set_column(place, start, changed), path)
        fails(match, tmp_path)
    pq.write_table(listed.drop_columns([start]), path)
    fails("from_timestamp", tmp_path)
    path.write_bytes(b"PAR1")
    fails("cannot be read", tmp_path)
    path.unlink()
    fails("no list of episodes", tmp_path)


@needs_g1
@pytest.mark.parametrize(("episode", "rows"), [(1, 393), (33, 317), (40, 425), (80, 362)])
def test_g1_episodes(tmp_path: Path, episode: int, rows: int) -> None:
    done = record(LeRobotSource(G1, episode), tmp_path / "g1.mcap")
    assert done.report.read == {"/joint_states": rows, "/camera/image/compressed": rows}
    assert done.report.dropped == {}
    recording = read_recording(done.path)
    column = pq.read_table(
        G1 / "data" / "chunk-000" / f"episode_{episode:06d}.parquet", columns=[STATE, "timestamp"]
    )
    seconds = column.column("timestamp").to_numpy().astype(float)
    assert (
        recording.image_stamps_ns.tolist()
        == (EPOCH_NS + np.round(seconds * 1e9).astype(np.int64)).tolist()
    )
    states = np.array(column.column(STATE).to_pylist())
    assert np.array_equal(recording.joints["kRightWristYaw"].positions, states[:, 13])


@needs_g1
def test_g1_absent_episodes() -> None:
    with pytest.raises(TooltipError, match="has no episode 5; listed: 1, 33, 40, 80"):
        LeRobotSource(G1, 5)


@needs_g1
@pytest.mark.parametrize(
    ("episode", "frame", "seen"),
    # the middle of the cap over the axis of the wrist's yaw, picked by hand
    [(1, 200, (545, 313)), (33, 150, (583, 355)), (40, 220, (575, 341)), (80, 150, (484, 416))],
)
def test_g1_projections_lie_on_the_wrist(
    tmp_path: Path, episode: int, frame: int, seen: tuple[int, int]
) -> None:
    rig = load_rig(ROOT / "calib" / "g1" / "rig.yaml")
    urdf = read_urdf(G1 / "g1_body29_hand14.urdf")
    done = record(LeRobotSource(G1, episode, rig=rig, urdf=urdf), tmp_path / "g1.mcap")
    recording = read_recording(done.path)
    views = resolve_views(recording, resolve_rig(recording, None))
    assert views.known.all()
    cap_hand = np.array([0.0, 0.0, 0.028, 1.0])
    cap_camera = np.linalg.inv(views.hand_from_camera[frame]) @ cap_hand
    error_px = np.linalg.norm(views.camera.project(cap_camera[:3]) - seen)
    # nominal intrinsics: the worst of these is 25 px, the others within 8 px
    assert error_px < 26
