"""Poses between scans: exact where the motion is known."""

import dataclasses

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core import se2
from stillmap.pipeline import tilting_beams
from stillmap.pipeline.tilting_beams import interpolate_poses, pose_recording

TWIST = np.array([0.8, 0.1, 0.6])  # m/s, m/s, rad/s
START = se2.matrix(1.0, -2.0, 2.5)
STAMPS = np.array([0, 200, 450, 500, 500, 900], np.int64) * 1_000_000


def way(ns):
    """Where the robot is: along an arc."""
    return START @ se2.exp(1e-9 * np.asarray(ns, float)[:, None] * TWIST)


@pytest.mark.parametrize("theta", [0.0, 1e-9, 0.4, -3.0])
def test_exp_is_the_inverse_of_log(theta):
    xi = np.array([[0.3, -0.7, theta]])
    np.testing.assert_allclose(se2.log(se2.exp(xi)), xi, atol=1e-12)


def test_interpolation_along_an_arc():
    at = np.array([0, 70, 199, 200, 333, 500, 777, 900], np.int64) * 1_000_000
    poses, known = interpolate_poses(STAMPS, way(STAMPS), at)
    assert known.all()
    np.testing.assert_allclose(poses, way(at), atol=1e-12)


def test_unknown_outside_and_over_gaps(monkeypatch):
    monkeypatch.setattr(tilting_beams, "MAX_SCAN_GAP", 0.22)
    at = np.array([-1, 0, 1, 200, 300, 450, 901], np.int64) * 1_000_000
    _, known = interpolate_poses(STAMPS, way(STAMPS), at)
    assert known.tolist() == [False, True, True, True, False, True, False]


def test_unknown_over_a_leap():
    poses = way(STAMPS)
    poses[3:, 0, 2] += 20.0  # 50 ms later
    _, known = interpolate_poses(STAMPS, poses, np.array([440, 470, 600]) * 1_000_000)
    assert known.tolist() == [True, False, True]


def test_single_scan():
    poses, known = interpolate_poses(STAMPS[:1], way(STAMPS[:1]), np.array([0, 1]))
    assert known.tolist() == [True, False]
    np.testing.assert_array_equal(poses[1], START)


def seen_on_the_way(times):
    """A point in the map, seen by a tilted sensor in two scans, so long after their stamps."""
    c, s = np.cos(0.5), np.sin(0.5)
    T_base_sensor = np.array([[c, 0, s, 0.2], [0, 1, 0, 0.1], [-s, 0, c, 0.9], [0, 0, 0, 1]])
    stamps = np.array([100, 600], np.int64) * 1_000_000
    ns = (stamps[:, None] + np.round(1e9 * times)).astype(np.int64).ravel()
    T = np.zeros((len(ns), 4, 4))
    T[:, :2, :2], T[:, :2, 3] = way(ns)[:, :2, :2], way(ns)[:, :2, 2]
    T[:, 2, 2] = T[:, 3, 3] = 1.0
    point = np.array([4.0, -1.0, 1.3, 1.0])
    points = (se2.inverse(T @ T_base_sensor) @ point)[:, :3]
    offset, hit = np.array([0, len(times), 2 * len(times)]), np.ones(len(ns), bool)
    late = np.tile(times, 2).astype(np.float32)
    seen = of_one_sensor(stamps, offset, points.astype(np.float32), hit, beam_time=late)
    return point[:3], dataclasses.replace(seen, T_base_sensor=T_base_sensor[None])


def test_beams_end_at_the_point():
    point, recording = seen_on_the_way(np.array([-0.05, 0.0, 0.07, 0.2]))
    found = pose_recording(recording, STAMPS, way(STAMPS))
    assert found.unposed_beams == 0
    assert found.deskewed.beam_time is None
    ends = found.deskewed.end_points(np.arange(8), found.poses)
    np.testing.assert_allclose(ends, np.tile(point, (8, 1)), atol=1e-5)


def test_beams_after_the_last_scan_are_unusable():
    _, recording = seen_on_the_way(np.array([-0.2, 0.2, 0.31]))
    found = pose_recording(recording, STAMPS, way(STAMPS))
    assert found.unposed_beams == 2
    assert found.deskewed.hit.tolist() == [False, True, True, True, True, False]
    assert np.isnan(found.deskewed.points).any(axis=1).tolist() == (~found.deskewed.hit).tolist()
