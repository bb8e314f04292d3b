"""Beams of a scan in the viewer."""

import numpy as np
import pytest

from stillmap.io import read
from stillmap.io.trajectory import poses_from_tum
from stillmap.results.viewer import scene as viewer_scene
from stillmap.results.viewer.scene import Beams
from stillmap.slam import SlamOptions, deskew_recording


@pytest.fixture(params=[(2, False), (2, True), (3, False), (3, True)])
def beams(request, result_of):
    dimension, times = request.param
    out = result_of(dimension, times=times)
    recording = read(out.parent / f"log{dimension}")
    poses = poses_from_tum(out / "trajectory.tum", recording)
    p_static = np.load(out / "beams/p_static.npy", mmap_mode="r")
    return Beams(recording, p_static, poses, SlamOptions())


def test_end_points_equal_those_of_the_result(beams):
    whole = deskew_recording(beams.recording, beams.poses, beams.slam)
    for scan in range(whole.n_scans):
        ends, p_static, origin = beams.scan_view(scan)
        own = whole.beams_of(scan)
        use = np.flatnonzero(whole.hit[own]) + own.start
        D = whole.dimension
        assert ends[:, :D] == pytest.approx(whole.end_points(use, beams.poses), abs=1e-6)
        assert not ends[:, D:].any()
        assert np.array_equal(p_static, beams.p_static[use])
        sensor = (beams.poses[scan] @ whole.T_base_sensor[0])[:D, D]
        assert origin[:D] == pytest.approx(sensor)


def test_number_of_beams_is_limited(beams):
    ends, p_static, _ = beams.scan_view(2, max_count=7)
    assert (len(ends), len(p_static)) == (7, 7)
    every, _, _ = beams.scan_view(2)
    assert all((every == end).all(axis=1).any() for end in ends)


def test_dynamic_ends(beams):
    """They are the dynamic end points of all scans."""
    D = beams.recording.dimension
    views = [beams.scan_view(scan) for scan in range(beams.recording.n_scans)]
    ends = np.concatenate([ends[p < 0.5] for ends, p, _ in views])[:, :D]
    assert beams.dynamic_ends(1000) == pytest.approx(ends, abs=1e-5)
    some = beams.dynamic_ends(5)
    assert len(some) == 5
    assert all((np.abs(ends - one).max(axis=1) < 1e-5).any() for one in some)


def test_of_a_long_recording_not_every_block_is_read(beams, monkeypatch):
    """Showing hours does not take as long as mapping them."""
    monkeypatch.setattr(viewer_scene, "_BLOCK_SCANS", 1)
    monkeypatch.setattr(viewer_scene, "_MAX_READ", beams.recording.n_beams // 2)
    views = [beams.scan_view(scan) for scan in range(beams.recording.n_scans)]
    counts = [int((p < 0.5).sum()) for _, p, _ in views]
    assert 0 < len(beams.dynamic_ends(10_000)) < sum(counts)
