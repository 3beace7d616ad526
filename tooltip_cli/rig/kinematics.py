"""The kinematic chain from the camera to the hand, through Pinocchio."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError, one_of

Array = npt.NDArray[np.float64]

_MAX_URDF_BYTES = 32 * 2**20
_MAX_REACH_M = 1e6


@dataclass(frozen=True)
class Mount:
    """A camera fixed to a frame that the robot description has, at a pose that it lacks."""

    parent: str  # frame name
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)  # metres
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)  # radians, fixed-axis roll, pitch, yaw

    @classmethod
    def at(cls, parent: str, parent_from_camera: Array) -> Mount:
        """Return the mount at a pose (4, 4)."""
        r = parent_from_camera[:3, :3]
        pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
        # at a pitch of 90 degrees roll and yaw turn about the same axis: roll stands for both
        upright = np.hypot(r[0, 0], r[1, 0]) > 1e-9
        roll = np.arctan2(r[2, 1], r[2, 2]) if upright else np.arctan2(-r[1, 2], r[1, 1])
        yaw = np.arctan2(r[1, 0], r[0, 0]) if upright else 0.0
        x, y, z = (float(value) for value in parent_from_camera[:3, 3])
        return cls(parent, (x, y, z), (float(roll), float(pitch), float(yaw)))

    @property
    def parent_from_camera(self) -> Array:
        """(4, 4) transform."""
        transform = np.eye(4)
        transform[:3, :3] = rotation_from_rpy(self.rpy)
        transform[:3, 3] = self.xyz
        return transform


def rotation_from_rpy(rpy: Sequence[float]) -> Array:
    """Return (3, 3) Rz(yaw) Ry(pitch) Rx(roll), the URDF's and REP 103's fixed-axis convention."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_from_quaternion(quaternion_xyzw: npt.ArrayLike) -> Array:
    """Return (..., 3, 3) rotations for (..., 4) quaternions (x, y, z, w) of any norm but zero."""
    q = np.asarray(quaternion_xyzw, dtype=float)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return (..., 4) unit quaternions (x, y, z, w) with w >= 0 for (..., 3, 3) rotations.

    The largest of the four components is taken from the diagonal, the others from what is
    symmetric and antisymmetric about it (Shepperd's method), which no angle makes inexact.
    """
    m = np.asarray(rotation, dtype=float)
    diagonal = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    trace = diagonal.sum(axis=-1)
    squares = np.concatenate([2 * diagonal - trace[..., None], trace[..., None]], axis=-1) + 1
    q = np.empty((*squares.shape, 4))  # four candidates, each from another component
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        q[..., i, i] = squares[..., i]
        q[..., i, j] = q[..., j, i] = m[..., i, j] + m[..., j, i]
        q[..., i, 3] = q[..., 3, i] = m[..., k, j] - m[..., j, k]
    q[..., 3, 3] = squares[..., 3]
    best = np.argmax(squares, axis=-1)
    chosen = np.take_along_axis(q, best[..., None, None], axis=-2)[..., 0, :]
    chosen = np.where(chosen[..., 3:] < 0, -chosen, chosen)
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))


def inverse_transform(transform: Array) -> Array:
    """Return the inverse of (..., 4, 4) rigid transforms."""
    rotation = np.swapaxes(transform[..., :3, :3], -1, -2)
    inverse = np.zeros_like(transform)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, transform[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


@dataclass(frozen=True)
class KinematicChain:
    """Joints between a camera and a hand, and the transform between them."""

    joint_names: tuple[str, ...]  # movable joints that the transform depends on
    _model: Any = field(repr=False)
    _camera_frame_id: int
    _hand_frame_id: int
    _frame_from_camera: Array = field(repr=False)  # (4, 4); identity when the URDF has the camera
    _columns: tuple[tuple[int, int], ...]  # per joint name: (index in q, nq)

    @classmethod
    def from_urdf(
        cls, urdf: str, camera_frame: str, hand_frame: str, mount: Mount | None, source: str
    ) -> KinematicChain:
        """Build the chain from URDF text.

        Args:
            camera_frame: the optical frame; with ``mount`` only a name.
            source: what to call the URDF in messages.

        Raises:
            TooltipError: not a URDF, a frame it lacks, or a chain that nothing moves.
        """
        import pinocchio

        model = build_model(pinocchio, urdf, source)
        start = mount.parent if mount else camera_frame
        frame_ids = []
        for kind, name in (("camera", start), ("hand", hand_frame)):
            # getFrameId answers an unknown name with a number, so ask first
            body = pinocchio.FrameType.BODY
            if not model.existFrame(name, body):
                links = [frame.name for frame in model.frames if frame.type == body]
                raise TooltipError(f"{source}: " + one_of(f"{kind} frame", name, links))
            frame_ids.append(model.getFrameId(name, body))
        names, columns = _chain_joints(model, frame_ids[0], frame_ids[1], source)
        if not names:
            raise TooltipError(
                f"{source}: no movable joint lies between the frames '{start}' and "
                f"'{hand_frame}', so the hand never moves before the camera; check the rig's "
                "camera and hand frames"
            )
        fixed = mount.parent_from_camera if mount else np.eye(4)
        chain = cls(names, model, frame_ids[0], frame_ids[1], fixed, columns)
        transform = chain.hand_from_camera(np.full((1, len(names)), 0.5))[0]
        rotation, translation = transform[:3, :3], transform[:3, 3]
        # Pinocchio takes an axis of zero length as it is, which makes the rotation none
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        if not rigid or np.abs(translation).max() > _MAX_REACH_M:
            raise TooltipError(
                f"{source}: the transform between '{start}' and '{hand_frame}' is not rigid; one "
                f"of the joints {', '.join(names)} has an axis or origin that no robot has"
            )
        return chain

    @property
    def limits(self) -> Array:
        """(J, 2) lowest and highest position of each joint, rad or m; infinite where none is."""
        limits = np.full((len(self.joint_names), 2), (-np.inf, np.inf))
        for row, (column, size) in enumerate(self._columns):
            if size == 1:
                limits[row] = (
                    self._model.lowerPositionLimit[column],
                    self._model.upperPositionLimit[column],
                )
        return limits

    def hand_from_camera(self, positions: npt.ArrayLike) -> Array:
        """Return the transform T_c of the paper for each configuration.

        Args:
            positions: (N, J) joint positions in the order of ``joint_names``, rad or m.

        Returns:
            (N, 4, 4); NaN where a position is not finite.
        """
        return self.camera_poses(positions)[0]

    def camera_poses(self, positions: npt.ArrayLike) -> tuple[Array, Array]:
        """Return where the camera is, seen from the hand and from the robot's root.

        Args:
            positions: (N, J) joint positions in the order of ``joint_names``, rad or m.

        Returns:
            hand_from_camera and root_from_camera, (N, 4, 4); NaN where a position is not finite.
            Joints that camera and hand hang on together count as still.
        """
        import pinocchio

        positions = np.asarray(positions, dtype=float).reshape(-1, len(self.joint_names))
        data = self._model.createData()
        q = pinocchio.neutral(self._model)
        from_hand, from_root = np.full((2, len(positions), 4, 4), np.nan)
        for row, configuration in enumerate(positions):
            if not np.isfinite(configuration).all():
                continue
            for (column, size), value in zip(self._columns, configuration, strict=True):
                if size == 2:  # continuous joints are stored as cosine and sine
                    q[column], q[column + 1] = np.cos(value), np.sin(value)
                else:
                    q[column] = value
            pinocchio.forwardKinematics(self._model, data, q)
            camera = pinocchio.updateFramePlacement(self._model, data, self._camera_frame_id)
            hand = pinocchio.updateFramePlacement(self._model, data, self._hand_frame_id)
            from_hand[row] = hand.actInv(camera).homogeneous
            from_root[row] = camera.homogeneous
        return from_hand @ self._frame_from_camera, from_root @ self._frame_from_camera


def build_model(pinocchio: Any, urdf: str, source: str) -> Any:
    """Return Pinocchio's model of a URDF, which must declare no document type and no entities.

    Raises:
        TooltipError: it does, or Pinocchio cannot read it.
    """
    if len(urdf) > _MAX_URDF_BYTES:
        raise TooltipError(f"{source}: the URDF has {len(urdf)} characters, too many to be one")
    if re.search(r"<!(DOCTYPE|ENTITY)", urdf, re.IGNORECASE):
        raise TooltipError(f"{source}: the URDF declares a document type or entities; remove them")
    with _captured_stderr() as captured:
        try:
            # Pinocchio reads bytes up to the first NUL and the declaration must be first
            return pinocchio.buildModelFromXML(urdf.strip(), mimic=True)
        except Exception as error:  # the C++ parser raises several unrelated types
            detail = " ".join(f"{captured.read()} {error}".split())[:300]
            raise TooltipError(
                f"{source}: not a URDF that Pinocchio can read ({detail})"
            ) from error


class _Captured:
    def __init__(self, file: Any) -> None:
        self._file = file

    def read(self) -> str:
        self._file.seek(0)
        text = self._file.read().decode("utf-8", "replace")
        return re.sub(r"\x1b\[[0-9;]*m|at line \d+ in \S+", "", text)


@contextmanager
def _captured_stderr() -> Iterator[_Captured]:
    """Catch what the C++ URDF parser prints, which would otherwise reach the terminal."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        saved = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield _Captured(file)
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _chain_joints(
    model: Any, camera_id: int, hand_id: int, source: str
) -> tuple[tuple[str, ...], tuple[tuple[int, int], ...]]:
    """Return names and places in q of the movable joints on one frame's way to the other."""
    supports = [set(model.supports[model.frames[i].parentJoint]) for i in (camera_id, hand_id)]
    names: list[str] = []
    columns: list[tuple[int, int]] = []
    for joint in sorted(supports[0] ^ supports[1]):
        model_joint = model.joints[joint]
        index = joint
        if model_joint.nq == 0:  # a mimic joint follows another, whose place in q it names
            index = next(
                other
                for other in range(1, model.njoints)
                if model.joints[other].nq and model.joints[other].idx_q == model_joint.idx_q
            )
            model_joint = model.joints[index]
        name = model.names[index]
        if model_joint.nv != 1:
            raise TooltipError(
                f"{source}: joint '{name}' between camera and hand has {model_joint.nv} degrees of "
                "freedom; only revolute, continuous and prismatic joints can be read from a log"
            )
        if name not in names:
            names.append(name)
            columns.append((model_joint.idx_q, model_joint.nq))
    return tuple(names), tuple(columns)
