"""Real recordings cut into sessions: where laps end, and what their scans keep."""

import numpy as np
import pytest
from session_laps import find_laps, select_scans

import stillmap


def recording_of(scans):
    ranges = 1.0 + np.arange(scans)[:, None] + np.array([0.0, 0.25, 0.5])
    odometry = np.column_stack([np.arange(scans), np.zeros(scans), np.zeros(scans)])
    return stillmap.Recording.from_scans(
        100.0 + np.arange(scans), ranges, np.array([-1.0, 0.0, 1.0]), odometry=odometry
    )


def test_selected_scans_keep_their_beams():
    whole = recording_of(10)
    part = select_scans(whole, np.array([2, 3, 7]))
    assert part.n_scans == 3
    np.testing.assert_array_equal(part.stamp_ns, whole.stamp_ns[[2, 3, 7]])
    np.testing.assert_array_equal(part.T_odom_base, whole.T_odom_base[[2, 3, 7]])
    np.testing.assert_array_equal(part.offset, [0, 3, 6, 9])
    np.testing.assert_array_equal(part.points[6:], whole.points[21:24])


def test_a_lap_ends_where_the_robot_is_nearest_to_its_start():
    angle = np.linspace(0.0, 4 * np.pi, 401)
    circle = 10.0 * np.column_stack([1.0 - np.cos(angle), np.sin(angle)])
    reference = np.column_stack([np.arange(401.0), circle, angle])
    assert find_laps(reference) == [pytest.approx(200.0, abs=1.0)]
    assert find_laps(reference[:150]) == []
