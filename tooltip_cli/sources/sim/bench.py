"""The simulated robot: its URDF, its camera, where its links are, and how it holds the hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio
import yaml

from tooltip_cli.errors import TooltipError
from tooltip_cli.resources import resource
from tooltip_cli.sources.sim.mesh import Floats

HEAD = (
    "neck_pitch", "neck_roll", "neck_yaw", "head_pitch", "head_yaw", "eye_tilt", "eye_pan",
)  # fmt: skip
ARM = ("shoulder_pitch", "shoulder_roll", "upper_arm_yaw", "elbow_pitch")
WRIST = ("wrist_pitch", "wrist_roll")
EXTRA = ("gripper",)  # logged, but in no chain from camera to hand
JOINTS = HEAD + ARM + WRIST + EXTRA
LINKS = ("upper_arm", "forearm", "wrist", "hand")  # what the camera sees
CAMERA_FRAME = "camera_optical_frame"
HAND_FRAME = "hand"


@dataclass(frozen=True)
class Intrinsics:
    """A distortion-free pinhole camera; integer pixel coordinates at pixel centres."""

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # plumb_bob

    def project(self, points: Floats) -> Floats:
        """Return the (..., 2) pixels of (..., 3) points in the camera frame, m."""
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    @property
    def matrix(self) -> Floats:
        """The 3x3 camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


def load_intrinsics(size: tuple[int, int]) -> Intrinsics:
    """Return the bench camera for an image of ``size`` (width, height).

    The field of view keeps its width; the image centre keeps its offset.
    """
    text = resource("calib", "bench", "camera.yaml").read_text(encoding="utf-8")
    info = yaml.safe_load(text)
    fx, _, cx, _, fy, cy, *_ = info["camera_matrix"]["data"]
    width, height = size
    scale = width / info["image_width"]
    return Intrinsics(
        width,
        height,
        fx * scale,
        fy * scale,
        0.5 * (width - 1) + scale * (cx - 0.5 * (info["image_width"] - 1)),
        0.5 * (height - 1) + scale * (cy - 0.5 * (info["image_height"] - 1)),
    )


def load_urdf() -> str:
    """Return the text of the bench robot's URDF."""
    return resource("calib", "bench", "bench.urdf").read_text(encoding="utf-8")


class Bench:
    """Forward kinematics of the bench robot through pinocchio."""

    def __init__(self, urdf: str) -> None:
        self._model = pinocchio.buildModelFromXML(urdf)
        missing = [link for link in (*LINKS, CAMERA_FRAME) if not self._model.existFrame(link)]
        missing += [joint for joint in JOINTS if not self._model.existJointName(joint)]
        if missing:
            raise TooltipError(f"calib/bench/bench.urdf lacks {', '.join(missing)}")
        self._data = self._model.createData()
        self._column = [self._model.joints[self._model.getJointId(joint)].idx_q for joint in JOINTS]
        self._frames = {
            link: self._model.getFrameId(link) for link in (*LINKS, CAMERA_FRAME)
        }  # existence was checked above: getFrameId answers unknown names with a number

    def base_from(self, positions: Floats, links: Sequence[str]) -> dict[str, Floats]:
        """Return (4, 4) base_from_link for joint positions in the order of ``JOINTS``, rad."""
        q = np.zeros(self._model.nq)
        q[self._column] = positions
        pinocchio.framesForwardKinematics(self._model, self._data, q)
        return {
            link: np.array(self._data.oMf[self._frames[link]].homogeneous, dtype=np.float64)
            for link in links
        }

    def camera_from(self, positions: Floats, links: Sequence[str]) -> dict[str, Floats]:
        """Return (4, 4) camera_from_link for joint positions in the order of ``JOINTS``, rad."""
        poses = self.base_from(positions, (*links, CAMERA_FRAME))
        camera_from_base = inverse(poses[CAMERA_FRAME])
        return {link: camera_from_base @ poses[link] for link in links}

    def limits(self, joints: Sequence[str]) -> tuple[Floats, Floats]:
        """Return the lower and upper limits of joints, rad."""
        columns = [self._column[JOINTS.index(joint)] for joint in joints]
        return (
            np.asarray(self._model.lowerPositionLimit, dtype=np.float64)[columns],
            np.asarray(self._model.upperPositionLimit, dtype=np.float64)[columns],
        )


def inverse(transform: Floats) -> Floats:
    """Return the inverse of a rigid (4, 4) transform."""
    result = np.eye(4)
    result[:3, :3] = transform[:3, :3].T
    result[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return result


@dataclass(frozen=True)
class Posture:
    """Where the arm should hold the wrist, seen from the resting head (x forward, y left, z up)."""

    wrist: tuple[float, float, float]  # from the camera, base axes, m
    forearm: tuple[float, float, float]  # direction from elbow to wrist, base axes


REST = {"neck_pitch": 0.12, "head_pitch": 0.18, "elbow_pitch": 1.6, "shoulder_pitch": 0.2}


def reach(bench: Bench, posture: Posture) -> Floats:
    """Return joint positions (J,) that bring the arm as near to a posture as four joints can."""
    start = np.array([REST.get(joint, 0.0) for joint in JOINTS])
    camera = bench.base_from(start, (CAMERA_FRAME,))[CAMERA_FRAME][:3, 3]

    def residual(q: Floats) -> Floats:
        pose = bench.base_from(q, (HAND_FRAME,))[HAND_FRAME]
        return np.concatenate(
            [
                (pose[:3, 3] - camera - posture.wrist) / 0.03,
                (pose[:3, 2] - _unit(posture.forearm)) / 0.25,
            ]
        )

    return solve(bench, residual, start, ARM)


def look_at(
    bench: Bench, positions: Floats, sweep: Sequence[tuple[float, float]], carried: Floats,
    camera: Intrinsics,
) -> Floats:  # fmt: skip
    """Turn the eye so that what the hand carries through its sweep is centred in the image.

    Args:
        bench: the robot.
        positions: (J,) joint positions to start from, rad.
        sweep: wrist pitch and roll, rad, at the corners of the sweep and between them.
        carried: (n, 3) points in the hand frame that should be seen, m.
        camera: intrinsics.
    """

    def residual(q: Floats) -> Floats:
        pixels = []
        for wrist in sweep:
            pose = bench.camera_from(with_joints(q, WRIST, wrist), (HAND_FRAME,))[HAND_FRAME]
            pixels.append(camera.project(carried @ pose[:3, :3].T + pose[:3, 3]))
        seen = np.vstack(pixels)
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
        off = middle - 0.5 * np.array([camera.width - 1, camera.height - 1])
        return np.asarray(off / camera.fx)

    return solve(bench, residual, positions, ("eye_tilt", "eye_pan"))


def face_pitch_axis(bench: Bench, positions: Floats, distance: float) -> Floats:
    """Bring the wrist's pitch axis onto the optical axis, through the camera's centre.

    Turning about that axis moves the hand in the image plane alone (paper, section 4.4).

    Args:
        bench: the robot.
        positions: (J,) joint positions to start from, rad.
        distance: wanted distance from camera to wrist, m.
    """

    def residual(q: Floats) -> Floats:
        pose = bench.camera_from(q, (HAND_FRAME,))[HAND_FRAME]
        exact = 1e4 * np.concatenate([pose[:2, 1], pose[:2, 3]])
        # The rest only picks one of the many solutions, hence the weights.
        return np.concatenate([exact, [(pose[2, 3] - distance) / 0.05, pose[1, 2] + 0.7]])

    return solve(bench, residual, positions, (*ARM, "eye_tilt", "eye_pan"))


def with_joints(positions: Floats, joints: Sequence[str], values: Sequence[float]) -> Floats:
    """Return a copy of (J,) positions with some joints set."""
    result: Floats = np.array(positions)
    result[[JOINTS.index(joint) for joint in joints]] = values
    return result


def solve(
    bench: Bench, residual: Callable[[Floats], Floats], start: Floats, joints: Sequence[str]
) -> Floats:
    """Minimise a residual over some joints within their limits (Levenberg-Marquardt)."""
    columns = [JOINTS.index(joint) for joint in joints]
    low, high = bench.limits(joints)
    q: Floats = np.array(start)
    damping = 1e-3
    value = residual(q)
    for _ in range(200):
        jacobian = np.empty((len(value), len(columns)))
        for k, column in enumerate(columns):
            ahead, behind = q.copy(), q.copy()
            ahead[column] += 1e-6
            behind[column] -= 1e-6
            jacobian[:, k] = (residual(ahead) - residual(behind)) / 2e-6
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(
            normal + damping * np.diag(np.diag(normal) + 1e-9), -jacobian.T @ value
        )
        trial = q.copy()
        trial[columns] = np.clip(q[columns] + step, low, high)
        trial_value = residual(trial)
        if trial_value @ trial_value < value @ value:
            q, value, damping = trial, trial_value, max(damping * 0.3, 1e-12)
        else:
            damping *= 8.0
        if np.abs(step).max() < 1e-10 or damping > 1e10:
            break
    return q


def _unit(vector: Sequence[float]) -> Floats:
    value = np.asarray(vector, dtype=np.float64)
    return np.asarray(value / np.linalg.norm(value))
