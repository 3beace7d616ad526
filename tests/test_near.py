"""Detection near the hand: on images whose motion is known, and through the commands."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.cli import tooltip
from tests.helpers.logs import Log, wrist_parts, write_log, write_true_labels
from tooltip_cli.log.detections import read_detections
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.detector import (
    FEW_EDGES,
    NO_MOTION,
    Detections,
    DetectorParams,
    TipDetection,
    detect_tip,
    find_edges,
)
from tooltip_cli.method.near import NearParams, Shown, detect_near, near_motion
from tooltip_cli.method.voting.moving import canny_thresholds, image_edges, smooth
from tooltip_cli.method.voting.params import MovingParams
from tooltip_cli.stages.detect import detect, detect_in
from tooltip_cli.stages.near import near_hand

Image = npt.NDArray[np.uint8]
Step = tuple[int, int]

PARAMS = NearParams(DetectorParams(), MovingParams())
NOISE = 1.0
SLOW, FAST = (110, 70), (20, 20)  # left and top of two patches
SIDE = 24
ANYWHERE = np.full(3, np.nan)
AT_SLOW = np.array([122.0, 82.0, 45.0])


def texture(shape: tuple[int, int], seed: int) -> Image:
    noise = np.random.default_rng(seed).uniform(0, 255, shape)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(cv2.normalize(blurred, None, 20, 235, cv2.NORM_MINMAX), dtype=np.uint8)


def scene(slow: Step = (0, 0), fast: Step = (0, 0), background: Step = (0, 0)) -> Image:
    """Return an image with two patches, each and the background shifted by (du, dv)."""
    whole = texture((180, 220), 1)
    u, v = 20 - background[0], 20 - background[1]
    image: Image = whole[v : v + 140, u : u + 180].copy()
    for (left, top), step, seed in ((SLOW, slow, 2), (FAST, fast, 3)):
        u, v = left + step[0], top + step[1]
        image[v : v + SIDE, u : u + SIDE] = texture((SIDE, SIDE), seed)
    noise = np.random.default_rng(abs(hash((slow, fast, background)))).normal(0, NOISE, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def seen(image: Image) -> Shown:
    return Shown(image, smooth(image, PARAMS.moving))


def near(
    first: Image,
    second: Image,
    hand: npt.NDArray[np.float64],
    params: NearParams = PARAMS,
) -> TipDetection:
    shown = seen(first)
    edges = image_edges(shown.smoothed, canny_thresholds(NOISE, params.moving), params.moving)
    return detect_near(shown, seen(second), edges, hand, NOISE, params)


def on(patch: Step, found: TipDetection) -> bool:
    return bool((np.abs(found.pixel - np.add(patch, SIDE / 2)) < SIDE / 2 + 4).all())


@pytest.mark.parametrize("background", [(0, 0), (1, -1)])
def test_the_heaviest_edge_is_the_hands_and_not_what_moves_more_elsewhere(background: Step) -> None:
    first = scene()
    second = scene(slow=(-2, 1), fast=(4, 3), background=background)
    everywhere = detect_tip(first, second, find_edges(first, PARAMS.detector), PARAMS.detector)
    assert on(FAST, everywhere)
    found = near(first, second, AT_SLOW)
    assert on(SLOW, found)
    assert found.flags == ()
    assert 0 < found.edges < everywhere.edges / 3  # the rest is far, or did not change
    corners = np.array([[20, 20, 1], [160, 120, 1]])
    np.testing.assert_allclose(
        corners @ found.affine.T, corners[:, :2] + np.array(background), atol=0.25
    )


def test_it_can_be_anywhere_where_the_hands_pose_is_unknown() -> None:
    assert on(FAST, near(scene(), scene(slow=(-2, 1), fast=(4, 3)), ANYWHERE))


def test_nothing_is_detected_where_nothing_near_the_hand_moves() -> None:
    first = scene()
    for second in (scene(fast=(4, 3)), first):
        found = near(first, second, AT_SLOW)
        assert found.flags == (NO_MOTION,)
        assert np.isnan(found.pixel).all()
        assert np.isfinite(found.affine).all()
        assert found.weight < PARAMS.detector.min_weight


def test_too_few_edges_are_flagged() -> None:
    flat = np.full((140, 180), 90, np.uint8)
    assert near(flat, flat, AT_SLOW).flags == (FEW_EDGES,)


def test_larger_blocks_stay_inside_the_image() -> None:
    params = replace(PARAMS, detector=replace(PARAMS.detector, block=9, search=17))
    found = near(scene(), scene(slow=(-2, 1), background=(1, 0)), ANYWHERE, params)
    assert on(SLOW, found)


def test_weights_are_those_of_the_paper_up_to_the_sample() -> None:
    """An edge's match is the same as among all edges; only the background's model may differ."""
    shown, second = seen(scene()), scene(slow=(-2, 1))
    edges = image_edges(shown.smoothed, canny_thresholds(NOISE, PARAMS.moving), PARAMS.moving)
    motion = near_motion(shown, seen(second), edges, AT_SLOW, NOISE, PARAMS)
    assert not isinstance(motion, str)
    detector = PARAMS.detector
    everywhere = detect_tip(shown.gray, second, edges, detector)
    heaviest = motion.edges[np.argmax(motion.weights)]
    assert heaviest.tolist() == everywhere.pixel.tolist()
    assert motion.weights.max() == pytest.approx(everywhere.weight, rel=0.05)


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small recording of a head that moves, which nobody may change."""
    path = tmp_path_factory.mktemp("near") / "small.mcap"
    options = ("--tool", "screwdriver", "--frames", 60, "--size", "240x180", "--head-motion", 2)
    done = tooltip("record", "sim", path, *options)
    assert done.code == 0, done.err
    return path


def opened(path: Path) -> tuple[Recording, Views]:
    recording = read_recording(path)
    return recording, resolve_views(recording, resolve_rig(recording, None))


def same(one: Detections, other: Detections) -> bool:
    return np.array_equal(one.pixels, other.pixels, equal_nan=True) and np.array_equal(
        one.weights, other.weights
    )


def test_every_pair_of_consecutive_images_has_a_row(sim: Path, tmp_path: Path) -> None:
    assert tooltip("detect", sim, "--out", tmp_path).code == 0
    recording, _ = opened(sim)
    found = read_detections(tmp_path / "small.detections.mcap", recording.image_stamps_ns)
    assert found.frames.tolist() == list(range(59))
    assert found.partners.tolist() == list(range(1, 60))
    assert found.valid.sum() > 40


def test_threads_and_company_change_nothing(sim: Path, tmp_path: Path) -> None:
    recording, views = opened(sim)
    alone = detect_in(recording, near=near_hand(recording, views), out=tmp_path / "alone")
    assert tooltip("detect", sim, "--jobs", 2, "--out", tmp_path / "two").code == 0
    assert tooltip("detect", sim, "--jobs", 1, "--out", tmp_path / "one").code == 0
    for folder in ("one", "two"):
        path = tmp_path / folder / "small.detections.mcap"
        assert same(read_detections(path, recording.image_stamps_ns), alone.detections)


def test_all_commands_take_the_same_detections(sim: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path)
    detections = str(tmp_path / "small.detections.mcap")
    assert "computed 59 pairs" in tooltip("detect", sim, *out).err
    assert f"reused {detections}" in tooltip("estimate", sim, "--method", "map", *out).err
    assert f"reused {detections}" in tooltip("evaluate", sim, "--method", "map", *out).err
    view = (tmp_path / "view.mcap", "--force")
    assert f"reused {detections}" in tooltip("export", sim, *view, *out, "--method", "map").err
    paper = ("--preset", "paper")
    assert f"computed {detections}" in tooltip("estimate", sim, "--method", "map", *paper, *out).err
    assert f"reused {detections}" in tooltip("evaluate", sim, "--method", "map", *paper, *out).err
    export = tooltip("export", sim, *view, *out, "--method", "map", *paper)
    assert f"reused {detections}" in export.err
    assert "reused 59 pairs" in tooltip("detect", sim, *paper, *out).err
    assert "computed 59 pairs" in tooltip("detect", sim, *out).err


def test_the_papers_preset_does_not_ask_for_the_hand(sim: Path, tmp_path: Path) -> None:
    recording, _ = opened(sim)
    assert tooltip("detect", sim, "--preset", "paper", "--out", tmp_path / "cli").code == 0
    images = list(recording.images(range(60), gray=True))
    plain = [
        detect_tip(first, second, find_edges(first, DetectorParams()), DetectorParams())
        for first, second in pairwise(images)
    ]
    path = tmp_path / "cli" / "small.detections.mcap"
    found = read_detections(path, recording.image_stamps_ns)
    assert found.weights.tolist() == [row.weight for row in plain]
    assert np.array_equal(found.pixels, [row.pixel for row in plain], equal_nan=True)


def test_labels_change_no_detection(sim: Path) -> None:
    recording, views = opened(sim)
    before = near_hand(recording, views).key
    labels = sim.with_name("small.labels.csv")
    kept = labels.read_bytes()
    labels.unlink()
    assert near_hand(recording, views).key == before
    labels.write_bytes(kept)


def test_images_without_a_pose_are_looked_at_everywhere(tmp_path: Path) -> None:
    parts = wrist_parts()
    half = len(parts["joints"]) // 2
    path = write_log(tmp_path / "wrist.mcap", {**parts, "joints": parts["joints"][:half]})
    recording, views = opened(path)
    unknown = ~views.known
    assert 5 < unknown.sum() < len(unknown) - 5
    hand = near_hand(recording, views)
    assert np.isnan(hand.hands[unknown]).all()
    assert np.isfinite(hand.hands[views.known]).all()
    found = detect_in(recording, near=hand).detections
    assert found.valid[unknown[:-1]].mean() > 0.5


def test_a_hand_that_stands_still_is_looked_at_all_the_same(wrist: Log) -> None:
    """No frame has partners then, and the noise is that of neighbours."""
    recording, views = opened(wrist.path)
    still = replace(views, hand_from_camera=views.hand_from_camera[:1].repeat(wrist.frames, axis=0))
    hand = near_hand(recording, still)
    assert (np.diff(hand.noise_frames) == 1).all()
    assert 0.5 <= hand.light.noise < 3.0
    assert hand.light.steady


def test_a_frame_in_which_nothing_changed_is_shown_in_the_report(
    wrist: Log, tmp_path: Path
) -> None:
    found = detect(wrist.path, preset="voting").detections
    (still,) = np.flatnonzero(found.edges == 0)  # where the wrist turns back
    write_true_labels(wrist.labels, range(0, wrist.frames, 4))
    assert not still % 4
    out = ("--out", tmp_path, "--frame", still, "--no-curve")
    shown = tooltip("evaluate", wrist.path, "--method", "kmeans", *out)
    assert shown.code == 0, shown.err
    page = (tmp_path / "index.html").read_text()
    assert f"Frame {still}: the detector finds no motion to weigh (no_motion)" in page
    rows = (tmp_path / "figures" / "wrist-edges.csv").read_text().splitlines()
    assert rows == ["u,v,weight"]
