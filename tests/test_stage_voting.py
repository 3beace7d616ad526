"""Estimates by voting through the real commands, on small simulated recordings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.cli import Outcome, tooltip
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import read_labels
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.detections import read_provenance
from tooltip_cli.log.edges import read_edges
from tooltip_cli.log.images import Image, decode_compressed
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.sync import interpolate
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.rays import sphere_array
from tooltip_cli.method.types import Candidate, TipEstimate, refused
from tooltip_cli.method.voting.estimate import estimate_by_voting
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.params import TrustParams, VotingParams, VotingSettings
from tooltip_cli.method.voting.volume import Cloud, HandEdges, reconstruct
from tooltip_cli.report.scoring import project_tip
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import load_rig
from tooltip_cli.stages.calibrate import put_right, write_rig
from tooltip_cli.stages.estimate import estimate_from_images
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.label import find_hints
from tooltip_cli.stages.moving import DetectedEdges, known_edges
from tooltip_cli.stages.refined import gain
from tooltip_cli.stages.voting import Votes, gather_votes, hand_edges, pair_views

Stamps = npt.NDArray[np.int64]


def simulate(path: Path, frames: int, size: str, motion: str = "sweep") -> Path:
    options = ("--tool", "screwdriver", "--background", "clutter", "--motion", motion)
    done = tooltip("record", "sim", path, "--frames", frames, "--size", size, *options)
    assert done.code == 0, done.err
    return path


@dataclass(frozen=True)
class Run:
    """An estimate: the recording, and what was printed."""

    recording: Path
    outcome: Outcome

    @property
    def edges_path(self) -> Path:
        return self.recording.with_name("small.edges.mcap")

    @property
    def tip_path(self) -> Path:
        return self.recording.with_name("small.tip.json")

    @property
    def document(self) -> dict[str, Any]:
        document: dict[str, Any] = json.loads(self.tip_path.read_text())
        return document


@pytest.fixture(scope="session")
def first(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a small recording with its estimate, which nobody may change."""
    path = simulate(tmp_path_factory.mktemp("voting") / "small.mcap", 100, "240x180")
    return Run(path, tooltip("estimate", path, "--jobs", 2))


@pytest.fixture
def run(first: Run, tmp_path: Path) -> Run:
    """Return a copy of it that may be changed."""
    folder = Path(shutil.copytree(first.recording.parent, tmp_path / "copy"))
    return Run(folder / first.recording.name, first.outcome)


def stored_edges(run: Run, path: Path | None = None) -> MovingEdges:
    recording = read_recording(run.recording, Topics())
    return read_edges(path or run.edges_path, recording.image_stamps_ns)


def truth(path: Path) -> dict[str, Any]:
    (text,) = (
        item.data
        for item in iterate(path)
        if isinstance(item, LoggedAttachment) and item.name == "truth.json"
    )
    document: dict[str, Any] = json.loads(text)
    return document


def test_the_tip_is_found(first: Run) -> None:
    assert first.outcome.code == 0, first.outcome.err
    assert f"computed {first.edges_path}" in first.outcome.err
    assert f"computed {first.tip_path}" in first.outcome.err
    document = first.document
    assert document["status"] == "ok"
    assert document["method"] == "voting"
    assert document["frames_used"] == len(stored_edges(first).frames)
    error = np.subtract(document["tip"]["position_m"], truth(first.recording)["tip_in_hand_m"])
    assert np.linalg.norm(error) < 0.015
    candidate = document["candidates"][0]
    assert candidate["position_m"] == document["tip"]["position_m"]
    axis = truth(first.recording)["axis"]
    assert np.dot(candidate["axis"], axis) / np.linalg.norm(axis) > np.cos(np.radians(30))


def test_labelled_frames_are_never_used(first: Run) -> None:
    recording = read_recording(first.recording, Topics())
    labels = read_labels(first.recording.with_name("small.labels.csv"))
    labelled = set(np.searchsorted(recording.image_stamps_ns, labels.stamps_ns).tolist())
    assert len(labelled) >= 5
    edges = stored_edges(first)
    used = {*edges.frames.tolist(), *edges.partners.ravel().tolist()}
    assert not used & labelled
    # they would be, had they no labels
    views = resolve_views(recording, resolve_rig(recording, None))
    everything = np.ones(len(views.stamps_ns), dtype=bool)
    free, _ = pair_views(views, VotingSettings(), everything)
    assert {*free.frames.tolist(), *free.partners.ravel().tolist()} & labelled


def test_edges_lie_in_the_image_and_within_the_search_window(first: Run) -> None:
    edges = stored_edges(first)
    assert (edges.counts > 0).mean() > 0.9
    assert edges.pixels.max(axis=0).tolist() < [240, 180]
    recording, settings = read_recording(first.recording, Topics()), VotingSettings()
    views = resolve_views(recording, resolve_rig(recording, None))
    pairing, _ = pair_views(views, settings, unlabelled(recording, views.camera, None))
    assert pairing.frames.tolist() == edges.frames.tolist()
    far, half = np.abs(edges.translations).max(axis=(1, 2)), settings.moving.search // 2
    scale = 2 ** pairing.levels[edges.frame_of_edge]
    assert (far <= np.where(scale == 1, half, scale * (half + 1))).all()  # exact to a small pixel
    assert (far[scale > 1] > half).any()
    assert (edges.partners[:, 0] < edges.frames).all()
    assert (edges.partners[:, 1] > edges.frames).all()


def test_a_second_run_reuses_everything(run: Run) -> None:
    before = {path: path.stat().st_mtime_ns for path in run.recording.parent.iterdir()}
    again = tooltip("estimate", run.recording)
    assert again.code == 0
    assert again.out == run.outcome.out
    assert f"reused {run.tip_path}" in again.err
    assert "computed" not in again.err
    assert {path: path.stat().st_mtime_ns for path in run.recording.parent.iterdir()} == before


def test_an_estimate_that_is_gone_is_made_from_the_same_edges(run: Run) -> None:
    before = run.document
    run.tip_path.unlink()
    again = tooltip("estimate", run.recording)
    assert f"reused {run.edges_path}" in again.err
    assert f"computed {run.tip_path}" in again.err
    for name in ("status", "tip", "candidates", "reasons", "frames_used"):
        assert run.document[name] == before[name]


def test_damaged_edges_are_made_anew_by_one_thread_and_are_the_same(run: Run) -> None:
    before = stored_edges(run)
    whole = run.edges_path.read_bytes()
    run.edges_path.write_bytes(whole[: len(whole) // 2])
    run.tip_path.unlink()
    again = tooltip("estimate", run.recording, "--jobs", 1)
    assert again.code == 0
    assert f"computed {run.edges_path}" in again.err
    assert again.out == run.outcome.out
    after = stored_edges(run)
    names = ("frames", "partners", "affines", "counts", "pixels", "translations", "covariances")
    for name in names:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), name)


def shuffled(edges: MovingEdges, seed: int) -> MovingEdges:
    """Return the same edges and outlines, those of each frame in another order."""
    rng = np.random.default_rng(seed)
    silhouettes = edges.silhouettes
    assert silhouettes is not None
    edge = np.lexsort((rng.random(len(edges.pixels)), edges.frame_of_edge))
    point = np.lexsort((rng.random(len(silhouettes.contours)), silhouettes.row_of_point))
    return replace(
        edges,
        pixels=edges.pixels[edge],
        translations=edges.translations[edge],
        covariances=edges.covariances[edge],
        silhouettes=replace(silhouettes, contours=silhouettes.contours[point]),
    )


def test_neither_seed_nor_order_moves_the_tip(first: Run) -> None:
    recording = read_recording(first.recording, Topics())
    views = resolve_views(recording, resolve_rig(recording, None))
    camera = inverse_transform(views.hand_from_camera)
    spheres = sphere_array([(item.center, item.radius) for item in views.spheres])
    edges, settings = stored_edges(first), VotingSettings()

    def pixels(moving: MovingEdges, seed: int) -> npt.NDArray[np.float64]:
        used = replace(settings, trust=TrustParams(seed=seed))
        found = estimate_by_voting(hand_edges(views, moving, camera, used), spheres, used)
        assert found.position is not None
        seen = camera[:, :3, :3] @ found.position + camera[:, :3, 3]
        return np.asarray(views.camera.project(seen))

    before = pixels(edges, 0)
    for after in (pixels(edges, 1), pixels(shuffled(edges, 0), 0), pixels(shuffled(edges, 1), 2)):
        assert np.nanmax(np.linalg.norm(after - before, axis=1)) < 0.1


def test_other_labels_are_other_edges(run: Run) -> None:
    """Labels of other images: neither the edges nor the estimate of before is reused."""
    path = run.recording.with_name("small.labels.csv")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-2]))
    again = tooltip("estimate", run.recording, "--jobs", 2)
    assert again.code == 0
    assert f"computed {run.edges_path}" in again.err
    assert f"computed {run.tip_path}" in again.err


def test_stored_edges_are_of_their_levels(first: Run) -> None:
    """Where no image is halved the key is that of files from before any could be."""
    recording = read_recording(first.recording, Topics())
    views, settings = resolve_views(recording, resolve_rig(recording, None)), VotingSettings()
    pairing, _ = pair_views(views, settings, unlabelled(recording, views.camera, None))
    whole = replace(pairing, levels=np.zeros_like(pairing.levels))
    halved = replace(pairing, levels=whole.levels + (pairing.frames == pairing.frames[3]))
    keys = [known_edges(recording, views, some, settings).key for some in (whole, halved)]
    assert len(set(keys)) == 2
    origin = read_provenance(first.edges_path)
    assert origin is not None
    assert (origin["key"] == keys[0]) == (not pairing.levels.any())
    found = known_edges(recording, views, pairing, settings)
    assert isinstance(found, DetectedEdges)
    assert found.reused


@pytest.mark.parametrize(
    ("motion", "frames", "size", "code"),
    [
        ("in_plane", 60, "160x120", "depth_unobservable"),
        ("still", 12, "160x120", "no_motion"),
        ("fast", 8, "1280x960", "too_fast"),
    ],
)
def test_motion_that_cannot_show_the_tip_is_refused(
    tmp_path: Path, motion: str, frames: int, size: str, code: str
) -> None:
    run = Run(simulate(tmp_path / "small.mcap", frames, size, motion), Outcome(0, "", ""))
    done = tooltip("estimate", run.recording)
    assert done.code == 3
    assert done.out == f"small: refused ({code})\n"
    assert f"refused: {code}: " in done.err
    document = run.document
    assert document["status"] == "refused"
    assert document["tip"] is None
    assert document["candidates"] == []
    assert [reason["code"] for reason in document["reasons"]] == [code]
    assert not run.edges_path.exists()  # the motion alone told
    again = tooltip("estimate", run.recording)
    assert again.code == 3
    assert f"reused {run.tip_path}" in again.err


@pytest.fixture
def clouds(monkeypatch: pytest.MonkeyPatch) -> list[Cloud]:
    """What is reconstructed, from here on."""
    made: list[Cloud] = []

    def kept(edges: HandEdges, params: VotingParams) -> Cloud:
        made.append(reconstruct(edges, params))
        return made[-1]

    monkeypatch.setattr("tooltip_cli.method.voting.volume.reconstruct", kept)
    return made


def late_rig(run: Run, folder: Path) -> Path:
    """Write the recording's rig with image stamps that are put 30 ms too late."""
    recording = read_recording(run.recording, Topics())
    rig = resolve_rig(recording, None)
    return write_rig(replace(rig, time_offset_s=0.03), folder)


def test_a_wrong_clock_is_put_right(run: Run, tmp_path: Path) -> None:
    late = late_rig(run, tmp_path / "late")
    # images are stamped at the end of their exposure: half of it before is right
    half_exposure = truth(run.recording)["mid_exposure_before_stamp_s"]
    done = tooltip("estimate", run.recording, "--rig", late, "--refine", "time", "--json")
    assert done.code == 0, done.err
    refined = json.loads(done.out)["refined"]
    assert refined["applied"]
    assert refined["camera"] is None
    assert refined["time_offset_s"] == pytest.approx(-0.03 - half_exposure, abs=0.005)
    again = tooltip("estimate", run.recording, "--rig", late, "--refine", "time", "--json")
    assert "reused" in again.err
    assert json.loads(again.out)["refined"] == refined


def test_a_wrong_clock_is_put_right_unasked_where_the_images_disagree(
    run: Run, tmp_path: Path, clouds: list[Cloud]
) -> None:
    assert "refined" not in run.document  # the right one: nothing to look for
    late = late_rig(run, tmp_path / "late")
    done = tooltip("estimate", run.recording, "--rig", late, "--json", "--force")
    assert done.code == 0, done.err
    assert len(clouds) == 1  # what was voted for is kept
    assert "image clock -" in done.err
    document = json.loads(done.out)
    assert document["refined"]["applied"]
    assert document["refined"]["support_after"] > document["refined"]["support_before"]
    kept = tooltip("estimate", run.recording, "--rig", late, "--refine", "none", "--json")
    assert "computed" in kept.err
    assert "image clock" not in kept.err
    as_it_is = json.loads(kept.out)
    assert "refined" not in as_it_is
    tip = np.array(truth(run.recording)["tip_in_hand_m"])
    off, off_as_it_is = (
        np.linalg.norm(np.array(one["tip"]["position_m"]) - tip) for one in (document, as_it_is)
    )
    assert off < 0.003
    assert off_as_it_is > 2 * off


def test_all_that_follows_is_by_the_clock_that_was_put_right(run: Run, tmp_path: Path) -> None:
    late, report = late_rig(run, tmp_path / "late"), tmp_path / "report"
    done = tooltip("evaluate", run.recording, "--rig", late, "--out", report, "--json")
    assert done.code == 0, done.err
    (row,) = json.loads(done.out)["recordings"]
    kept = tooltip(
        "evaluate", run.recording, "--rig", late, "--refine", "none",
        "--out", tmp_path / "kept", "--json",
    )  # fmt: skip
    (as_it_is,) = json.loads(kept.out)["recordings"]
    # labels know nothing of it
    assert row["baseline"]["error_px"] == as_it_is["baseline"]["error_px"]
    assert row["detector"]["error_px"]["mean"] < 0.7 * as_it_is["detector"]["error_px"]["mean"]
    assert row["detector"]["error_px"]["mean"] < row["baseline"]["error_px"]["mean"]
    # of an error by the right clock, clocks have no part, and labels by it do no better
    assert row["shares"]["clock_px"] < 0.2 < as_it_is["shares"]["clock_px"]
    assert abs(row["shares"]["detection_px"]) < 1
    assert any("image clock" in note for note in row["notes"])
    assert not any("image clock" in note for note in as_it_is["notes"])

    estimated = tooltip("estimate", run.recording, "--rig", late, "--json")
    offset_s = json.loads(estimated.out)["refined"]["time_offset_s"]
    log = tmp_path / "right.mcap"
    done = tooltip("export", run.recording, log, "--rig", late)
    assert done.code == 0, done.err
    right = resolve_rig(read_recording(log, Topics()), None)
    assert right.time_offset_s == pytest.approx(0.03 + offset_s, abs=1e-9)
    hints = find_hints(read_recording(run.recording, Topics()), late, None).predictions
    recording = read_recording(run.recording, Topics())
    tip = np.array(json.loads(estimated.out)["tip"]["position_m"])
    (frame, *_) = hints
    seen = project_tip(resolve_views(recording, right), tip, np.array([frame]))
    np.testing.assert_allclose(hints[frame], seen[0], atol=0.01)
    unshifted = project_tip(
        resolve_views(recording, load_rig(late)), tip, np.array(list(hints), dtype=np.intp)
    )
    assert np.nanmax(np.abs(unshifted - np.array(list(hints.values())))) > 1


def with_joints(recording: Recording, kept: Callable[[Stamps], Stamps]) -> Recording:
    """Return a recording with joints at chosen stamps, interpolated."""
    joints = {}
    for name, track in recording.joints.items():
        stamps = kept(track.stamps_ns)
        positions = interpolate(track.stamps_ns, track.positions, stamps, 10**9)
        joints[name] = replace(track, stamps_ns=stamps, positions=positions)
    return replace(recording, joints=joints)


def estimate_late(recording: Recording, out: Path, put_right: str = "auto") -> TipEstimate:
    """Estimate with image stamps that are put 30 ms too late."""
    rig = replace(resolve_rig(recording, None), time_offset_s=0.03)
    views = resolve_views(recording, rig)
    allowed = np.ones(len(views.stamps_ns), dtype=bool)
    params = EstimatorParams(voting=VotingSettings(put_right=put_right))
    return estimate_from_images(recording, rig, views, params, allowed, out=out).estimate


def test_edges_are_seen_by_another_clock_as_if_they_were_undistorted_anew(
    first: Run, tmp_path: Path
) -> None:
    recording, settings = read_recording(first.recording, Topics()), VotingSettings()
    rig = resolve_rig(recording, None)
    views, later = (
        resolve_views(recording, replace(rig, time_offset_s=offset)) for offset in (0.0, 0.01)
    )
    allowed = np.ones(len(views.stamps_ns), dtype=bool)
    votes = gather_votes(recording, views, settings, allowed, out=tmp_path, jobs=1)
    assert isinstance(votes, Votes)
    seen = votes.seen_by(views, settings)
    moved, anew = votes.moved(seen, later), votes.seen_by(later, settings)
    assert moved is not None
    assert not np.array_equal(moved.camera_from_hand, seen.camera_from_hand)
    for name in ("points", "moved", "background", "camera_from_hand"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(anew, name))
    assert moved.silhouettes is not None
    assert anew.silhouettes is not None
    for name in ("camera_from_hand", "masks", "view", "points", "rows"):
        np.testing.assert_array_equal(
            getattr(moved.silhouettes, name), getattr(anew.silhouettes, name)
        )
    lost = later.hand_from_camera.copy()
    lost[seen.moving.frames[0]] = np.nan
    fewer = replace(later, hand_from_camera=lost)
    assert votes.moved(seen, fewer) is None
    assert votes.moved(votes.seen_by(fewer, settings), later) is None


def test_images_whose_pose_is_unknown_by_the_right_clock_are_left_out(
    first: Run, tmp_path: Path, clouds: list[Cloud]
) -> None:
    whole = read_recording(first.recording, Topics())
    # by the wrong clock image 50 comes just after the gap, by the right one inside it
    end = int(whole.image_stamps_ns[50]) + 15_000_000
    gap = with_joints(whole, lambda t: t[(t < end - 135_000_000) | (t > end)])
    found = estimate_late(gap, tmp_path)
    assert found.refinement is not None
    assert found.refinement.applied
    right = put_right(gap, replace(resolve_rig(gap, None), time_offset_s=0.03),
                      found.refinement.correction)  # fmt: skip
    known = resolve_views(gap, right).known
    assert not known[50]
    assert len(clouds) == 2  # of other images
    assert found.position is not None
    off = found.position - truth(first.recording)["tip_in_hand_m"]
    assert np.linalg.norm(off) < 0.004


def test_still_views_keep_their_rig(
    first: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tooltip_cli.log.views.MAX_GAP_NS", 60_000_000)
    whole = read_recording(first.recording, Topics())
    shown = whole.image_stamps_ns[::2] + 30_000_000  # poses are known there and nowhere else
    still = with_joints(whole, lambda t: shown[(shown > t[0]) & (shown < t[-1])])
    few = {
        how: estimate_late(still, tmp_path / how, how) for how in ("auto", "time", "all", "none")
    }
    assert {found.status for found in few.values()} == {"ok"}
    for how in ("time", "all"):
        refinement = few[how].refinement
        assert refinement is not None
        assert refinement.correction.time_offset == 0


def test_what_may_be_put_right_must_be_known(first: Run, tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match=r"unknown choice.*'off'; known: all, auto, none, time"):
        estimate_late(read_recording(first.recording, Topics()), tmp_path, "off")


def test_hints_do_not_put_another_rig_right(run: Run, tmp_path: Path) -> None:
    late = late_rig(run, tmp_path / "late")
    done = tooltip("estimate", run.recording, "--rig", late, "--json")
    tip = np.array(json.loads(done.out)["tip"]["position_m"])
    recording = read_recording(run.recording, Topics())
    hints = find_hints(recording, None, None).predictions  # by the rig in the recording
    (frame, *_) = hints
    seen = project_tip(
        resolve_views(recording, resolve_rig(recording, None)), tip, np.array([frame])
    )
    np.testing.assert_allclose(hints[frame], seen[0], atol=0.01)


def test_a_rig_is_not_put_right_for_another_end() -> None:
    def estimate(*ends: tuple[float, float]) -> TipEstimate:
        found = tuple(
            Candidate(np.array([x, 0.0, 0.0]), 1.0, agreement=agreement) for x, agreement in ends
        )
        return TipEstimate("voting", found[0].position, np.eye(3), found, (), 100)

    doubted = estimate((0.2, 0.55), (-0.1, 0.85))
    assert gain(doubted, estimate((0.205, 0.95))) == pytest.approx(0.4)
    assert gain(doubted, estimate((-0.1, 0.85))) == pytest.approx(0.0)
    assert gain(doubted, refused("voting", 100)) < 0


def test_what_is_exported_is_the_estimate_that_was_asked_for(run: Run) -> None:
    options = ("--refine", "none", "--prefer", "-1,0,0")
    done = tooltip("estimate", run.recording, *options)
    assert done.code == 0, done.err
    exported = tooltip("export", run.recording, "--tf", *options, "--json")
    assert exported.code == 0, exported.err
    assert f"reused {run.tip_path}" in exported.err
    translation = json.loads(exported.out)["transform"]["transform"]["translation"]
    tip = run.document["tip"]["position_m"]
    np.testing.assert_allclose([translation[axis] for axis in "xyz"], tip, atol=1e-6)


def test_what_is_unknown_of_the_camera_widens_the_tips_region(run: Run, tmp_path: Path) -> None:
    found = [
        json.loads(tooltip("estimate", run.recording, *more, "--json", "--out", tmp_path).out)
        for more in ((), ("--refine", "all", "--force"))
    ]
    alone, refined = (np.array(one["tip"]["covariance_m2"]) for one in found)
    assert np.linalg.eigvalsh(refined)[-1] > np.linalg.eigvalsh(alone)[-1]
    (first, *_) = found[1]["candidates"]
    np.testing.assert_allclose(first["covariance_m2"], refined)


def test_calibrate_writes_a_rig_that_is_right(run: Run, tmp_path: Path) -> None:
    late = late_rig(run, tmp_path / "late")
    out = tmp_path / "right"
    done = tooltip("calibrate", run.recording, "--rig", late, "--clocks-only", "--out", out)
    assert done.code == 0, done.err
    assert "image clock -" in done.out
    assert "used" in done.out
    rig = load_rig(out / "rig.yaml")
    half_exposure = truth(run.recording)["mid_exposure_before_stamp_s"]
    assert rig.time_offset_s == pytest.approx(-half_exposure, abs=0.005)
    again = tooltip("calibrate", run.recording, "--rig", late, "--out", out)
    assert again.code == 1
    assert "--force" in again.err


def test_refining_needs_images(run: Run) -> None:
    wrong = tooltip("estimate", run.recording, "--method", "kmeans", "--refine", "time")
    assert wrong.code == 2
    assert "voting" in wrong.err


def test_the_cloud_shows_the_tool_up_to_its_tip(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "tool.ply"
    done = tooltip("export", run.recording, "--cloud", path)
    assert done.code == 0, done.err
    head, body = path.read_bytes().split(b"end_header\n", 1)
    (count,) = (int(line.split()[2]) for line in head.splitlines() if b"element vertex" in line)
    layout = np.dtype([("point", "<f4", 3), ("color", "u1", 3), ("frames", "<i4")])
    rows = np.frombuffer(body, dtype=layout)
    assert len(rows) == count > 100
    tip = np.array(run.document["tip"]["position_m"])
    np.testing.assert_allclose(rows["point"][-1], tip, atol=1e-6)
    assert rows["color"][-1].tolist() == [255, 0, 0]
    assert np.linalg.norm(rows["point"][:-1] - tip, axis=1).min() < 0.008
    again = tooltip("export", run.recording, "--cloud", path)
    assert again.code == 1
    assert "--force" in again.err


def stored(folder: Path) -> dict[str, list[tuple[str, int, bytes]]]:
    """Return the messages of all artifacts in a folder, without where they come from."""
    return {
        path.name: [
            (item.topic, item.log_time_ns, bytes(item.payload))
            for item in iterate(path)
            if not isinstance(item, LoggedAttachment)
        ]
        for path in sorted(folder.glob("*.mcap"))
    }


def test_one_pass_finds_what_two_find_and_decodes_hardly_any_image_twice(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[tuple[str, bool]] = []

    def counted(message: Any, gray: bool, source: str) -> Image:
        decoded.append((source, gray))
        return decode_compressed(message, gray, source)

    monkeypatch.setattr("tooltip_cli.log.recording.decode_compressed", counted)
    detect = ("detect", run.recording, "--force", "--out")
    assert tooltip(*detect, tmp_path / "together").code == 0
    looked_at_first = 1 + 2 * (2 * 8)  # for the size, and for the noise, with and without labels
    again = sum(gray for _, gray in decoded) - looked_at_first - 100
    assert 1 <= again <= 31  # at the border of two parts: a pair's image, and some partners
    assert tooltip(*detect, tmp_path / "threads", "--jobs", 3).code == 0
    alone = ("estimate", run.recording, "--method", "map", "--out", tmp_path / "apart")
    assert tooltip(*alone).code in (0, 3)
    edges_alone = stored(run.recording.parent)["small.edges.mcap"]  # by the estimate
    together = stored(tmp_path / "together")
    assert together == {**stored(tmp_path / "apart"), "small.edges.mcap": edges_alone}
    assert together == stored(tmp_path / "threads")
