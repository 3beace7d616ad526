"""Importing videos and folders of images with CSV tables."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import Mount
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.streams import EPOCH_NS
from tooltip_cli.sources.tables import read_image_stamps, read_joints, read_poses
from tooltip_cli.sources.video import VideoSource, natural_key, parse_start
from tooltip_cli.stages.record import Recorded, record

START = 1_700_000_000_123_456_789
WIDTH, HEIGHT, FPS = 96, 64, 25
JOINTS = "stamp_ns,shoulder,elbow\n" + "".join(
    f"{START + 10_000_000 * row},{0.1 * row!r},{-0.3 * row!r}\n" for row in range(30)
)
POSES = "stamp_ns,x,y,z,qx,qy,qz,qw\n" + "".join(
    f"{START + 10_000_000 * row},{0.01 * row!r},0.5,-1,0,0,0,1\n" for row in range(30)
)


def picture(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.full((HEIGHT, WIDTH, 3), 20 + 20 * (index % 10), dtype=np.uint8)


def encoded(index: int, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, picture(index))[1].tobytes()


def write_video(path: Path, pts: Sequence[int], codec: str = "libx264", rotate: int = 0) -> Path:
    """Write one frame for each presentation time, in units of 1 / (10 * FPS) s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 10 * FPS)
        for index, when in enumerate(pts):
            frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
            frame.pts, frame.time_base = when, Fraction(1, 10 * FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_folder(path: Path, names: Sequence[str], suffix: str = ".png") -> Path:
    path.mkdir()
    for index, name in enumerate(names):
        (path / name).write_bytes(encoded(index, suffix))
    return path


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def import_video(path: Path, **options: Any) -> tuple[Recording, Recorded]:
    done = record(VideoSource(path, **options), path.parent / "out.mcap", overwrite=True)
    return read_recording(done.path), done


def check_levels(recording: Recording, count: int) -> None:
    assert len(recording.image_stamps_ns) == count
    for index, image in enumerate(recording.images(range(count))):
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert abs(float(image.mean()) - (20 + 20 * index)) < 6


def test_a_video_starts_with_its_table(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", [0, 10, 20, 35, 40])
    joints = write(tmp_path / "joints.csv", JOINTS)
    source = VideoSource(path, joints)
    assert source.frames == 5
    recording, done = import_video(path, joints_csv=joints)
    check_levels(recording, 5)
    assert (recording.image_stamps_ns - START).tolist() == [
        40_000_000 * 0, 40_000_000, 80_000_000, 140_000_000, 160_000_000
    ]  # fmt: skip
    assert list(recording.joints) == ["shoulder", "elbow"]
    track = recording.joints["elbow"]
    assert track.stamps_ns.tolist() == [START + 10_000_000 * row for row in range(30)]
    assert track.positions.tolist() == [-0.3 * row for row in range(30)]
    assert any(f"first stamp, {START} ns" in note for note in done.report.notes)
    assert done.report.dropped == {}


@pytest.mark.parametrize("codec", ["libx264", "mpeg4", "libsvtav1"])
def test_codecs(tmp_path: Path, codec: str) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this build of PyAV cannot encode with {codec}")
    check_levels(import_video(write_video(tmp_path / "v.mp4", range(0, 60, 10), codec))[0], 6)


def test_start_and_rate_take_the_videos_place(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", [50, 60, 70])  # the video's clock does not start at 0
    joints = write(tmp_path / "joints.csv", JOINTS)
    recording, _ = import_video(path, joints_csv=joints, start_ns=START + 5)
    assert (recording.image_stamps_ns - START).tolist() == [5, 40_000_005, 80_000_005]
    recording, _ = import_video(path, joints_csv=joints, fps=10.0)
    assert (recording.image_stamps_ns - START).tolist() == [0, 100_000_000, 200_000_000]
    recording, done = import_video(path)
    assert recording.image_stamps_ns[0] == EPOCH_NS
    assert any("not located" in note for note in done.report.notes)


def test_a_truncated_video_gives_what_is_left(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mkv", range(0, 1000, 10))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    recording, _ = import_video(path)
    assert 30 < len(recording.image_stamps_ns) < 100


@pytest.mark.parametrize(
    ("name", "data", "match"),
    [
        ("absent.mp4", None, "No such file"),
        ("empty.mp4", b"", "cannot be read as a video"),
        ("text.mp4", b"stamp_ns,a\n1,2\n", "cannot be read as a video"),
    ],
)
def test_files_that_are_no_videos(
    tmp_path: Path, name: str, data: bytes | None, match: str
) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    fails(match, tmp_path / name)


def test_a_video_without_its_index_is_one_line(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", range(0, 50, 10))
    path.write_bytes(path.read_bytes()[:500])
    fails("cannot be read as a video", path)


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        silence = np.zeros((1, 800), dtype=np.int16)
        frame = av.AudioFrame.from_ndarray(silence, format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    fails("holds no video stream", path)


@pytest.mark.parametrize(("suffix", "kind"), [(".jpg", "jpeg"), (".png", "png")])
def test_images_are_stored_as_they_are(tmp_path: Path, suffix: str, kind: str) -> None:
    names = [f"{START + 40_000_000 * index}{suffix}" for index in range(3)]
    folder = write_folder(tmp_path / "frames", names, suffix)
    recording, done = import_video(folder, joints_csv=write(tmp_path / "j.csv", JOINTS))
    assert (recording.image_stamps_ns - START).tolist() == [0, 40_000_000, 80_000_000]
    for index, message in enumerate(recording.image_messages(range(3))):
        assert message.format == kind
        assert bytes(message.data) == encoded(index, suffix)
    assert done.report.read == {"/camera/image/compressed": 3, "/joint_states": 30}


def test_other_formats_become_png(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["a.bmp", "b.bmp"], ".bmp")
    recording, _ = import_video(folder, fps=10)
    for index, image in enumerate(recording.images(range(2))):
        assert np.array_equal(image, picture(index))
    assert next(recording.image_messages([0])).format == "png"


def test_names_in_seconds(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "f", ["1305031102.175304.png", "1305031102.211214000.png"])
    recording, _ = import_video(folder)
    assert recording.image_stamps_ns.tolist() == [1305031102175304000, 1305031102211214000]


def test_counted_images_are_sorted_by_number(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["f1.png", "f2.png", "f10.png", "f11.png"])
    joints = write(tmp_path / "joints.csv", JOINTS)
    recording, _ = import_video(folder, joints_csv=joints, fps=20.0)
    check_levels(recording, 4)
    assert (recording.image_stamps_ns - START).tolist() == [0, 50_000_000, 100_000_000, 150_000_000]
    recording, _ = import_video(folder, joints_csv=joints, fps=20.0, start_ns=START + 7)
    assert recording.image_stamps_ns[0] == START + 7
    fails("f1.png has no stamp for a name; give --fps, or list the stamps", folder)


@pytest.mark.parametrize("name", ["000001.png", "1403636579763.png", "1403636579763555.png"])
def test_numbers_of_another_unit_are_no_stamps(tmp_path: Path, name: str) -> None:
    fails("has no stamp for a name", write_folder(tmp_path / "frames", [name]))


def test_listed_stamps(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["a.png", "b.png", "c.png"])
    write(folder / "stamps.csv", f"file,stamp_ns\nb.png,{START}\na.png,{START + 9}\n")
    recording, done = import_video(folder)
    assert recording.image_stamps_ns.tolist() == [START, START + 9]
    assert [bytes(m.data) for m in recording.image_messages([0, 1])] == [encoded(1), encoded(0)]
    assert done.report.dropped == {"images that stamps.csv does not list": 1}
    write(folder / "stamps.csv", "stamp,file\n1700000000.5,b.png\n1700000000.25,a.png\n")
    recording, _ = import_video(folder, start_ns=START)
    assert recording.image_stamps_ns.tolist() == [START, START + 250_000_000]
    write(folder / "stamps.csv", f"file,stamp_ns\nb.png,{START}\nd.png,{START}\n")
    fails("1 file that the folder does not hold as images, the first is 'd.png'", folder)


def test_damaged_images_are_left_out(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["0.png", "1.png", "2.png"])
    (folder / "1.png").write_bytes(b"no picture")
    (folder / "2.png").write_bytes(b"")
    recording, done = import_video(folder, fps=10)
    assert len(recording.image_stamps_ns) == 1
    assert sum(done.report.dropped.values()) == 2
    (folder / "0.png").write_bytes(b"")
    fails("holds no images", folder, fps=10)


def test_equal_stamps_are_left_out(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["a.png", "b.png"])
    write(folder / "stamps.csv", f"file,stamp_ns\na.png,{START}\nb.png,{START}\n")
    _, done = import_video(folder)
    assert done.report.dropped == {"images that are not later than the one before": 1}


def test_folders_without_images(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    write(tmp_path / "frames" / "notes.txt", "nothing")
    fails("holds no images", tmp_path / "frames")


def test_poses_locate_the_camera(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["a.png", "b.png"])
    camera = CameraModel(WIDTH, HEIGHT, 50, 50, 31.5, 23.5, "plumb_bob", ())
    rig = Rig("hand", "optical", camera, Mount("world"), pose_topic="/tracker")
    poses = write(tmp_path / "poses.csv", POSES)
    recording, _ = import_video(folder, poses_csv=poses, fps=10, rig=rig)
    assert recording.poses["/tracker"].frame_id == "world"
    assert recording.poses["/tracker"].positions[:2].tolist() == [[0, 0.5, -1], [0.01, 0.5, -1]]
    assert recording.camera == camera
    assert recording.image_frame == "optical"
    views = resolve_views(recording, resolve_rig(recording, None))
    assert views.hand_from_camera[1][:3, 3] == pytest.approx([-0.1, -0.5, 1])
    recording, _ = import_video(folder, poses_csv=poses, fps=10, pose_frame="flange")
    assert recording.poses["/hand_pose"].frame_id == "flange"
    recording, _ = import_video(folder, poses_csv=poses, fps=10)
    assert recording.poses["/hand_pose"].frame_id == "base"


def test_the_robot_is_written(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "frames", ["a.png"])
    urdf = "<robot name='r'><link name='base'/></robot>"
    recording, done = import_video(folder, fps=10, urdf=urdf)
    assert recording.urdf == urdf
    assert done.report.read["/robot_description"] == 1


def fails(match: str, path: Path, **options: Any) -> None:
    out = path.parent / "out.mcap"
    out.unlink(missing_ok=True)
    with pytest.raises(TooltipError, match=match) as caught:
        import_video(path, **options)
    assert "\n" not in str(caught.value)
    assert not out.exists()


S = START
BAD_JOINTS = {
    "empty": ("", "is empty"),
    "blank lines": ("\n \n", "is empty"),
    "header alone": ("stamp_ns,a\n", "no rows below its header"),
    "no header": (f"{S},0.1\n{S + 1},0.2\n", ":1: the header must name one time column"),
    "no time": ("t,a\n1,2\n", ":1: the header must name one time column.*neither in 't,a'"),
    "both times": ("stamp_ns,stamp,a\n1,2,3\n", ":1: .*found both"),
    "semicolons": ("stamp_ns;a\n1;2\n", ":1: the header must name one time column"),
    "time alone": (f"stamp_ns\n{S}\n", ":1: no joint columns"),
    "nameless column": (f"stamp_ns,a,\n{S},1,2\n", ":1: column 3 has no name"),
    "line break in a name": ('stamp_ns,"a\nb"\n1,2\n', ":2: column 2 has no name, or no plain"),
    "line break in a cell": (f'stamp_ns,a\n{S},"1\n2"\n', r":3: a is '1\\n2', expected a number"),
    "joint twice": (f"stamp_ns,a,b,a\n{S},1,2,3\n", ":1: .*more than once: a$"),
    "time twice": ("stamp_ns,stamp_ns,a\n1,1,1\n", ":1: the header must name one time"),
    "too few": (f"stamp_ns,a,b\n{S},1,2\n{S},1\n", ":3: 2 values, but the header names 3"),
    "too many": (f"stamp_ns,a\n{S},1,2\n", ":2: 3 values, but the header names 2"),
    "no number": (f"stamp_ns,a\n{S},x\n", ":2: a is 'x', expected a number"),
    "no value": (f"stamp_ns,a,b\n{S},,1\n", ":2: a is '', expected a number"),
    "NaN": (f"stamp_ns,a\n{S},1\n{S + 1},nan\n", ":3: a is 'nan', expected a number"),
    "infinity": (f"stamp_ns,a\n{S},inf\n", ":2: a is 'inf', expected a number"),
    "NaN stamp": ("stamp_ns,a\nnan,1\n", ":2: stamp_ns is 'nan', expected whole nanoseconds"),
    "float stamp": ("stamp_ns,a\n1.5e18,1\n", ":2: stamp_ns is '1.5e18', expected whole"),
    "no stamp": ("stamp_ns,a\n,1\n", ":2: stamp_ns is '', expected whole nanoseconds"),
    "negative": ("stamp_ns,a\n-5,1\n", ":2: the stamp -5 ns lies outside"),
    "too late": ("stamp_ns,a\n9999999999999999999,1\n", ":2: the stamp 9+ ns lies outside"),
    "endless": (f"stamp_ns,a\n{'9' * 5000},1\n", ":2: stamp_ns is '9+\\.\\.\\.9+', expected whole"),
    "NaN seconds": ("stamp,a\nnan,1\n", ":2: stamp is 'nan', expected seconds"),
    "word seconds": ("stamp,a\nnoon,1\n", ":2: stamp is 'noon', expected seconds"),
    "infinite seconds": ("stamp,a\ninf,1\n", ":2: stamp is 'inf', expected seconds"),
    "huge seconds": ("stamp,a\n1e900000,1\n", ":2: stamp is '1e900000', expected seconds"),
    "late seconds": ("stamp,a\n1e11,1\n", ":2: the stamp 1.* ns lies outside"),
    "open quote": (f'stamp_ns,a\n{S},"1\n', ":2: not CSV"),
    "stray quote": (f'stamp_ns,a\n{S},"1"2\n', ":2: not CSV"),
}


@pytest.mark.parametrize("kind", BAD_JOINTS)
def test_malformed_joint_tables_name_their_line(tmp_path: Path, kind: str) -> None:
    text, match = BAD_JOINTS[kind]
    path = write(tmp_path / "joints.csv", text)
    with pytest.raises(TooltipError, match=match) as caught:
        read_joints(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    folder = write_folder(tmp_path / "frames", ["a.png"])
    fails(match, folder, joints_csv=path, fps=10)


BAD_POSES = {
    "no quaternion": (f"stamp_ns,x,y,z\n{S},1,2,3\n", ":1: expected the columns stamp_ns,x,y,z,q"),
    "further column": (
        f"stamp_ns,x,y,z,qx,qy,qz,qw,elbow\n{S},0,0,0,0,0,0,1,0\n",
        ":1: expected the columns",
    ),
    "no rotation": (f"stamp_ns,x,y,z,qx,qy,qz,qw\n{S},0,0,0,0,0,0,0\n", ":2: .*norm 0, expected 1"),
    "far from unit": (f"stamp_ns,x,y,z,qx,qy,qz,qw\n{S},0,0,0,0,0,0,2\n", ":2: .*norm 2, expected"),
    "NaN": (f"stamp_ns,x,y,z,qx,qy,qz,qw\n{S},nan,0,0,0,0,0,1\n", ":2: x is 'nan'"),
    "NaN quaternion": (f"stamp_ns,x,y,z,qx,qy,qz,qw\n{S},0,0,0,nan,0,0,1\n", ":2: qx is 'nan'"),
    "header alone": ("stamp_ns,x,y,z,qx,qy,qz,qw\n", "no rows below"),
}


@pytest.mark.parametrize("kind", BAD_POSES)
def test_malformed_pose_tables_name_their_line(tmp_path: Path, kind: str) -> None:
    text, match = BAD_POSES[kind]
    with pytest.raises(TooltipError, match=match):
        read_poses(write(tmp_path / "poses.csv", text))


def test_malformed_stamp_tables_name_their_line(tmp_path: Path) -> None:
    for text, match in (
        ("stamp_ns\n1\n", ":1: expected the columns stamp_ns,file"),
        ("file,stamp_ns\na.png,1\na.png,2\n", ":3: 'a.png' is listed a second time"),
        ("file,stamp_ns\n", "no rows below"),
        ("file,stamp_ns\na.png,x\n", ":2: stamp_ns is 'x'"),
    ):
        with pytest.raises(TooltipError, match=match):
            read_image_stamps(write(tmp_path / "stamps.csv", text))


def test_files_that_are_no_tables(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match="cannot be read"):
        read_joints(tmp_path / "absent.csv")
    with pytest.raises(TooltipError, match="cannot be read"):
        read_joints(tmp_path)
    (tmp_path / "image.csv").write_bytes(encoded(0))
    with pytest.raises(TooltipError, match="not UTF-8 text"):
        read_joints(tmp_path / "image.csv")


def test_tables_as_programs_write_them(tmp_path: Path) -> None:
    text = f'\ufeff"stamp_ns", a ,"b, left"\r\n{S + 5},1e-3,"2"\r\n\r\n {S} ,0,-2\r\n'
    (tmp_path / "joints.csv").write_text(text, encoding="utf-8", newline="")
    found = read_joints(tmp_path / "joints.csv")
    assert list(found.columns) == ["a", "b, left"]
    assert found.stamps_ns.tolist() == [S, S + 5]
    assert found.rows.tolist() == [[0, -2], [1e-3, 2]]
    assert found.reversals == 1
    folder = write_folder(tmp_path / "frames", ["a.png"])
    _, done = import_video(folder, fps=10, joints_csv=tmp_path / "joints.csv")
    assert any("1 row stood before an earlier one" in note for note in done.report.notes)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_seconds_keep_their_nanoseconds(stamp_ns: int) -> None:
    text = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
    assert parse_start(text) == stamp_ns
    assert parse_start(text + "s") == stamp_ns
    assert parse_start(str(stamp_ns)) == stamp_ns


def test_start_needs_a_unit(tmp_path: Path) -> None:
    assert parse_start("1700000000s") == 1_700_000_000 * 10**9
    assert parse_start("1700000000") == 1_700_000_000
    for text in ("", "now", "-1", "1.5.2", "1e9", "nan", "9" * 20):
        with pytest.raises(TooltipError, match="is no stamp"):
            parse_start(text)
    path = write_video(tmp_path / "v.mp4", [0, 10])
    fails("--start: the stamp 9+ ns lies outside", path, start_ns=int("9" * 19))


@given(st.lists(st.integers(0, 10**6), min_size=2, max_size=5))
def test_natural_order_is_that_of_the_numbers(numbers: list[int]) -> None:
    names = [f"frame_{number}.png" for number in numbers]
    ordered = sorted(names, key=natural_key)
    assert ordered == [f"frame_{number}.png" for number in sorted(numbers)]
