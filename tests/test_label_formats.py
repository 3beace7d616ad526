"""Labels from and for other tools, on files as their documentation shows them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import refusal
from tests.helpers.cli import tooltip
from tests.helpers.logs import Log, jpeg_of, stamp_of
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.book import Rows, TipLabel, rows_of
from tooltip_cli.labels.exchange import WRITERS, Choice, Place, adopt, read_foreign
from tooltip_cli.labels.files import read_labels
from tooltip_cli.labels.formats.base import Album, Shown
from tooltip_cli.labels.journal import open_journal

STAMPS = [stamp_of(frame) for frame in range(40)]
PLACE = Place(STAMPS, range(40), (160, 120))
FIRST = Choice()


def seen(u: float, v: float, labeler: str) -> TipLabel:
    return TipLabel("visible", (u, v), labeler)


def written(tmp_path: Path, content: Any, name: str = "labels") -> Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def taken(path: Path, choice: Choice = FIRST, place: Place = PLACE) -> dict[int, TipLabel]:
    """Return a file's labels by image index."""
    rows = adopt(read_foreign(path), place, choice)
    return {STAMPS.index(stamp): row for stamp, row in rows.items()}


# CVAT.

CVAT_VIDEO = """<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta>
    <task>
      <id>7</id>
      <name>pliers</name>
      <size>40</size>
      <mode>interpolation</mode>
      <overlap>5</overlap>
      <bugtracker></bugtracker>
      <created>2024-02-01 10:00:00.000000+00:00</created>
      <updated>2024-02-01 11:00:00.000000+00:00</updated>
      <start_frame>0</start_frame>
      <stop_frame>39</stop_frame>
      <frame_filter></frame_filter>
      <labels>
        <label>
          <name>tip</name>
          <color>#66ff66</color>
          <type>points</type>
          <attributes></attributes>
        </label>
      </labels>
      <segments>
        <segment><id>7</id><start>0</start><stop>39</stop><url>x</url></segment>
      </segments>
      <owner><username>ana</username><email>ana@x</email></owner>
      <original_size><width>160</width><height>120</height></original_size>
    </task>
    <dumped>2024-02-01 11:00:01.000000+00:00</dumped>
  </meta>
  <track id="0" label="tip" source="manual">
    <points frame="2" keyframe="1" outside="0" occluded="0" points="10.50,20.25" z_order="0">
    </points>
    <points frame="3" keyframe="0" outside="0" occluded="0" points="11.00,21.00" z_order="0">
    </points>
    <points frame="4" keyframe="1" outside="0" occluded="1" points="12.00,22.00" z_order="0">
    </points>
    <points frame="5" keyframe="1" outside="1" occluded="1" points="12.00,22.00" z_order="0">
    </points>
  </track>
  <track id="1" label="tip" source="manual">
    <points frame="5" keyframe="1" outside="0" occluded="0" points="0.00,120.00" z_order="0">
    </points>
    <points frame="6" keyframe="1" outside="1" occluded="0" points="0.00,120.00" z_order="0">
    </points>
  </track>
</annotations>
"""

CVAT_IMAGES = f"""<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta><task><mode>annotation</mode></task></meta>
  <image id="0" name="images/{STAMPS[9]}.jpg" width="160" height="120">
    <points label="tip" source="manual" occluded="0" points="10.50,20.50" z_order="0"></points>
    <points label="heel" source="manual" occluded="0" points="99.50,20.50" z_order="0"></points>
  </image>
  <image id="1" name="frame_000011.png" width="160" height="120">
    <tag label="out_of_view" source="manual"></tag>
  </image>
  <image id="2" name="frame_000012.png" width="160" height="120">
    <skeleton label="tool" source="manual" z_order="0">
      <points label="tip" source="manual" outside="0" occluded="0" points="3.50,4.50"></points>
      <points label="heel" source="manual" outside="1" occluded="0" points="0.00,0.00"></points>
    </skeleton>
  </image>
</annotations>
"""


def test_cvat_for_video(tmp_path: Path) -> None:
    path = written(tmp_path, CVAT_VIDEO)
    assert taken(path) == {
        2: seen(10.0, 19.75, "CVAT"),  # counted from the corner
        4: TipLabel("occluded", None, "CVAT"),
        5: seen(-0.5, 119.5, "CVAT"),  # the corner of the image is still inside
    }
    left_out = read_foreign(path).left_out
    assert {reason.split()[0]: count for reason, count in left_out.items()} == {
        "between": 1,
        "outside:": 2,
    }


def test_cvat_for_images_finds_them_by_name(tmp_path: Path) -> None:
    path = written(tmp_path, CVAT_IMAGES)
    assert taken(path, Choice(point="tip", labeler="ben")) == {
        9: seen(10.0, 20.0, "ben"),
        11: TipLabel("out_of_view", None, "ben"),
        12: seen(3.0, 4.0, "ben"),
    }
    assert taken(path, Choice(point="heel")) == {
        9: seen(99.0, 20.0, "CVAT"),
        11: TipLabel("out_of_view", None, "CVAT"),
    }
    with pytest.raises(TooltipError, match="several points: heel, tip; choose the tip with --poi"):
        taken(path)
    with pytest.raises(TooltipError, match="unknown point 'nose'; known: heel, tip"):
        taken(path, Choice(point="nose"))


def test_frame_numbers_may_count_other_frames(tmp_path: Path) -> None:
    path = written(tmp_path, CVAT_VIDEO)
    chosen = replace(PLACE, numbered=range(0, 40, 5), first=1)
    assert sorted(taken(path, place=chosen)) == [5, 15, 20]


BOMB = """<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">
<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>
<annotations><track label="&b;"/></annotations>"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "document type"),
        ("<!DOCTYPE x SYSTEM 'file:///etc/passwd'><annotations/>", "document type"),
        ("<annotations>", "no element found"),
        ("<svg/>", "expected <annotations>"),
        (CVAT_VIDEO.replace("10.50,20.25", "10.50,20.25;1,2"), "2 points in one shape"),
        (CVAT_VIDEO.replace("10.50,20.25", "ten"), "ten"),
        (CVAT_VIDEO.replace('frame="2"', 'frame="x"'), "x"),
        (CVAT_VIDEO.replace("<width>160", "<width>320"), "measures 320x120"),
        (CVAT_VIDEO.replace('frame="2"', 'frame="40"'), "no image 40"),
        (CVAT_VIDEO.replace("10.50,20.25", "161.00,20.00"), "outside the 160x120 image"),
        (CVAT_VIDEO.replace('frame="2"', 'frame="5"'), "two labels of image 5"),
    ],
)
def test_cvat_that_cannot_be_taken(text: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    found = refusal(lambda: taken(path))
    assert found is not None
    assert found.startswith(str(path))
    assert message in found


# COCO.


def coco(*keypoints: Any, **more: Any) -> dict[str, Any]:
    """Return a file with one image for each annotation, as COCO's data format has it."""
    numbers = range(1, len(keypoints) + 1)
    return {
        "info": {"year": 2024, "version": "1", "description": ""},
        "licenses": [],
        "images": [
            {"id": 100 + n, "width": 160, "height": 120, "file_name": f"frame_{n:06}.jpg"}
            for n in numbers
        ],
        "annotations": [
            {
                "id": n,
                "image_id": 100 + n,
                "category_id": 5,
                "iscrowd": 0,
                "area": 10.0,
                "bbox": [0, 0, 5, 2],
                "segmentation": [],
                "num_keypoints": 1,
                "keypoints": points,
                **more,
            }
            for n, points in zip(numbers, keypoints, strict=True)
        ],
        "categories": [
            {
                "id": 5,
                "name": "tool",
                "supercategory": "",
                "keypoints": ["heel", "tip"],
                "skeleton": [[1, 2]],
            }
        ],
    }


def test_coco_visibility_zero_is_no_label(tmp_path: Path) -> None:
    document = coco([1, 2, 2, 10, 20.5, 2], [0, 0, 0, 0, 0, 0], [1, 2, 2, 30, 40, 1])
    path = written(tmp_path, document)
    assert taken(path, Choice(point="tip")) == {
        1: seen(10.0, 20.5, "COCO"),  # 0-indexed: pixel centres
        3: TipLabel("occluded", None, "COCO"),
    }
    assert sum(read_foreign(path).left_out.values()) == 2


def test_coco_as_cvat_writes_it_counts_from_the_corner_when_told(tmp_path: Path) -> None:
    document = coco([0, 0, 0, 10.5, 20.5, 2], attributes={"occluded": False, "track_id": 0})
    path = written(tmp_path, document)
    assert "--origin corner" in read_foreign(path).notes[0]
    assert taken(path, Choice("tip", corner=True)) == {1: seen(10.0, 20.0, "COCO")}
    assert taken(path, Choice("tip")) == {1: seen(10.5, 20.5, "COCO")}


@pytest.mark.parametrize(
    "spoil",
    [
        lambda document: document["categories"].clear(),
        lambda document: document["annotations"][0].update(keypoints=[1, 2]),
        lambda document: document["annotations"][0].update(keypoints=[0, 0, 0, 1, 2, 3]),
        lambda document: document["annotations"][0].update(keypoints=[0, 0, 0, None, 2, 2]),
        lambda document: document["annotations"][0].update(image_id=1),
        lambda document: document["images"][0].update(width=None),
        lambda document: document.update(annotations=5),
        lambda document: document["annotations"].append(7),
        lambda document: document["annotations"][0].update(keypoints=[0, 0, 0, 10**400, 2, 2]),
        lambda document: document["annotations"][0].update(keypoints=[0, 0, 0, float("nan"), 2, 2]),
    ],
)
def test_coco_that_cannot_be_taken(spoil: Any, tmp_path: Path) -> None:
    document = coco([0, 0, 0, 10, 20, 2])
    spoil(document)
    path = written(tmp_path, document)
    message = refusal(lambda: taken(path, Choice(point="tip")))
    assert message is not None
    assert message.startswith(str(path))


# Label Studio.


def task(*results: Mapping[str, Any], image: str, **annotation: Any) -> dict[str, Any]:
    """Return a task as the JSON export has it."""
    return {
        "id": 1,
        "data": {"image": image},
        "annotations": [
            {
                "id": 1001,
                "result": list(results),
                "was_cancelled": False,
                "ground_truth": False,
                "lead_time": 3.2,
                "completed_by": 1,
                **annotation,
            }
        ],
        "predictions": [],
        "file_upload": "e875f554-frame.jpg",
        "project": 1,
    }


def keypoint(x: float, y: float, **more: Any) -> dict[str, Any]:
    return {
        "id": "hqudA4A3U4",
        "type": "keypointlabels",
        "from_name": "kp",
        "to_name": "image",
        "origin": "manual",
        "original_width": 160,
        "original_height": 120,
        "image_rotation": 0,
        "value": {"x": x, "y": y, "width": 0.4, "keypointlabels": ["Tip"]},
        **more,
    }


def choice(name: str) -> dict[str, Any]:
    return {
        "type": "choices",
        "from_name": "state",
        "to_name": "image",
        "value": {"choices": [name]},
    }


def test_label_studio_counts_in_percent(tmp_path: Path) -> None:
    document = [
        task(keypoint(50, 25), image=f"/data/upload/1/e875f554-{STAMPS[2]}.jpg"),
        task(keypoint(0, 100), image="/data/local-files/?d=pliers%2Fframe_0003.jpg"),
        task(choice("occluded"), image="s3://bucket/frame_0004.jpg", completed_by={"email": "a@b"}),
        task(choice("sharp"), image="frame_0005.jpg"),
        task(keypoint(1, 1), image="frame_0006.jpg", was_cancelled=True),
    ]
    path = written(tmp_path, document)
    assert taken(path) == {
        2: seen(79.5, 29.5, "1"),  # half of 160, and a quarter of 120, from the corner
        3: seen(-0.5, 119.5, "1"),
        4: TipLabel("occluded", None, "a@b"),
    }
    assert sum(read_foreign(path).left_out.values()) == 2


def test_label_studio_with_two_annotators(tmp_path: Path) -> None:
    one = task(keypoint(50, 25), image="frame_0003.jpg", completed_by=1)
    two = task(keypoint(51, 25), image="frame_0003.jpg", completed_by=2)
    one["annotations"] += two["annotations"]
    path = written(tmp_path, [one])
    with pytest.raises(TooltipError, match=r"two labels of image frame_0003.jpg.*--annotator"):
        taken(path)
    assert taken(path, Choice(annotator="2")) == {3: seen(81.1, 29.5, "2")}
    with pytest.raises(TooltipError, match="unknown annotator '3'; known: 1, 2"):
        taken(path, Choice(annotator="3"))


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (keypoint(1, 1, image_rotation=90), "turned by 90 degrees"),
        (keypoint(1, 1, original_width=320), "measures 320x120"),
        (keypoint(101, 1), "outside the 160x120 image"),
        (keypoint(1, 1, value={"x": 1}), "KeyError"),
        ({"type": "keypointlabels"}, "KeyError"),
    ],
)
def test_label_studio_that_cannot_be_taken(
    result: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = written(tmp_path, [task(result, image="frame_0003.jpg")])
    assert message in str(refusal(lambda: taken(path)))


def test_label_studios_short_export_is_named(tmp_path: Path) -> None:
    path = written(tmp_path, [{"image": "frame_3.jpg", "kp": [{"x": 1, "y": 2}], "id": 1}])
    assert "export as JSON" in str(refusal(lambda: taken(path)))


# labelme.


def labelme(name: str, *shapes: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "version": "5.5.0",
        "flags": {},
        "shapes": list(shapes),
        "imagePath": name,
        "imageData": None,
        "imageHeight": 120,
        "imageWidth": 160,
        **more,
    }


def shape(kind: str, *points: list[float], **more: Any) -> dict[str, Any]:
    return {
        "label": "tip",
        "points": list(points),
        "group_id": None,
        "description": "",
        "shape_type": kind,
        "flags": {},
        "mask": None,
        **more,
    }


def test_a_folder_of_labelme(tmp_path: Path) -> None:
    box = shape("rectangle", [0.0, 0.0], [9.0, 9.0])
    written(tmp_path, labelme(f"..\\img\\{STAMPS[1]}.jpg", shape("point", [10.5, 20.5])), "a.json")
    written(tmp_path, labelme("frame_2.jpg", box, shape("point", [0.0, 0.0])), "b.json")
    written(tmp_path, labelme("frame_3.jpg", flags={"out_of_view": True}), "c.json")
    hidden = shape("point", [1.0, 1.0], flags={"occluded": True})
    written(tmp_path, labelme("frame_4.jpg", hidden), "d.json")
    written(tmp_path, {"something": "else"}, "e.json")
    assert taken(tmp_path) == {
        1: seen(10.0, 20.0, "labelme"),
        2: seen(-0.5, -0.5, "labelme"),
        3: TipLabel("out_of_view", None, "labelme"),
        4: TipLabel("occluded", None, "labelme"),
    }
    assert read_foreign(tmp_path).left_out == {"shapes that are no points": 1}
    assert taken(tmp_path / "a.json") == {1: seen(10.0, 20.0, "labelme")}


def test_labelme_that_cannot_be_taken(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match="holds no JSON file as labelme writes them"):
        taken(tmp_path)
    path = written(tmp_path, labelme("frame_3.jpg", shape("point", [1.0])), "a.json")
    with pytest.raises(TooltipError, match="not as labelme writes it"):
        taken(path)
    path = written(tmp_path, labelme("tip.jpg", shape("point", [1.0, 1.0])), "a.json")
    with pytest.raises(TooltipError, match=r"'tip.jpg' ends in no number"):
        taken(path)


# DeepLabCut.

DEEPLABCUT = """scorer,,,ana,ana,ana,ana
bodyparts,,,tip,tip,heel,heel
coords,,,x,y,x,y
labeled-data,pliers,img0002.png,10.25,20.5,1.0,2.0
labeled-data,pliers,img0003.png,,,1.0,2.0
labeled-data,pliers,img0004.png,0.0,0.0,,
"""
OLD_DEEPLABCUT = """scorer,ana,ana
bodyparts,tip,tip
coords,x,y
labeled-data/pliers/img0002.png,10.25,20.5
labeled-data/pliers/img0003.png,nan,nan
"""
ANIMALS = """scorer,,,ana,ana,ana,ana
individuals,,,one,one,two,two
bodyparts,,,tip,tip,tip,tip
coords,,,x,y,x,y
labeled-data,pliers,img0002.png,10.25,20.5,1.0,2.0
"""


def test_deeplabcut(tmp_path: Path) -> None:
    path = written(tmp_path, DEEPLABCUT)
    # pixel centres, and (0, 0) is a place like any other
    assert taken(path, Choice("tip")) == {2: seen(10.25, 20.5, "ana"), 4: seen(0.0, 0.0, "ana")}
    assert read_foreign(path).left_out == {"empty: not labelled": 2}


def test_deeplabcut_with_paths_in_one_column(tmp_path: Path) -> None:
    assert taken(written(tmp_path, OLD_DEEPLABCUT)) == {2: seen(10.25, 20.5, "ana")}


def test_deeplabcut_with_several_animals(tmp_path: Path) -> None:
    path = written(tmp_path, ANIMALS)
    assert taken(path, Choice(point="two/tip")) == {2: seen(1.0, 2.0, "ana")}
    single = written(tmp_path, ANIMALS.replace("two", "one").replace("tip,tip\n", "heel,heel\n"))
    assert taken(single, Choice(point="tip")) == {2: seen(10.25, 20.5, "ana")}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (OLD_DEEPLABCUT.replace("x,y", "x,y,likelihood"), "a network placed these points"),
        (OLD_DEEPLABCUT.replace("coords,x,y\n", ""), "KeyError"),
        (OLD_DEEPLABCUT.replace("x,y", "y,x"), "expected x, y"),
        (OLD_DEEPLABCUT.replace("10.25,", ""), "not as DeepLabCut writes it"),
        (OLD_DEEPLABCUT.replace("10.25", "ten"), "ten"),
        (OLD_DEEPLABCUT.replace("coords,x,y", "coords"), "not as DeepLabCut writes it"),
    ],
)
def test_deeplabcut_that_cannot_be_taken(text: str, message: str, tmp_path: Path) -> None:
    assert message in str(refusal(lambda: taken(written(tmp_path, text))))


# All of them.


@pytest.mark.parametrize("text", ["", "hello", "{}", "7", "{", '{"images": []}', "stamp_ns,u,v"])
def test_a_file_of_no_tool(text: str, tmp_path: Path) -> None:
    message = refusal(lambda: read_foreign(written(tmp_path, text)))
    assert message is not None
    assert message.startswith(str(tmp_path))


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match="cannot be read"):
        read_foreign(tmp_path / "nothing.xml")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TooltipError, match="not UTF-8"):
        read_foreign(tmp_path / "binary")


ROWS: Rows = {
    STAMPS[2]: seen(10.25, 20.5, "ana"),
    STAMPS[3]: seen(0.0, 0.0, "ana"),
    STAMPS[4]: seen(-0.5, 119.5, "ana"),
    STAMPS[7]: TipLabel("occluded", None, "ana"),
    STAMPS[8]: TipLabel("out_of_view", None, "ana"),
}


def album() -> Album:
    frames = [2, 3, 4, 5, 7, 8]  # 5 is not labelled
    shown = (Shown(i, STAMPS[i], f"{STAMPS[i]}.jpg", ROWS.get(STAMPS[i])) for i in frames)
    return Album("pliers", (160, 120), tuple(shown))


@pytest.mark.parametrize("tool", sorted(WRITERS))
def test_what_is_exported_comes_back_the_same(tool: str, tmp_path: Path) -> None:
    content = WRITERS[tool](album())
    if isinstance(content, str):
        path = written(tmp_path, content, "labels")
    else:
        path = tmp_path
        for name, text in content.items():
            written(tmp_path, text, name)
    rows = adopt(read_foreign(path), PLACE, Choice(labeler="ana"))
    states = ("visible",) if tool == "deeplabcut" else ("visible", "occluded", "out_of_view")
    assert rows == {stamp: row for stamp, row in ROWS.items() if row.state in states}


def test_coco_is_exported_without_labels_at_zero() -> None:
    document = json.loads(str(WRITERS["coco"](album())))
    zero = [item for item in document["annotations"] if item["keypoints"] == [0, 0, 0]]
    assert [item["num_keypoints"] for item in zero] == [0, 0]
    assert [item["keypoints"] for item in document["annotations"]][1] == [0.0, 0.0, 2]


# On the command line.


def test_import_writes_the_labels(wrist: Log, tmp_path: Path) -> None:
    path = written(tmp_path, CVAT_VIDEO, "cvat.xml")
    done = tooltip("label", "import", wrist.path, path, "--labeler", "ben")
    assert done.code == 0, done.err
    assert done.out == f"{wrist.labels}\n"
    assert "1 occluded, 2 visible, from CVAT" in done.err
    assert "left out 1 between keyframes" in done.err
    assert dict(rows_of(read_labels(wrist.labels)))[STAMPS[2]] == seen(10.0, 19.75, "ben")
    again = tooltip("label", "import", wrist.path, path)
    assert again.code == 1
    assert again.error.endswith("exists; --force replaces it")
    forced = tooltip("label", "import", wrist.path, path, "--force", "--json")
    assert json.loads(forced.out)["states"] == {"visible": 2, "occluded": 1}


def test_import_waits_for_no_open_page(wrist: Log, tmp_path: Path) -> None:
    path = written(tmp_path, CVAT_VIDEO, "cvat.xml")
    with open_journal(wrist.labels):
        done = tooltip("label", "import", wrist.path, path, "--force")
    assert "being edited" in done.error


def test_import_of_a_second_set(wrist: Log, tmp_path: Path) -> None:
    path = written(tmp_path, CVAT_VIDEO, "cvat.xml")
    assert tooltip("label", "import", wrist.path, path, "--blind").code == 2
    done = tooltip("label", "import", wrist.path, path, "--blind", "--labeler", "ben")
    assert Path(done.out.strip()).name == "wrist.labels.ben.csv"


def test_import_of_nothing_writes_nothing(wrist: Log, tmp_path: Path) -> None:
    path = written(tmp_path, coco([0, 0, 0, 0, 0, 0]), "coco.json")
    done = tooltip("label", "import", wrist.path, path)
    assert "holds no label; left out 2 visibility 0" in done.error
    assert not wrist.labels.exists()


def test_export_and_import_with_the_images(wrist: Log, tmp_path: Path) -> None:
    source = written(tmp_path, CVAT_VIDEO, "cvat.xml")
    tooltip("label", "import", wrist.path, source)
    images = tmp_path / "images"
    out = tmp_path / "tasks.json"
    arguments = ("label", "export", wrist.path, out, "--format", "labelstudio", "--images", images)
    assert tooltip(*arguments).out == f"{out}\n"
    assert sorted(path.name for path in images.iterdir()) == [
        f"{STAMPS[frame]}.jpg" for frame in (2, 4, 5)
    ]
    assert (images / f"{STAMPS[4]}.jpg").read_bytes() == jpeg_of(4)
    assert "exists; --force replaces it" in tooltip(*arguments).error
    before = wrist.labels.read_text()
    assert tooltip("label", "import", wrist.path, out, "--force").code == 0
    assert wrist.labels.read_text() == before


def test_export_without_labels_is_the_test_frames_to_label(wrist: Log, tmp_path: Path) -> None:
    folder = tmp_path / "todo"
    done = tooltip("label", "export", wrist.path, folder, "--format", "labelme")
    assert done.code == 0, done.err
    assert len(list(folder.iterdir())) == 8
