"""Odometry that leaps, and given poses far from all others."""

import dataclasses

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.prepare.plausibility import leave_out_far_scans, remove_leaps

T, N = 20, 3


def drive(dimension=2):
    """A robot that drives 0.2 m per scan of three beams, ten scans a second."""
    pose = np.tile(np.eye(dimension + 1), (T, 1, 1))
    pose[:, 0, -1] = 0.2 * np.arange(T)
    points, hit = np.ones((T * N, dimension), np.float32), np.ones(T * N, bool)
    flat = of_one_sensor(np.arange(T) * 100_000_000, np.arange(T + 1) * N, points, hit)
    return dataclasses.replace(flat, T_odom_base=pose)


def shifted(recording, first, metres):
    moved = recording.T_odom_base.copy()
    moved[first:, :2, -1] += metres
    return dataclasses.replace(recording, T_odom_base=moved)


@pytest.mark.parametrize("dimension", [2, 3])
def test_odometry_goes_on_as_before(dimension):
    true = drive(dimension)
    found, (sentence,) = remove_leaps(shifted(true, 8, 1e6))
    np.testing.assert_allclose(found.T_odom_base, true.T_odom_base, atol=1e-6)
    assert "1 scan, first before scan 8 by 1.414e+06 m in 0.1 s" in sentence


@pytest.mark.parametrize(("metres", "hours"), [(50.0, 0.0), (5000.0, 1.0)])
def test_what_is_possible_stays(metres, hours):
    recording = shifted(drive(), 8, metres)
    stamps = recording.stamp_ns + (np.arange(T) >= 8) * round(3600e9 * hours)
    recording = dataclasses.replace(recording, stamp_ns=stamps)
    assert remove_leaps(recording) == (recording, [])
    without = dataclasses.replace(recording, T_odom_base=None)
    assert remove_leaps(without) == (without, [])


@pytest.mark.parametrize("dimension", [2, 3])
def test_beams_of_far_scans_are_unusable(dimension):
    recording = drive(dimension)
    poses = recording.T_odom_base.copy()
    poses[5, 1, -1] = 1e7
    found, (sentence,) = leave_out_far_scans(recording, poses, 0.05)
    far = np.zeros(T * N, bool)
    far[5 * N : 6 * N] = True
    np.testing.assert_array_equal(found.hit, ~far)
    np.testing.assert_array_equal(np.isnan(found.points).all(axis=1), far)
    assert recording.hit.all()
    assert not np.isnan(recording.points).any()
    assert "first scan 5 at (1, 1e+07) m" in sentence


@pytest.mark.parametrize("dimension", [2, 3])
def test_of_two_places_that_of_the_origin_stays(dimension):
    """Cells of the other one have no numbers."""
    recording = drive(dimension)
    poses = recording.T_odom_base.copy()
    poses[T // 2 :, 0, -1] -= 1e7
    found, (sentence,) = leave_out_far_scans(recording, poses, 0.05)
    assert np.isfinite(found.points[: N * T // 2]).all()
    assert np.isnan(found.points[N * T // 2 :]).all()
    assert "10 scans are farther" in sentence
