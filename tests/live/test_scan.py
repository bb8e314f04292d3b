"""Scans as users push them."""

import numpy as np
import pytest

from stillmap.live.scan import Scan, drop_cover, to_beams


def test_readings_mean_what_they_mean_in_ros():
    ranges = [1.0, np.nan, -1.0, 0.0, np.inf, 8.0, 0.05]
    beams = to_beams(Scan(1.5, ranges, np.zeros(7), min_range=0.1, max_range=8.0))
    assert beams.stamp_ns == 1_500_000_000
    assert beams.hit.tolist() == [True, False, False, False, False, False, False]
    np.testing.assert_allclose(beams.points[[0, 4, 5], 0], [1.0, 8.0, 8.0])
    assert np.isnan(beams.points[[1, 2, 3, 6]]).all()
    # without a stated range nothing is known of beams without a return
    beams = to_beams(Scan(0, [2.0, np.inf], [0.0, 0.5]))
    assert beams.hit.tolist() == [True, False]
    assert np.isnan(beams.points[1]).all()


def test_angles_and_mount():
    beams = to_beams(Scan(0, [2.0], [np.pi / 2], sensor_pose=(1.0, 0.0, np.pi)))
    np.testing.assert_allclose(beams.points, [[0.0, 2.0]], atol=1e-6)
    np.testing.assert_allclose(beams.T_base_sensor[:2, 2], [1.0, 0.0])
    np.testing.assert_allclose(beams.T_base_sensor[0, 0], -1.0)


def test_points_with_and_without_returns():
    points = np.array([[1.0, 0.0], [np.nan, 0.0], [3.0, 4.0]])
    beams = to_beams(Scan(0, points=points, hit=[True, True, False]))
    assert beams.hit.tolist() == [True, False, False]
    np.testing.assert_allclose(beams.points[2], [3.0, 4.0])
    assert np.isnan(beams.points[1]).all()
    assert not np.isnan(points[0]).any()  # not written into
    beams = to_beams(Scan(0, points=points, max_range=2.5))
    assert beams.hit.tolist() == [True, False, False]
    np.testing.assert_allclose(beams.points[2], [1.5, 2.0])


@pytest.mark.parametrize(
    ("scan", "named"),
    [
        (Scan(0), "ranges"),
        (Scan(0, [1.0, 2.0], [0.0]), "angles"),
        (Scan(np.nan, [1.0], [0.0]), "stamps"),
        (Scan(0, points=np.ones((3, 4))), "points"),
        (Scan(0, points=np.ones((3, 2)), hit=[True]), "hit"),
        (Scan(0, [1.0], [0.0], beam_times=[0.0, 1.0]), "beam_times"),
        (Scan(0, [1.0], [0.0], beam_times=[np.inf]), "beam_times"),
        (Scan(0, [1.0], [0.0], sensor_pose=(1.0, 2.0)), "sensor_pose"),
        (
            Scan(0, [1.0], [0.0], sensor_pose=(1e6, 0.0, 0.0)),
            "sensor_pose: .* from the robot's base",
        ),
    ],
)
def test_what_is_wrong_is_named(scan, named):
    with pytest.raises(ValueError, match=named):
        to_beams(scan)


@pytest.mark.parametrize(
    ("near", "is_covered"), [(180, True), (165, True), (120, False), (0, False)]
)
def test_what_covers_the_laser_is_dropped(near, is_covered):
    angles = np.linspace(-1.5, 1.5, 180)
    ranges = np.where(np.arange(180) < near, 0.1, 4.0)
    beams = to_beams(Scan(0.0, ranges, angles))
    left = drop_cover(beams)
    assert left.hit.any() != is_covered
    assert np.isnan(left.points).all() == is_covered
    assert beams.hit.all()
