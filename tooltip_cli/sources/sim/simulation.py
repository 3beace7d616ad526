"""One simulated recording without its pictures: the grasp, the motion, the streams, the truth."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tooltip_cli.sources.sim.background import Image, backdrop
from tooltip_cli.sources.sim.bench import (
    HAND_FRAME,
    JOINTS,
    LINKS,
    WRIST,
    Bench,
    Intrinsics,
    Posture,
    face_pitch_axis,
    load_intrinsics,
    load_urdf,
    look_at,
    reach,
)
from tooltip_cli.sources.sim.grasp import Grasp, random_grasp
from tooltip_cli.sources.sim.mesh import Floats
from tooltip_cli.sources.sim.params import SimParams
from tooltip_cli.sources.sim.scene import (
    Geometry,
    Lights,
    Scene,
    build_geometry,
    build_lights,
    build_scene,
)
from tooltip_cli.sources.sim.trajectory import Ramps, random_ramps, rest
from tooltip_cli.sources.sim.visibility import hidden

Stamps = NDArray[np.int64]

START_NS = 1_700_000_000_000_000_000
"""Stamp of the first image of seed 0. Later seeds start a thousand seconds apart, but before the
year 2038, when the seconds of a ROS stamp run out."""
_MARGIN_S = 0.3  # joint states begin before the first image and end after the last
_ATTEMPTS = 24
_ENOUGH_IN_VIEW, _ENOUGH_VISIBLE = 0.97, 0.75


@dataclass(frozen=True)
class Simulation:
    """A recording that is ready to be rendered.

    Time is counted in seconds from the first image's stamp. An image is stamped at the end of
    its exposure, so mid-exposure lies half an exposure before the stamp.
    """

    params: SimParams
    urdf: str
    camera: Intrinsics
    joint_names: tuple[str, ...]  # (J,) shuffled, one of them in no chain
    joint_stamps_ns: Stamps  # (M,)
    joint_positions: Floats  # (M, J) rad, with encoder noise, in the order of joint_names
    image_stamps_ns: Stamps  # (N,)
    tip_hand: Floats  # (3,) m, hand frame
    axis_hand: Floats  # (3,) unit, direction in which the tool ends at its tip, hand frame
    other_ends_hand: Floats  # (E, 3) m, ends as good as the tip, hand frame
    tool_cloud: Floats  # (P, 3) m, the tool's vertices, hand frame
    motion: Mapping[str, Ramps]  # by joint name; the true positions
    bench: Bench
    scene: Scene
    lights: Lights
    backdrop: Image

    @property
    def exposure_s(self) -> float:
        """Duration of an exposure, s."""
        return self.params.shutter / self.params.fps

    @property
    def image_times_s(self) -> Floats:
        """Times (N,) of the images' stamps, s."""
        return np.arange(self.params.frames) / self.params.fps

    @property
    def mid_exposure_s(self) -> Floats:
        """Times (N,) of the middle of each exposure, s."""
        return self.image_times_s - 0.5 * self.exposure_s

    def positions_at(self, times: Floats) -> Floats:
        """Return the true joint positions (K, J) at times (K,), in the order of bench.JOINTS."""
        return joint_positions(self.motion, times)


def joint_positions(motion: Mapping[str, Ramps], times: Floats) -> Floats:
    """Return (K, J) joint positions, rad, in the order of ``bench.JOINTS``."""
    return np.column_stack([motion[joint].at(times) for joint in JOINTS])


def simulate(params: SimParams) -> Simulation:
    """Set up a recording: everything but its pictures.

    Grasp, posture and motion are drawn again, always in the same order, until the tip stays in
    view, as the paper's arm was held so that the tool was visible (section 4.1). Each kind of
    choice has a random stream of its own: other noise or another background leaves grasp and
    motion as they are.

    Raises:
        MissingExtraError: a photograph was asked for and scikit-image is absent.
        TooltipError: the installed scikit-image lacks the photograph.
    """
    urdf = load_urdf()
    bench, camera = Bench(urdf), load_intrinsics(params.size)
    grasp, geometry, motion = _choose(params, bench, camera)
    stamps, names, positions = _joint_stream(params, motion)
    margin = 2 * int(np.ceil(camera.fx * np.tan(np.radians(2.5 * params.head_motion_deg))))
    texture = backdrop(
        params.background,
        (camera.width + margin, camera.height + margin),
        _stream(params, "background"),
    )
    return Simulation(
        params=params,
        urdf=urdf,
        camera=camera,
        joint_names=names,
        joint_stamps_ns=stamps,
        joint_positions=positions,
        image_stamps_ns=_stamps(params, np.arange(params.frames) / params.fps),
        tip_hand=grasp.tip,
        axis_hand=grasp.axis,
        other_ends_hand=np.array(grasp.other_ends).reshape(-1, 3),
        tool_cloud=grasp.tool.vertices,
        motion=motion,
        bench=bench,
        scene=build_scene(geometry, grasp.materials),
        lights=build_lights(texture, _stream(params, "lights")),
        backdrop=texture,
    )


def _choose(
    params: SimParams, bench: Bench, camera: Intrinsics
) -> tuple[Grasp, Geometry, dict[str, Ramps]]:
    """Return the first grasp and motion that keep the tip in view, or the best of all tried."""
    tried = []
    for attempt in range(_ATTEMPTS):
        grasp = random_grasp(params, _stream(params, "grasp", attempt))
        geometry = build_geometry(grasp)
        motion = _motion(params, bench, camera, grasp, attempt)
        in_view, visible = _shares(params, bench, camera, grasp, geometry, motion)
        if in_view >= _ENOUGH_IN_VIEW and visible >= _ENOUGH_VISIBLE:
            return grasp, geometry, motion
        tried.append((4.0 * min(in_view, _ENOUGH_IN_VIEW) + visible, grasp, geometry, motion))
    return max(tried, key=lambda candidate: candidate[0])[1:]


def _motion(
    params: SimParams, bench: Bench, camera: Intrinsics, grasp: Grasp, attempt: int
) -> dict[str, Ramps]:
    """Return how every joint moves: the arm holds a posture, the wrist sweeps."""
    rng = _stream(params, "posture", attempt)
    length = float(np.linalg.norm(grasp.tip))
    posture = _random_posture(rng, length)
    positions = reach(bench, posture)
    limit = np.radians(params.limit_deg)
    if params.motion == "in_plane":
        positions = face_pitch_axis(bench, positions, 1.9 * length + 0.10)
    else:
        carried = np.vstack([grasp.tip, np.zeros(3)])
        corners = [(p * limit, r * limit) for p in (-1.0, 0.0, 1.0) for r in (-1.0, 0.0, 1.0)]
        positions = look_at(bench, positions, corners, carried, camera)
    motion = {joint: rest(float(q)) for joint, q in zip(JOINTS, positions, strict=True)}

    rng = _stream(params, "motion", attempt)
    span = (-2 * _MARGIN_S, params.frames / params.fps + 2 * _MARGIN_S)
    seconds = (1.0 / 3.0, 2.0 / 3.0) if params.motion == "fast" else (1.0, 2.0)
    sweeps = {joint: random_ramps(rng, span, limit, seconds) for joint in WRIST}
    if params.motion in ("sweep", "fast"):
        motion.update(sweeps)
    elif params.motion == "in_plane":
        motion["wrist_pitch"] = sweeps["wrist_pitch"]
    sway = np.radians(params.head_motion_deg)
    for joint in ("neck_yaw", "head_pitch"):
        ramps = random_ramps(rng, span, 1.0, (1.0, 2.5))
        if sway > 0.0:
            at_rest = float(positions[JOINTS.index(joint)])
            motion[joint] = Ramps(ramps.times, at_rest + sway * ramps.targets)
    return motion


def _random_posture(rng: np.random.Generator, length: float) -> Posture:
    """Return where to hold the wrist so that a tool reaching ``length`` m stays in view."""
    distance = float(np.clip(1.85 * length + 0.12, 0.36, 0.62)) * float(rng.uniform(0.96, 1.06))
    drop, left = float(rng.uniform(-0.50, -0.34)), float(rng.uniform(-0.12, 0.08))
    ahead = np.sqrt(1.0 - drop**2 - left**2)
    return Posture(
        wrist=(distance * ahead, distance * left, distance * drop),
        forearm=(rng.uniform(-0.4, 0.4), rng.uniform(0.3, 1.0), rng.uniform(0.2, 0.9)),
    )


def _shares(
    params: SimParams, bench: Bench, camera: Intrinsics, grasp: Grasp, geometry: Geometry,
    motion: Mapping[str, Ramps],
) -> tuple[float, float]:  # fmt: skip
    """Return the shares of sampled frames with the tip in view, and with it in view and free."""
    times = np.linspace(0.0, params.frames / params.fps, min(60, params.frames), endpoint=False)
    in_view = visible = 0
    for positions in joint_positions(motion, times):
        poses = bench.camera_from(positions, LINKS)
        _, inside, free = see_tip(camera, geometry, grasp.tip, poses)
        in_view += inside
        visible += free
    return in_view / len(times), visible / len(times)


def see_tip(
    camera: Intrinsics, geometry: Geometry, tip_hand: Floats, poses: Mapping[str, Floats]
) -> tuple[Floats, bool, bool]:
    """Return the tip's pixel (2,), whether it lies in the image, and whether it is also free.

    ``poses`` are camera_from_link for all of ``bench.LINKS``.
    """
    tip = poses[HAND_FRAME][:3, :3] @ tip_hand + poses[HAND_FRAME][:3, 3]
    pixel = camera.project(tip)
    low, high = np.array([-0.5, -0.5]), np.array([camera.width, camera.height]) - 0.5
    inside = bool(tip[2] > 0.0 and (pixel >= low).all() and (pixel < high).all())
    free = inside and not hidden(geometry.placed(poses), geometry.faces, tip)
    return pixel, inside, free


def _joint_stream(
    params: SimParams, motion: Mapping[str, Ramps]
) -> tuple[Stamps, tuple[str, ...], Floats]:
    """Return what the encoders report: stamps, names in the log's order, positions."""
    rng = _stream(params, "encoders")
    margin = _MARGIN_S + abs(params.time_offset_s)
    first = -margin + float(rng.uniform(0.0, 1.0)) / params.joint_rate_hz
    count = int(np.ceil((params.frames / params.fps + 2 * margin) * params.joint_rate_hz))
    times = first + np.arange(count) / params.joint_rate_hz
    order = rng.permutation(len(JOINTS))
    true = joint_positions(motion, times)[:, order]
    noisy = true + params.joint_noise_rad * rng.standard_normal(true.shape)
    names = tuple(JOINTS[k] for k in order)
    return _stamps(params, times + params.time_offset_s), names, noisy


def _stamps(params: SimParams, times: Floats) -> Stamps:
    start = START_NS + params.seed % 400_000 * 1_000_000_000_000
    return start + np.round(times * 1e9).astype(np.int64)


def _stream(params: SimParams, purpose: str, attempt: int = 0) -> np.random.Generator:
    """Return the random numbers for one purpose, the same for the same tool and seed."""
    words = [zlib.crc32(word.encode()) for word in (params.tool, purpose)]
    return np.random.default_rng([params.seed, *words, attempt])
