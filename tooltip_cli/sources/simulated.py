"""Recordings of the simulated robot, with the truth beside them."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np

from tooltip_cli.labels.files import TipLabels
from tooltip_cli.log.messages import Message
from tooltip_cli.method.evaluation import split_frames
from tooltip_cli.resources import resource
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.rigfile import Rig, load_rig
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.sim import (
    SimFrame,
    SimParams,
    Simulation,
    render_frames,
    simulate,
    truth,
)
from tooltip_cli.sources.streams import (
    IMAGE_TOPIC,
    image_messages,
    joint_message,
    robot_message,
)

LABEL_NOISE_PX = 1.5
"""Standard deviation of a simulated hand label in u and in v."""
LABELER = "sim"
TRUTH_FILE = "truth.json"
_LABEL_STREAM = 0x1ABE15  # keeps the labels' random numbers apart from the simulation's


class SimSource:
    """A simulated robot that sweeps a tool before its camera.

    Args:
        params: what is simulated.
        jobs: threads that render; the result does not depend on them.

    Raises:
        TooltipError: the simulation cannot be set up.
    """

    def __init__(self, params: SimParams, jobs: int = 1) -> None:
        self._simulation = simulate(params)
        self._jobs = jobs
        self._report = SourceReport()
        self._rendered: list[SimFrame] = []  # without their pictures
        self._camera = _camera(self._simulation)
        bench = load_rig(resource("calib", "bench", "rig.yaml"))
        self._rig = replace(bench, urdf=self._simulation.urdf, camera=self._camera)

    @property
    def frames(self) -> int | None:
        """Number of images."""
        return self._simulation.params.frames

    @property
    def image_topic(self) -> str | None:
        """The topic of the images written."""
        return IMAGE_TOPIC

    @property
    def rig(self) -> Rig | None:
        """The bench robot's rig with the intrinsics of the size simulated."""
        return self._rig

    @property
    def report(self) -> SourceReport:
        """Filled while the messages are taken."""
        return self._report

    def messages(self) -> Iterator[Message]:
        """Yield the robot description, then joint states and images by time."""
        self._rendered.clear()
        first = min(self._simulation.joint_stamps_ns[0], self._simulation.image_stamps_ns[0])
        streams = heapq.merge(self._joints(), self._images(), key=lambda item: item.log_time_ns)
        robot = robot_message(int(first), self._simulation.urdf)
        for message in chain([robot], streams):
            self._report.count(message.topic)
            yield message

    def attachments(self) -> Mapping[str, bytes]:
        """Return the truth, which only evaluation opens."""
        document = truth(self._simulation, self._rendered)
        return {TRUTH_FILE: json.dumps(document).encode()}

    def labels(self) -> TipLabels:
        """Return what a person would have labelled: the test frames, with noise.

        The test frames are those of the default split; asked for after the last message.
        """
        params = self._simulation.params
        width, height = params.size
        test = split_frames(len(self._rendered)).test
        rng = np.random.default_rng([params.seed, _LABEL_STREAM])
        noise = LABEL_NOISE_PX * rng.standard_normal((len(test), 2))
        frames = [self._rendered[index] for index in test]
        seen = np.array([frame.tip_visible for frame in frames])
        # a person cannot point outside the picture
        pixels = np.clip(
            np.array([frame.tip_pixel for frame in frames]) + noise, 0, (width - 1, height - 1)
        )
        return TipLabels(
            stamps_ns=np.array([frame.stamp_ns for frame in frames], dtype=np.int64),
            pixels=np.where(seen[:, None], pixels, np.nan),
            states=tuple(label_state(frame) for frame in frames),
            labelers=(LABELER,) * len(frames),
        )

    def _joints(self) -> Iterator[Message]:
        simulation = self._simulation
        rows = zip(simulation.joint_stamps_ns, simulation.joint_positions, strict=True)
        for stamp_ns, positions in rows:
            yield joint_message(int(stamp_ns), simulation.joint_names, positions.tolist())

    def _images(self) -> Iterator[Message]:
        frame_id = self._rig.camera_frame or "camera"
        for frame in render_frames(self._simulation, self._jobs):
            self._rendered.append(replace(frame, jpeg=b""))
            yield from image_messages(frame.stamp_ns, frame_id, "jpeg", frame.jpeg, self._camera)


def label_state(frame: SimFrame) -> str:
    """Return the label state of a frame: visible, occluded or out_of_view."""
    if frame.tip_visible:
        return "visible"
    return "occluded" if frame.tip_in_view else "out_of_view"


def _camera(simulation: Simulation) -> CameraModel:
    camera = simulation.camera
    return CameraModel.create(
        width=camera.width,
        height=camera.height,
        matrix=camera.matrix,
        distortion_model="plumb_bob",
        distortion=camera.distortion,
        source="the simulated camera",
    )
