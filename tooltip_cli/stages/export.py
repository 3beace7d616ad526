"""The export stage: the estimate where people take it next."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tooltip_cli.errors import RefusedError, TooltipError
from tooltip_cli.log.ply import write_ply
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.scene import transform_stamped
from tooltip_cli.log.views import Views, resolve_rig, resolve_urdf, resolve_views
from tooltip_cli.log.whole import check_absent
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.types import Array, TipEstimate
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.volume import agreed_points, reconstruct
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.rig.tool_tip import TIP_LINK, urdf_with_tip
from tooltip_cli.stages.artifacts import write_whole
from tooltip_cli.stages.calibrate import rig_of
from tooltip_cli.stages.estimate import Estimated, estimate_from_images
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.memory import ONE_RECORDING, give_back_large_arrays
from tooltip_cli.stages.voting import gather_votes

_CLOUD_VOXEL = 0.004  # metres
_CLOUD_FRAMES = 4  # that must agree on a point


@dataclass(frozen=True)
class Result:
    """A recording with its estimate, which may be a refusal."""

    recording: Recording
    rig: Rig  # put right, where the estimate says so
    views: Views
    given: Views  # by the rig as it is, as detections are
    estimated: Estimated
    preset: str = "voting"  # which detections it takes, as in `estimate_from_images`

    @property
    def position(self) -> Array:
        """(3,) the tip, metres, hand frame.

        Raises:
            RefusedError: there is no trustworthy one.
        """
        estimate = self.estimated.estimate
        if estimate.position is None:
            reasons = "; ".join(f"{reason.code}: {reason.text}" for reason in estimate.reasons)
            raise RefusedError(f"{self.recording.path} has no estimate to export ({reasons})")
        return estimate.position


def open_result(
    path: Path,
    *,
    rig: Path | None = None,
    topics: Topics | None = None,
    params: EstimatorParams | None = None,
    preset: str = "voting",
    out: Path | None = None,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
) -> Result:
    """Read a recording and its estimate, which is made first where it is missing or out of date.

    Args:
        out: directory of the results; default: beside the recording.

    Raises:
        TooltipError: anything wrong with the inputs.
    """
    give_back_large_arrays(ONE_RECORDING)
    recording = read_recording(path, topics or Topics())
    resolved = resolve_rig(recording, rig)
    views = resolve_views(recording, resolved)
    allowed = unlabelled(recording, views.camera, out)
    estimated = estimate_from_images(
        recording,
        resolved,
        views,
        params or EstimatorParams(),
        allowed,
        preset=preset,
        out=out,
        jobs=jobs,
        on_pair=on_pair,
    )
    by = rig_of(recording, resolved, views, estimated.estimate.refinement)
    return Result(recording, *by, views, estimated, preset)


def export_urdf(result: Result, path: Path, *, overwrite: bool = False) -> None:
    """Write the robot with the link ``tool_tip`` fixed to the hand.

    Raises:
        TooltipError: no robot description, one that has such a link, or the file cannot be
            written.
        RefusedError: there is no estimate.
    """
    check_absent(path, overwrite=overwrite)
    if result.recording.pose_topic or result.rig.pose_topic:
        raise TooltipError(
            f"{result.recording.path} logs hand poses, so there is no URDF to add the tip to; "
            "take --tf instead"
        )
    urdf, source = resolve_urdf(result.recording, result.rig)
    write_whole(path, urdf_with_tip(urdf, result.rig.hand_frame, result.position, source))


def export_cloud(
    result: Result,
    path: Path,
    *,
    overwrite: bool = False,
    out: Path | None = None,
    jobs: int = 1,
) -> int:
    """Write what was voted, hand and tool in the hand frame, as a PLY point cloud.

    Grey: few frames show it; white: all do. The tip is a red point of its own, if there is one.

    Returns:
        the number of points.

    Raises:
        RefusedError: the hand's motion shows nothing.
        TooltipError: the file exists or cannot be written.
    """
    check_absent(path, overwrite=overwrite)
    settings = VotingSettings()
    allowed = unlabelled(result.recording, result.given.camera, out)
    votes = gather_votes(result.recording, result.given, settings, allowed, out=out, jobs=jobs)
    if isinstance(votes, TipEstimate):
        raise RefusedError(f"{result.recording.path} shows no shape: {votes.reasons[0].text}")
    cloud = reconstruct(votes.seen_by(result.views, settings), settings.voting)
    points, frames = agreed_points(cloud.points, cloud.frames, _CLOUD_VOXEL, _CLOUD_FRAMES)
    shade = 60 + 195 * np.minimum(frames / max(float(np.quantile(frames, 0.99)), 1.0), 1.0)
    colors = np.repeat(shade.astype(np.uint8)[:, None], 3, axis=1)
    tip = result.estimated.estimate.position
    if tip is not None:
        points, frames = np.vstack([points, tip]), np.append(frames, cloud.frame_count)
        colors = np.vstack([colors, np.array([[255, 0, 0]], dtype=np.uint8)])
    frame = result.rig.hand_frame
    write_ply(
        path, points, colors, frames, f"metres, frame {frame}, from {result.recording.path.name}"
    )
    return len(points)


def tip_transform(result: Result) -> dict[str, Any]:
    """Return the ``geometry_msgs/TransformStamped`` from the hand to the tip.

    The tip has the hand's orientation: what is estimated is a point.

    Raises:
        RefusedError: there is no estimate.
    """
    hand_from_tip = np.eye(4)
    hand_from_tip[:3, 3] = np.round(result.position, 6)  # micrometres are enough for anybody
    return transform_stamped(0, result.rig.hand_frame, TIP_LINK, hand_from_tip)


def transform_text(transform: dict[str, Any]) -> str:
    """Return the command that publishes a transform, and the same as YAML, as two YAML documents.

    Source: ``static_transform_publisher``, ROS 2 Humble and later.
    """
    translation = transform["transform"]["translation"]
    rotation = transform["transform"]["rotation"]
    options = {
        **{f"--{axis}": repr(translation[axis]) for axis in "xyz"},
        **{f"--q{axis}": repr(rotation[axis]) for axis in "xyzw"},
        "--frame-id": transform["header"]["frame_id"],
        "--child-frame-id": transform["child_frame_id"],
    }
    words = [word for name, value in options.items() for word in (name, shlex.quote(value))]
    command = "ros2 run tf2_ros static_transform_publisher " + " ".join(words)
    return f"{command}\n---\n{yaml.safe_dump(transform, sort_keys=False)}"
