"""Inputs that nobody meant to be read, and the readers that must survive them."""

from __future__ import annotations

import contextlib
import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tests.helpers.logs import (
    encoded,
    image_of,
    jpeg_of,
    stamp_of,
    wrist_parts,
    write_log,
)
from tests.helpers.robot import CAMERA, CAMERA_FRAME, HAND_FRAME, RIG, TIP, URDF
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import match_labels, read_labels
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.detections import read_detections, write_detections
from tooltip_cli.log.edges import read_edges, write_edges
from tooltip_cli.log.images import decode_compressed, decode_raw
from tooltip_cli.log.messages import Message, schema_text
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.salvage import salvage
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.detector import Detections
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.rig.camera import camera_yaml, load_camera_yaml
from tooltip_cli.rig.kinematics import KinematicChain
from tooltip_cli.rig.rigfile import load_rig, rig_files
from tooltip_cli.rig.tool_tip import urdf_with_tip
from tooltip_cli.sources.bag import BagSource
from tooltip_cli.sources.tables import read_image_stamps, read_joints, read_poses
from tooltip_cli.stages.artifacts import read_json
from tooltip_cli.stages.estimate import estimate_from_document
from tooltip_cli.stages.info import inspect

FRAMES = 4
_STAMPS = np.array([stamp_of(i) for i in range(FRAMES)], dtype=np.int64)
_INTEGERS = tuple(2**bits + step for bits in (0, 7, 8, 15, 16, 31, 32, 62, 63) for step in (-1, 0))
_WORDS = (
    *(b"nan", b"-inf", b"1e999", b"-0", b"99999999999999999999", b"9" * 400, b"0x10", b"12:30:45"),
    *(
        b"''",
        b'"',
        b"null",
        b"true",
        b"[]",
        b"{}",
        b"? ",
        b": ",
        b"- ",
        b"\n",
        b"\r",
        b",",
        b",,,,",
    ),
    *(b"&a [*a]", b"*a", b"<<: *a", b"!!python/object/apply:os.system ['true']"),
    *(b"<!DOCTYPE r [<!ENTITY a 'b'>]>", b"&a;", b"<robot/>", b"</robot>", b"<link name='base'/>"),
    *(b"<![CDATA[", b"<!--", b"../../../etc/passwd", b"[" * 300, b"{a: " * 300, b"<a>" * 300),
    *(b"\0", b"\xff\xfe", "\u2028\u0000\ud7ff".encode()),
)


@dataclass(frozen=True)
class Target:
    """A reader, and good inputs for it."""

    suffix: str
    seeds: tuple[bytes, ...]
    read: Callable[[Path], Any]
    text: bool = False


def mutate(data: bytes, others: tuple[bytes, ...], rng: random.Random, *, text: bool) -> bytes:
    """Return an input with one to eight changes."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 5, 8))):
        _change(changed, others, rng, text)
    return bytes(changed)


def _change(data: bytearray, others: tuple[bytes, ...], rng: random.Random, text: bool) -> None:
    place = rng.randrange(len(data) + 1)
    span = min(rng.choice((1, 2, 4, 8, 30, 200, 5000)), len(data) - place)
    kind = rng.randrange(8 if text else 7)
    if kind == 0 and place < len(data):
        data[place] ^= 1 << rng.randrange(8)
    elif kind == 1:
        width = rng.choice((1, 2, 4, 8))
        number = rng.choice(_INTEGERS) % 256**width
        data[place : place + width] = number.to_bytes(width, rng.choice(("little", "big")))
    elif kind == 2:
        del data[place : place + span]
    elif kind == 3:
        data[place:place] = data[place : place + span] * rng.choice((1, 2, 20))
    elif kind == 4:
        del data[place:]
    elif kind == 5:
        other = rng.choice(others)
        start = rng.randrange(len(other) + 1)
        data[place : place + span] = other[start : start + span]
    elif kind == 6:
        data[place:place] = rng.randbytes(rng.choice((1, 3, 9, 64)))
    else:
        data[place : place + span] = rng.choice(_WORDS)


def attempt(target: Target, data: bytes, folder: Path) -> str | None:
    """Read an input; return the one line that refuses it, None where it is read."""
    path = folder / f"input{target.suffix}"
    path.write_bytes(data)
    try:
        target.read(path)
    except TooltipError as error:
        return str(error)
    return None


def _read_all(path: Path) -> None:
    recording = read_recording(path)
    list(recording.images(range(len(recording.image_stamps_ns))))


def _views(path: Path) -> None:
    recording = read_recording(path)
    resolve_views(recording, resolve_rig(recording, None))


def _import_bag(path: Path) -> None:
    for _ in BagSource(path).messages():
        pass


def _chain(path: Path) -> None:
    chain = KinematicChain.from_urdf(
        path.read_text("utf-8", "replace"), CAMERA_FRAME, HAND_FRAME, None, "urdf"
    )
    chain.hand_from_camera(np.zeros((2, len(chain.joint_names))))


def _tip_link(path: Path) -> None:
    urdf_with_tip(path.read_text("utf-8", "replace"), HAND_FRAME, TIP, "urdf")


def _tip(path: Path) -> None:
    document = read_json(path)
    if document is not None:
        # what the stage takes for "not ours" and makes anew
        with contextlib.suppress(KeyError, TypeError):
            estimate_from_document(document, path)


def _compressed(path: Path) -> None:
    data = path.read_bytes()
    message = messages.decode(
        messages.COMPRESSED_IMAGE, messages.compressed_image(0, "c", "jpeg", data)
    )
    decode_compressed(message, False, "image")


def _raw(path: Path) -> None:
    try:
        message = messages.decode(messages.IMAGE, path.read_bytes())
    except Exception as error:  # as where logs are read
        raise TooltipError("no image") from error
    decode_raw(message, False, "image")


def _messages() -> list[Message]:
    return list(itertools.chain(*wrist_parts(FRAMES).values()))


def _unchecked(log: bytes, folder: Path, compression: CompressionType, *, chunked: bool) -> bytes:
    """Return a log without any checksum, so that changes reach what lies behind them."""
    source, path = folder / "source.mcap", folder / "unchecked.mcap"
    source.write_bytes(log)
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            compression=compression,
            use_chunking=chunked,
            chunk_size=20_000,
            enable_crcs=False,
        )
        writer.start("ros2", "fuzz")
        channels: dict[str, int] = {}
        for item in iterate(source):
            if isinstance(item, LoggedAttachment):
                writer.add_attachment(0, 0, item.name, item.media_type, item.data)
                continue
            if item.topic not in channels:
                text = schema_text(item.datatype).encode()
                schema = writer.register_schema(item.datatype, "ros2msg", text)
                channels[item.topic] = writer.register_channel(item.topic, "cdr", schema)
            writer.add_message(
                channels[item.topic], item.log_time_ns, item.payload, item.publish_time_ns
            )
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    return path.read_bytes()


def _detections(folder: Path) -> bytes:
    count = FRAMES - 1
    detections = Detections(
        frames=np.arange(count),
        partners=np.arange(1, FRAMES),
        pixels=np.full((count, 2), 20.5),
        weights=np.ones(count),
        affines=np.ones((count, 2, 3)),
        edges=np.full(count, 9),
        background_edges=np.full(count, 7),
        flags=((), ("few_edges",), ()),
    )
    write_detections(folder / "d.mcap", detections, _STAMPS, "camera", {"key": "k"})
    return (folder / "d.mcap").read_bytes()


def _edges(folder: Path) -> bytes:
    edges = MovingEdges(
        frames=np.arange(1, 3),
        partners=np.array([[0, 2], [1, 3]]),
        affines=np.ones((2, 2, 2, 3)),
        counts=np.array([2, 1]),
        pixels=np.ones((3, 2), np.uint16),
        translations=np.ones((3, 2, 2), np.int8),
        covariances=np.ones((3, 2, 3), np.float32),
    )
    write_edges(folder / "e.mcap", edges, _STAMPS, "camera", {"key": "k"})
    return (folder / "e.mcap").read_bytes()


_TIP_JSON = b"""{"status": "ok", "tip": {"frame": "hand", "position_m": [0.1, 0.0, 0.2],
"covariance_m2": [[1e-6, 0, 0], [0, 1e-6, 0], [0, 0, 1e-6]]}, "candidates": [{"position_m":
[0.1, 0.0, 0.2], "support": 0.9, "axis": [0, 0, 1]}], "reasons": [{"code": "a", "text": "b"}],
"method": "kmeans", "frames_used": 4, "provenance": {"key": "k"}}"""


def targets(folder: Path) -> dict[str, Target]:
    """Return every reader by name; ``folder`` is for making the good inputs."""
    ours = write_log(folder / "ours.mcap", _messages()).read_bytes()
    logs = (
        ours,
        _unchecked(ours, folder, CompressionType.NONE, chunked=True),
        _unchecked(ours, folder, CompressionType.NONE, chunked=False),
        _unchecked(ours, folder, CompressionType.LZ4, chunked=True),
        _unchecked(ours, folder, CompressionType.ZSTD, chunked=True),
    )
    detections, edges = (
        (log, _unchecked(log, folder, CompressionType.NONE, chunked=True))
        for log in (_detections(folder), _edges(folder))
    )
    raw = messages.encode(
        messages.IMAGE,
        {"height": 6, "width": 8, "encoding": "bgr8", "step": 24, "data": bytes(144)},
    )
    labels = b"stamp_ns,u,v,state,labeler\n" + b"".join(
        b"%d,%d.5,7,visible,ana\n" % (stamp, i) for i, stamp in enumerate(_STAMPS)
    )
    rig = rig_files(RIG)
    robot = URDF.encode()
    joints = b"stamp_ns,a,b\n" + b"".join(b"%d,0.5,-1e-3\n" % stamp for stamp in _STAMPS)
    poses = b"stamp,x,y,z,qx,qy,qz,qw\n1.5,1,2,3,0,0,0,1\n1.6,1,2,3,0,0.6,0,0.8\n"

    def read_rig(path: Path) -> None:
        for name, text in rig.items():
            if name != "rig.yaml":
                (path.parent / name).write_text(text)
        load_rig(path)

    return {
        "log": Target(".mcap", logs, lambda path: list(iterate(path))),
        "recording": Target(".mcap", logs, _read_all),
        "views": Target(".mcap", logs, _views),
        "salvage": Target(
            ".mcap", logs, lambda path: salvage(path, path.with_name("out.mcap"), overwrite=True)
        ),
        "info": Target(".mcap", logs, inspect),
        "bag import": Target(".mcap", logs, _import_bag),
        "detections": Target(".mcap", detections, lambda path: read_detections(path, _STAMPS)),
        "edges": Target(".mcap", edges, lambda path: read_edges(path, _STAMPS)),
        "compressed image": Target(".bin", (jpeg_of(0), encoded(image_of(1), ".png")), _compressed),
        "raw image": Target(".bin", (raw,), _raw),
        "rig file": Target(".yaml", (rig["rig.yaml"].encode(),), read_rig, text=True),
        "camera file": Target(
            ".yaml",
            (camera_yaml(CAMERA).encode(),),
            lambda path: load_camera_yaml(path.read_text("utf-8", "replace"), "camera"),
            text=True,
        ),
        "URDF": Target(".urdf", (robot,), _chain, text=True),
        "URDF with tip": Target(".urdf", (robot,), _tip_link, text=True),
        "labels": Target(
            ".csv",
            (labels,),
            lambda path: match_labels(read_labels(path), _STAMPS, CAMERA),
            text=True,
        ),
        "joints table": Target(".csv", (joints,), read_joints, text=True),
        "poses table": Target(".csv", (poses,), read_poses, text=True),
        "stamps table": Target(
            ".csv", (b"file,stamp_ns\na.png,5\n",), read_image_stamps, text=True
        ),
        "tip file": Target(".json", (_TIP_JSON,), _tip, text=True),
    }
