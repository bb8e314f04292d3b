"""Quality of a result without truth: it falls with bent poses and with wrong labels."""

import dataclasses
import json

import numpy as np
import pytest

import stillmap
from stillmap import slam
from stillmap.core import se2
from stillmap.core.config import override
from stillmap.pipeline.options import Options
from stillmap.pipeline.quality import Quality, describe_quality, rate_quality
from stillmap.sim import scene_by_name, simulate
from stillmap.slam.options import SlamOptions
from stillmap.slam.rematching import rematch_windows


@pytest.fixture(scope="module")
def run():
    """An office with true poses and labels."""
    scene = scene_by_name("office", {"robot": {"scans": 300, "scan_rate": 1.0}})
    return simulate(scene, 0)


@pytest.fixture(scope="module")
def rated(run):
    """Rates poses, labels and a map; left out: the truth, or the map that follows from it."""
    truth = run.truth
    built = stillmap.build(run.recording, {"em.max_iterations": 1}, poses=truth.T_world_base)

    def rate(poses=truth.T_world_base, p_static=truth.static, p_occupied=None, threads=1):
        occupancy = built.map
        if p_occupied is not None:
            occupancy = dataclasses.replace(occupancy, p_occupied=p_occupied(occupancy.p_occupied))
        labels = p_static.astype(np.float32)
        return rate_quality(run.recording, poses, labels, occupancy, threads)

    return rate


@pytest.mark.slow
def test_true_poses_and_labels_are_good(rated):
    quality = rated()
    assert quality.geometry > 60.0
    assert quality.labels > 40.0
    assert min(quality.labels, quality.geometry) <= quality.overall
    assert quality.overall <= max(quality.labels, quality.geometry)


def test_bent_poses_lower_geometry(run, rated):
    truth = run.truth.T_world_base
    figures = [rated().geometry]
    for drift in (0.002, 0.01):  # rad for each scan
        bend = se2.matrix(*np.zeros((2, len(truth))), drift * np.arange(len(truth)))
        figures.append(rated(bend @ truth).geometry)
    assert figures[0] > figures[1] + 10.0 > figures[2] + 15.0


def test_wrong_labels_lower_labels_and_leave_geometry(run, rated):
    rng = np.random.default_rng(0)
    static = run.truth.static
    figures = [rated()]
    for share in (0.1, 0.5):
        wrong = static ^ (rng.random(len(static)) < share)
        figures.append(rated(p_static=wrong))
    labels = [quality.labels for quality in figures]
    assert labels[0] > labels[1] + 10.0 > labels[2] + 15.0
    assert len({quality.geometry for quality in figures}) == 1


def test_ghosts_lower_geometry(rated):
    rng = np.random.default_rng(0)

    def strew(p_occupied):
        spots = (rng.random(p_occupied.shape) < 0.003) & (p_occupied < 0.2)
        return np.where(spots, np.float32(0.9), p_occupied)

    before, after = rated(), rated(p_occupied=strew)
    assert after.geometry < before.geometry - 5.0
    assert after.labels == before.labels


def test_an_empty_map_has_no_geometry(rated):
    assert rated(p_occupied=np.zeros_like).geometry is None


@pytest.mark.slow
def test_in_3d_drift_lowers_geometry_and_wrong_labels_lower_labels():
    lidar = {"channels": 16, "columns": 450}
    run = simulate(scene_by_name("street", {"lidar": lidar, "robot": {"scans": 48}}), 0)
    truth, hit = run.truth.T_world_base, run.recording.hit
    recording = slam.deskew_recording(run.recording, truth, SlamOptions())
    occupancy = stillmap.build(run.recording, {"threads": 1}, poses=truth).map
    drift = np.tile(np.eye(4), (48, 1, 1))
    drift[:, 1, 3] = 0.01 * np.arange(48)
    wrong = run.truth.static ^ (np.random.default_rng(0).random(len(hit)) < 0.1)
    static = run.truth.static
    true, drifted, mislabelled = (
        rate_quality(recording, poses, labels.astype(np.float32), occupancy)
        for poses, labels in ((truth, static), (drift @ truth, static), (truth, wrong))
    )
    assert true.geometry > drifted.geometry + 20.0
    assert true.labels > mislabelled.labels + 20.0
    assert mislabelled.geometry == true.geometry


def test_does_not_depend_on_the_number_of_threads(rated):
    assert rated(threads=1) == rated(threads=4)


def test_labels_of_a_place_where_nothing_moves_cannot_be_told():
    run = simulate(scene_by_name("corridor-empty", {"robot": {"scans": 60}}), 0)
    quality = stillmap.build(run.recording, {"threads": 1}).quality
    assert quality.labels is None
    assert quality.overall == quality.geometry > 50.0


def test_views_to_one_side_are_not_matched_anew():
    """As of a depth camera: lidar odometry would find wrong poses, and labels that suit them."""
    lidar = {"channels": 16, "columns": 450, "sweep": False}
    run = simulate(scene_by_name("street", {"lidar": lidar, "robot": {"scans": 20}}), 0)
    ahead = run.recording.points[:, 0] > np.abs(run.recording.points[:, 1])
    recording = dataclasses.replace(run.recording, hit=run.recording.hit & ahead)
    poses = run.truth.T_world_base
    (window,) = rematch_windows(recording, poses)
    assert window.rematched is None
    assert window.disagreement() is None
    quality = stillmap.build(recording, {"threads": 1}, poses=poses).quality
    assert quality.evidence.disagreement is None
    assert quality.geometry > 50.0


def test_of_one_scan_nothing_can_be_told(run):
    recording = run.recording.without_odometry().slice_scans(0, 1)
    occupancy = stillmap.build(recording, poses=np.eye(3)[None]).map
    p_static = np.ones(recording.n_beams, np.float32)
    quality = rate_quality(recording, np.eye(3)[None], p_static, occupancy)
    assert quality.geometry is None
    assert quality.overall is None
    words = describe_quality(quality)
    assert words["geometry"] == "geometry: cannot be determined from this recording"


@pytest.mark.parametrize("estimator", ["stillmap", "hit-ratio"])
def test_run_json_has_it(room, tmp_path, estimator):
    options = override(Options(), {"estimator": estimator, "threads": 1})
    result = stillmap.build(room.recording, options)
    assert 0.0 <= result.quality.labels <= 100.0
    result.save(tmp_path / "out")
    written = json.loads((tmp_path / "out" / "run.json").read_text())["quality"]
    parts = ("overall", "labels", "geometry")
    assert written == {name: getattr(result.quality, name) for name in parts}


def test_no_result_is_good_whose_labels_are_poor():
    good, poor = (describe_quality(Quality(82.0, labels, 96.0)) for labels in (75.0, 49.0))
    assert good["overall"].startswith("overall 82 of 100: good (")
    assert poor["overall"].startswith("overall 82 of 100: usable (")
