"""The simulator: what it draws is where it says it is, and the same every time."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pinocchio
import pytest
import yaml
from numpy.typing import NDArray

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.resources import resource
from tooltip_cli.sources.sim import (
    BACKGROUNDS,
    MOTIONS,
    TOOLS,
    SimFrame,
    SimParams,
    Simulation,
    background,
    raster,
    render_frames,
    simulate,
    truth,
)
from tooltip_cli.sources.sim.bench import HAND_FRAME, JOINTS, LINKS
from tooltip_cli.sources.sim.grasp import Grasp, random_grasp
from tooltip_cli.sources.sim.mesh import Mesh, corner_normals
from tooltip_cli.sources.sim.simulation import see_tip
from tooltip_cli.sources.sim.visibility import hidden

SMALL = (160, 120)


def params(**changes: Any) -> SimParams:
    base: dict[str, Any] = {"tool": "pliers", "frames": 4, "size": SMALL, "background": "clutter"}
    return SimParams(**{**base, **changes})


@cache
def simulated(chosen: SimParams) -> Simulation:
    return simulate(chosen)


def grasp(tool: str, seed: int = 0, **changes: Any) -> Grasp:
    chosen = SimParams(tool, seed=seed, **changes)
    return random_grasp(chosen, np.random.default_rng([seed, len(tool)]))


def picture(frame: SimFrame) -> NDArray[np.float64]:
    image = cv2.imdecode(np.frombuffer(frame.jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, dtype=np.float64)


def without_tool(simulation: Simulation) -> Simulation:
    """Return the same simulation with the tool's triangles shrunk to nothing."""
    geometry = simulation.scene.geometry
    count = len(simulation.tool_cloud)
    vertices = geometry.vertices.copy()
    np.testing.assert_array_equal(vertices[-count:], simulation.tool_cloud)
    vertices[-count:] = 0.0
    scene = dataclasses.replace(
        simulation.scene, geometry=dataclasses.replace(geometry, vertices=vertices)
    )
    return dataclasses.replace(simulation, scene=scene)


# -- sameness ------------------------------------------------------------------------------------


def test_same_seed_gives_the_same_bytes_whatever_the_jobs() -> None:
    first = [frame.jpeg for frame in render_frames(simulate(params()), jobs=1)]
    second = [frame.jpeg for frame in render_frames(simulate(params()), jobs=2)]
    assert first == second
    assert len(first) == 4
    assert len(set(first)) == 4
    other = simulate(params(seed=1))
    assert next(iter(render_frames(other))).jpeg != first[0]


def test_streams_are_the_same_for_the_same_seed() -> None:
    first, second = simulate(params(seed=5)), simulate(params(seed=5))
    np.testing.assert_array_equal(first.joint_positions, second.joint_positions)
    np.testing.assert_array_equal(first.joint_stamps_ns, second.joint_stamps_ns)
    assert first.joint_names == second.joint_names


@pytest.mark.parametrize(
    "change",
    [
        {"noise_sigma": 4.0},
        {"background": "motorcycle"},
        {"jpeg_quality": 50},
        {"time_offset_s": 0.05},
        {"size": (80, 60)},
    ],
)
def test_disturbances_leave_grasp_and_motion_as_they_are(change: dict[str, Any]) -> None:
    pytest.importorskip("skimage")
    before, after = simulated(params()), simulated(params(**change))
    times = np.linspace(0.0, 1.0, 7)
    np.testing.assert_array_equal(before.tip_hand, after.tip_hand)
    np.testing.assert_array_equal(before.positions_at(times), after.positions_at(times))


# -- tools ---------------------------------------------------------------------------------------


def closed(mesh: Mesh) -> bool:
    """Say whether every edge is shared by two faces that agree which side is outside."""
    edges = np.vstack([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    count = Counter(map(tuple, edges.tolist()))
    return all(n == 1 and count[(b, a)] == 1 for (a, b), n in count.items())


def distance_to_surface(mesh: Mesh, point: NDArray[np.float64]) -> float:
    """Return the distance from a point to the nearest triangle, by dense sampling."""
    grid = np.linspace(0.0, 1.0, 41)
    u, v = (g.ravel() for g in np.meshgrid(grid, grid))
    weights = np.column_stack([u, v, 1.0 - u - v])[u + v <= 1.0 + 1e-12]
    corners = mesh.vertices[mesh.faces]
    near = np.linalg.norm(corners - point, axis=2).min(axis=1) < 0.03
    samples = np.einsum("kc,fcx->fkx", weights, corners[near])
    return float(np.linalg.norm(samples - point, axis=2).min())


@pytest.mark.parametrize("tool", TOOLS)
def test_tools_are_closed_with_the_tip_on_their_surface(tool: str) -> None:
    held = grasp(tool)
    for mesh in (held.tool, held.hand):
        assert closed(mesh)
        p = mesh.vertices[mesh.faces]
        assert np.einsum("ij,ij->", p[:, 0], np.cross(p[:, 1], p[:, 2])) > 0.0
        normals = corner_normals(mesh)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1.0, atol=1e-9)
    assert distance_to_surface(held.tool, held.tip) < 1e-3
    assert np.linalg.norm(held.axis) == pytest.approx(1.0)
    for end in held.other_ends:
        assert distance_to_surface(held.tool, end) < 1e-3


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_tip_is_outside_the_rigs_spheres_and_the_hand_inside(tool: str, seed: int) -> None:
    rig = yaml.safe_load(resource("calib", "bench", "rig.yaml").read_text(encoding="utf-8"))

    def outside(points: NDArray[np.float64]) -> NDArray[np.float64]:
        depth = [
            np.linalg.norm(points - sphere["center"], axis=-1) - sphere["radius"]
            for sphere in rig["hand"]["spheres"]
        ]
        return np.asarray(np.min(depth, axis=0))

    for changes in ({}, {"tilt_deg": -40.0, "grip_offset_m": -0.02}, {"tilt_deg": 40.0}):
        held = grasp(tool, seed, **changes)
        assert outside(held.tip) > 0.0
    usual = outside(grasp(tool, seed).hand.vertices)
    assert np.mean(usual < 0.0) > 0.93
    assert usual.max() < 0.02  # fingertips round a thick handle


@pytest.mark.parametrize("tool", TOOLS)
def test_the_tip_is_the_far_end_of_the_tool(tool: str) -> None:
    held = grasp(tool)
    reach = np.linalg.norm(held.tool.vertices, axis=1).max()
    assert np.linalg.norm(held.tip) > 0.93 * reach


def test_grip_offset_moves_the_tip_along_the_handle() -> None:
    usual, shifted = grasp("screwdriver"), grasp("screwdriver", grip_offset_m=0.02)
    np.testing.assert_allclose(shifted.tip - usual.tip, 0.02 * usual.axis, atol=1e-12)


def test_tilt_turns_the_tool_towards_the_fingers_ends() -> None:
    flat, tilted = grasp("screwdriver", tilt_deg=0.0), grasp("screwdriver", tilt_deg=40.0)
    assert flat.axis[2] == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(np.arcsin(tilted.axis[2])) == pytest.approx(40.0, abs=0.5)


def test_the_hammer_has_a_second_end() -> None:
    assert simulated(params(tool="hammer")).other_ends_hand.shape == (1, 3)
    assert simulated(params(tool="pen")).other_ends_hand.shape == (0, 3)


# -- kinematics ----------------------------------------------------------------------------------


def independent_pixel(
    simulation: Simulation, names: tuple[str, ...], positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Project the tip through the URDF's text and the camera file, apart from the simulator."""
    model = pinocchio.buildModelFromXML(simulation.urdf)
    data = model.createData()
    q = pinocchio.neutral(model)
    for name, value in zip(names, positions, strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = value
    pinocchio.framesForwardKinematics(model, data, q)
    assert model.existFrame("camera_optical_frame")
    assert model.existFrame("hand")
    base_from_camera = data.oMf[model.getFrameId("camera_optical_frame")]
    base_from_hand = data.oMf[model.getFrameId("hand")]
    x, y, z = base_from_camera.actInv(base_from_hand.act(simulation.tip_hand))
    camera = simulation.camera
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


@pytest.mark.parametrize("head", [0.0, 2.0])
def test_the_true_pixel_is_the_projection_at_mid_exposure(head: float) -> None:
    simulation = simulated(params(head_motion_deg=head, shutter=0.5))
    frames = list(render_frames(simulation))
    stamps = simulation.image_stamps_ns
    for frame, stamp in zip(frames, stamps, strict=True):
        seconds = (stamp - stamps[0]) * 1e-9 - 0.5 * 0.5 / 30.0
        exact = simulation.positions_at(np.array([seconds]))[0]
        pixel = independent_pixel(simulation, JOINTS, exact)
        np.testing.assert_allclose(frame.tip_pixel, pixel, atol=1e-6)


def test_logged_joints_at_mid_exposure_give_the_true_pixel() -> None:
    late = 0.02
    simulation = simulated(params(frames=30, joint_noise_rad=0.0, time_offset_s=late))
    frames = list(render_frames(simulation))
    stamps, positions = simulation.joint_stamps_ns, simulation.joint_positions
    assert stamps[0] < simulation.image_stamps_ns[0]
    assert stamps[-1] > simulation.image_stamps_ns[-1] + round(late * 1e9)
    for frame in frames:
        at = frame.stamp_ns + round((late - 0.5 * simulation.exposure_s) * 1e9)
        wanted = float(at - stamps[0])
        since = (stamps - stamps[0]).astype(np.float64)
        joints = np.array([np.interp(wanted, since, column) for column in positions.T])
        pixel = independent_pixel(simulation, simulation.joint_names, joints)
        np.testing.assert_allclose(frame.tip_pixel, pixel, atol=0.05)


def test_encoder_noise_has_the_asked_deviation() -> None:
    simulation = simulated(params(motion="still", frames=60, joint_noise_rad=1e-3))
    assert simulation.joint_positions.std(axis=0) == pytest.approx(1e-3, rel=0.25)


def test_joint_names_are_shuffled_and_hold_one_that_no_chain_uses() -> None:
    names = simulated(params()).joint_names
    assert sorted(names) == sorted(JOINTS)
    assert names != JOINTS
    assert "gripper" in names


def test_eleven_joints_lie_between_camera_and_wrist() -> None:
    model = pinocchio.buildModelFromXML(simulated(params()).urdf)

    def chain(frame: str) -> set[str]:
        joint = model.frames[model.getFrameId(frame)].parentJoint
        return {model.names[k] for k in model.supports[joint] if k > 0}

    between = chain("camera_optical_frame") ^ chain("hand")
    assert len(between) == 13
    assert {"wrist_pitch", "wrist_roll"} < between


@pytest.mark.parametrize("motion", MOTIONS)
def test_motions(motion: str) -> None:
    simulation = simulated(params(motion=motion, frames=150))
    positions = simulation.positions_at(simulation.image_times_s)
    wrist = positions[:, [JOINTS.index("wrist_pitch"), JOINTS.index("wrist_roll")]]
    rest = np.delete(positions, [JOINTS.index("wrist_pitch"), JOINTS.index("wrist_roll")], axis=1)
    np.testing.assert_array_equal(rest, np.broadcast_to(rest[0], rest.shape))
    assert np.abs(wrist).max() <= np.radians(60.0)
    moves = np.ptp(wrist, axis=0) > np.radians(20.0)
    assert (
        moves.tolist()
        == {
            "sweep": [True, True],
            "fast": [True, True],
            "in_plane": [True, False],
            "still": [False, False],
        }[motion]
    )
    if motion == "in_plane":
        poses = [simulation.bench.camera_from(q, (HAND_FRAME,))[HAND_FRAME] for q in positions]
        depth = [(pose[:3, :3] @ simulation.tip_hand + pose[:3, 3])[2] for pose in poses]
        assert np.ptp(depth) < 1e-6
        # Seen from the hand, the camera stays where it is: no second view, no depth.
        camera = [-pose[:3, :3].T @ pose[:3, 3] for pose in poses]
        assert np.ptp(camera, axis=0).max() < 1e-6


def test_the_head_moves_within_its_limit_and_the_background_with_it() -> None:
    simulation = simulated(params(head_motion_deg=2.0, frames=90, noise_sigma=0.0))
    positions = simulation.positions_at(simulation.image_times_s)
    yaw = positions[:, JOINTS.index("neck_yaw")]
    assert np.radians(1.0) < np.ptp(yaw) <= np.radians(4.0)
    frames = [picture(frame) for frame in render_frames(simulation, jobs=2)]
    k = int(np.argmax(np.abs(yaw - yaw[0])))
    first, last = (np.ascontiguousarray(frames[i][:40].mean(axis=2)) for i in (0, k))
    (shift, _), _ = cv2.phaseCorrelate(first, last)
    # A head that turns left by an angle moves what it sees to the right by f tan(angle).
    expected = simulation.camera.fx * np.tan(yaw[k] - yaw[0])
    assert shift == pytest.approx(expected, abs=1.0)


# -- pictures ------------------------------------------------------------------------------------


@pytest.mark.parametrize("tool", TOOLS)
def test_the_rendered_tip_is_where_the_truth_says(tool: str) -> None:
    simulation = simulate(
        params(tool=tool, size=(320, 240), frames=3, noise_sigma=0.0, jpeg_quality=100, shutter=0.0)
    )
    bare = without_tool(simulation)
    for with_it, without in zip(render_frames(simulation), render_frames(bare), strict=True):
        changed = np.abs(picture(with_it) - picture(without)).max(axis=2) > 12.0
        rows, columns = np.nonzero(changed)
        u, v = with_it.tip_pixel
        assert np.hypot(columns - u, rows - v).min() < 2.0
        if with_it.tip_visible:
            far = np.hypot(columns - u, rows - v).max()
            assert far < 320.0  # the change is the tool, not the whole image
            assert changed.mean() < 0.25


def test_a_tip_turned_away_is_hidden_and_one_before_the_hand_is_not() -> None:
    square = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    assert hidden(square, faces, np.array([0.1, 0.2, 2.0]))
    assert not hidden(square, faces, np.array([0.1, 0.2, 0.5]))
    assert not hidden(square, faces, np.array([0.1, 0.2, 1.0]))  # on the surface
    assert not hidden(square, faces, np.array([3.0, 0.2, 2.0]))


def test_visibility_agrees_with_the_picture() -> None:
    """A small bright ball at the tip shows in the picture exactly when the tip is visible."""
    simulation = simulated(params(tool="bottle", frames=60, size=(320, 240), shutter=0.0))
    agreed = 0
    for index in range(0, 60, 6):
        positions = simulation.positions_at(simulation.mid_exposure_s[[index]])[0]
        poses = simulation.bench.camera_from(positions, LINKS)
        depth, tip_depth = depth_near_tip(simulation, poses)
        frame_visible = visible_at(simulation, poses)
        agreed += frame_visible == (depth >= tip_depth - 0.004)
    assert agreed >= 9  # a silhouette through the tip's own pixel may go either way


def depth_near_tip(
    simulation: Simulation, poses: dict[str, NDArray[np.float64]]
) -> tuple[float, float]:
    """Return the depth buffer's value at the tip's pixel, and the tip's own depth, m."""
    camera, geometry = simulation.camera, simulation.scene.geometry
    points = geometry.placed(poses)
    screen = np.empty_like(points)
    view = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    raster.project(points, view, screen)
    depth = np.zeros((camera.height, camera.width), dtype=np.float32)
    ids = np.full(depth.shape, -1, dtype=np.int32)
    raster.draw(screen, geometry.faces, 0, len(geometry.faces), 0, 0, depth, ids)
    tip = poses[HAND_FRAME][:3, :3] @ simulation.tip_hand + poses[HAND_FRAME][:3, 3]
    u, v = np.round(camera.project(tip)).astype(int)
    nearest = depth[v, u]
    return (1.0 / float(nearest) if nearest > 0.0 else np.inf), float(tip[2])


def visible_at(simulation: Simulation, poses: dict[str, NDArray[np.float64]]) -> bool:
    return see_tip(simulation.camera, simulation.scene.geometry, simulation.tip_hand, poses)[2]


def test_noise_has_the_asked_strength() -> None:
    def pictures(sigma: float) -> Iterator[NDArray[np.float64]]:
        chosen = params(motion="still", noise_sigma=sigma, jpeg_quality=100, frames=2)
        return (picture(frame) for frame in render_frames(simulated(chosen)))

    first, second = pictures(4.0)
    clean, _ = pictures(0.0)
    grey = (clean > 110.0) & (clean < 145.0)
    deviation = (first - second)[grey].std() / np.sqrt(2.0)
    assert deviation == pytest.approx(4.0, rel=0.35)  # JPEG smooths the colours' part of it


def test_a_longer_exposure_blurs_what_moves() -> None:
    def sharpness(shutter: float) -> float:
        chosen = params(
            tool="screwdriver", motion="fast", shutter=shutter, noise_sigma=0.0, size=(320, 240)
        )
        simulation = simulated(dataclasses.replace(chosen, frames=12))
        total = 0.0
        for frame in render_frames(simulation):
            u, v = np.clip(np.round(frame.tip_pixel), 20, (299, 219)).astype(int)
            patch = picture(frame)[v - 20 : v + 21, u - 20 : u + 21].mean(axis=2)
            total += float(np.abs(cv2.Laplacian(patch, cv2.CV_64F)).mean())
        return total

    assert sharpness(1.0) < sharpness(0.0)


def test_the_tip_stays_in_view_and_mostly_visible() -> None:
    for tool in ("pen", "hammer"):
        simulation = simulated(params(tool=tool, frames=60))
        frames = list(render_frames(simulation, jobs=2))
        assert np.mean([frame.tip_in_view for frame in frames]) > 0.9
        assert np.mean([frame.tip_visible for frame in frames]) > 0.5
        speed = np.linalg.norm(np.diff([frame.tip_pixel for frame in frames], axis=0), axis=1)
        assert 0.2 < np.median(speed) * 640 / SMALL[0] < 12.0


def test_sizes_keep_the_field_of_view() -> None:
    large, small = simulated(params(size=(640, 480))), simulated(params(size=(320, 240)))
    assert small.camera.fx == pytest.approx(0.5 * large.camera.fx)
    assert (small.camera.cx + 0.5) == pytest.approx(0.5 * (large.camera.cx + 0.5))
    frame = next(iter(render_frames(small)))
    assert picture(frame).shape == (240, 320, 3)


def test_stamps() -> None:
    simulation = simulated(params(fps=15.0, joint_rate_hz=50.0, frames=8))
    images, joints = simulation.image_stamps_ns, simulation.joint_stamps_ns
    np.testing.assert_allclose(np.diff(images), 1e9 / 15.0, atol=1)
    np.testing.assert_allclose(np.diff(joints), 1e9 / 50.0, atol=1)
    latest = simulated(params(seed=2**63 - 1, frames=1)).image_stamps_ns[0]
    assert 0 < latest < 2**31 * 10**9  # fits the seconds of a ROS stamp


def test_truth_is_json_and_complete() -> None:
    simulation = simulated(params())
    frames = list(render_frames(simulation))
    stored = json.loads(json.dumps(truth(simulation, frames)))
    assert stored["tip_in_hand_m"] == simulation.tip_hand.tolist()
    assert stored["stamps_ns"] == simulation.image_stamps_ns.tolist()
    assert len(stored["uv"]) == len(stored["visible"]) == len(stored["in_view"]) == 4
    assert stored["params"]["tool"] == "pliers"
    np.testing.assert_allclose(np.linalg.norm(stored["axis"]), 1.0)


# -- backgrounds and refusals --------------------------------------------------------------------


@pytest.mark.parametrize("name", BACKGROUNDS)
def test_backgrounds_cover_the_image(name: str) -> None:
    pytest.importorskip("skimage")
    image = background.backdrop(name, (320, 240), np.random.default_rng(0))
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.float32
    assert 0.0 <= image.min() < 0.1
    assert 0.3 < image.max() <= 1.0


def test_clutter_has_the_spectrum_of_photographs() -> None:
    image = background.clutter((512, 512), np.random.default_rng(0)).mean(axis=2)
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    radius = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.fftfreq(512)[None, :])
    edges = np.geomspace(0.01, 0.2, 12)
    level = [power[(radius >= a) & (radius < b)].mean() for a, b in pairwise(edges)]
    slope = np.polyfit(np.log(edges[:-1]), np.log(level), 1)[0]
    assert -3.3 < slope < -1.8  # photographs: about -2 (Field 1987)


def test_a_photograph_needs_scikit_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="scikit-image"):
        simulate(params(background="coffee"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tool": "spoon"}, "scissors"),
        ({"motion": "dance"}, "in_plane"),
        ({"background": "moon"}, "clutter"),
        ({"frames": 0}, "frames is 0; expected 1"),
        ({"fps": 0.0}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"size": (10, 10)}, "10x10"),
        ({"shutter": 1.5}, "shutter"),
        ({"tilt_deg": 80.0}, "-45 to 45"),
        ({"grip_offset_m": 0.5}, "grip_offset_m"),
        ({"jpeg_quality": 101}, "jpeg_quality"),
        ({"limit_deg": 0.0}, "limit_deg"),
        ({"seed": -1}, "seed"),
    ],
)
def test_bad_parameters_are_refused_with_what_is_valid(change: dict[str, Any], said: str) -> None:
    with pytest.raises(TooltipError, match=said):
        params(**change)


def test_the_bench_files_agree() -> None:
    rig = yaml.safe_load(resource("calib", "bench", "rig.yaml").read_text(encoding="utf-8"))
    folder = resource("calib", "bench")
    assert (folder / rig["robot"]).is_file()
    info = yaml.safe_load((folder / rig["camera"]["info"]).read_text(encoding="utf-8"))
    camera = simulated(params(size=(640, 480))).camera
    assert (info["image_width"], info["image_height"]) == (camera.width, camera.height)
    np.testing.assert_allclose(np.reshape(info["camera_matrix"]["data"], (3, 3)), camera.matrix)
    assert tuple(info["distortion_coefficients"]["data"]) == camera.distortion
