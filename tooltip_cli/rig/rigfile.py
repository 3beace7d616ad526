"""The rig file: what a log does not say about camera, hand and joints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.camera import CameraModel, camera_yaml, load_camera_yaml
from tooltip_cli.rig.documents import parse_yaml, shown
from tooltip_cli.rig.kinematics import Mount

_MAX_FILE_BYTES = 32 * 2**20
_MAX_NUMBER = 1e6  # metres or radians: anything larger is a mistake
_MAX_OFFSET_S = 4e9  # from zero to any time that a ROS header can hold; more would overflow


@dataclass(frozen=True)
class Sphere:
    """Part of the hand or wrist, inside which a tip cannot lie (paper, 3.2)."""

    center: tuple[float, float, float]  # metres, hand frame
    radius: float  # metres


@dataclass(frozen=True)
class Rig:
    """A rig file with the files it names read in; what is None comes from the log."""

    hand_frame: str
    camera_frame: str | None = None
    camera: CameraModel | None = None
    mount: Mount | None = None
    urdf: str | None = None
    pose_topic: str | None = None
    spheres: tuple[Sphere, ...] = ()
    joints: Mapping[str, str] = field(default_factory=dict)  # name in the log -> name in the URDF
    time_offset_s: float = 0.0  # seconds to add to image stamps
    source: str = "rig"  # where it was read, for messages


def load_rig(path: Path) -> Rig:
    """Read a rig file and the URDF and camera file that it names.

    Raises:
        TooltipError: a missing or malformed file, an unknown key, a value of the wrong kind.
    """

    def read(name: str) -> str:
        return _read_text(path.parent / name)

    return parse_rig(_read_text(path), read, str(path))


def parse_rig(text: str, read: Callable[[str], str], source: str) -> Rig:
    """Build a rig from YAML text; ``read`` returns the text of a file that it names.

    Raises:
        TooltipError: see :func:`load_rig`.
    """
    keys = ("robot", "camera", "hand", "joints", "time_offset")
    top = _Section(parse_yaml(text, source), source, "", keys)
    camera = _Section(top.get("camera", {}), source, "camera", ("frame", "info", "mount"))
    hand = _Section(top.get("hand"), source, "hand", ("frame", "pose_topic", "spheres"))
    mount = None
    if camera.has("mount"):
        section = _Section(camera.get("mount"), source, "camera.mount", ("parent", "xyz", "rpy"))
        mount = Mount(
            section.text("parent"),
            section.vector("xyz", (0.0, 0.0, 0.0)),
            section.vector("rpy", (0.0, 0.0, 0.0)),
        )
    spheres = hand.get("spheres", [])
    if not isinstance(spheres, list):
        raise TooltipError(f"{source}: hand.spheres must be a list of {{center, radius}}")
    info = camera.text("info") if camera.has("info") else None
    robot = top.text("robot") if top.has("robot") else None
    return Rig(
        hand_frame=hand.text("frame"),
        camera_frame=camera.text("frame") if camera.has("frame") else None,
        camera=load_camera_yaml(read(info), f"{source} ({info})") if info else None,
        mount=mount,
        urdf=read(robot) if robot else None,
        pose_topic=hand.text("pose_topic") if hand.has("pose_topic") else None,
        spheres=tuple(_sphere(item, source, index) for index, item in enumerate(spheres)),
        joints=_joint_map(top.get("joints", {}), source),
        time_offset_s=top.number("time_offset", 0.0, _MAX_OFFSET_S),
        source=source,
    )


def rig_files(rig: Rig) -> dict[str, str]:
    """Return the rig as files that stand for themselves: rig.yaml, camera.yaml, robot.urdf.

    They are what a recording carries as attachments; reading them back gives the same rig.
    """
    document: dict[str, Any] = {}
    files: dict[str, str] = {}
    if rig.urdf is not None:
        document["robot"] = "robot.urdf"
        files["robot.urdf"] = rig.urdf
    camera: dict[str, Any] = {}
    if rig.camera_frame is not None:
        camera["frame"] = rig.camera_frame
    if rig.camera is not None:
        camera["info"] = "camera.yaml"
        files["camera.yaml"] = camera_yaml(rig.camera)
    if rig.mount is not None:
        camera["mount"] = {
            "parent": rig.mount.parent,
            "xyz": list(rig.mount.xyz),
            "rpy": list(rig.mount.rpy),
        }
    if camera:
        document["camera"] = camera
    document["hand"] = {"frame": rig.hand_frame}
    if rig.pose_topic is not None:
        document["hand"]["pose_topic"] = rig.pose_topic
    document["hand"]["spheres"] = [
        {"center": list(sphere.center), "radius": sphere.radius} for sphere in rig.spheres
    ]
    if rig.joints:
        document["joints"] = dict(rig.joints)
    document["time_offset"] = rig.time_offset_s
    return {"rig.yaml": yaml.safe_dump(document, sort_keys=False), **files}


class _Section:
    """A mapping of the rig file; unknown keys are refused with the known ones."""

    def __init__(self, value: Any, source: str, name: str, known: tuple[str, ...]) -> None:
        self._source, self._prefix = source, f"{name}." if name else ""
        if not isinstance(value, dict):
            what = name or "the rig file"
            raise TooltipError(
                f"{source}: {what} must be a mapping with the keys {', '.join(known)}; "
                f"found {type(value).__name__}"
            )
        unknown = [key for key in value if key not in known]
        if unknown:
            raise TooltipError(
                f"{source}: unknown key '{self._prefix}{unknown[0]}'; known: {', '.join(known)}"
            )
        self._value: dict[str, Any] = value

    def has(self, key: str) -> bool:
        return self._value.get(key) is not None

    def get(self, key: str, default: Any = None) -> Any:
        value = self._value.get(key)
        return default if value is None else value

    def text(self, key: str) -> str:
        value = self._value.get(key)
        if not isinstance(value, str) or not value:
            raise TooltipError(
                f"{self._source}: {self._prefix}{key} must be a name, found {shown(value)}"
            )
        return value

    def number(self, key: str, default: float, limit: float = _MAX_NUMBER) -> float:
        return _number(self.get(key, default), self._source, f"{self._prefix}{key}", limit)

    def vector(
        self, key: str, default: tuple[float, float, float] | None = None
    ) -> tuple[float, float, float]:
        value = self.get(key, default)
        if not isinstance(value, (list, tuple)) or len(value) != 3:
            raise TooltipError(
                f"{self._source}: {self._prefix}{key} must be three numbers, found {shown(value)}"
            )
        x, y, z = (_number(item, self._source, f"{self._prefix}{key}") for item in value)
        return x, y, z


def _number(value: Any, source: str, name: str, limit: float = _MAX_NUMBER) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= limit:
        raise TooltipError(
            f"{source}: {name} must be a number of at most {limit:g}, found {shown(value)}"
        )
    return float(value)


def _sphere(item: Any, source: str, index: int) -> Sphere:
    section = _Section(item, source, f"hand.spheres[{index}]", ("center", "radius"))
    radius = section.number("radius", -1.0)
    if radius <= 0:
        raise TooltipError(f"{source}: hand.spheres[{index}].radius must be positive metres")
    return Sphere(section.vector("center"), radius)


def _joint_map(value: Any, source: str) -> dict[str, str]:
    if not isinstance(value, dict) or not all(
        isinstance(key, str) and isinstance(name, str) for key, name in value.items()
    ):
        raise TooltipError(f"{source}: joints must map names in the log to names in the URDF")
    if len(set(value.values())) != len(value):
        raise TooltipError(f"{source}: joints maps two names of the log to the same joint")
    return dict(value)


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise TooltipError(f"{path}: too large for a rig, camera or URDF file")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise TooltipError(f"{path}: cannot be read ({reason})") from error
