"""Real recordings cut into sessions: where laps end, and what their scans keep."""

import numpy as np
import pytest
from session_laps import find_laps, select_scans
from session_merging import labels_f1, largest_difference

import stillmap
from stillmap.io.trajectory import write_tum


def recording_of(scans: int) -> stillmap.Recording:
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


def write_place(folder, poses, p_static):
    (folder / "sessions/monday/beams").mkdir(parents=True)
    (folder / "sessions.json").write_text('[{"name": "monday", "accepted": true}]')
    write_tum(folder / "sessions/monday/trajectory.tum", np.arange(len(poses)) * 10**9, poses)
    np.save(folder / "sessions/monday/beams/p_static.npy", np.array(p_static, np.float32))


def test_places_are_compared_in_their_own_frames(tmp_path):
    poses = np.tile(np.eye(3), (3, 1, 1))
    poses[:, 0, 2] = [0.0, 1.0, 2.0]
    turned = np.array([[0.0, -1.0, 5.0], [1.0, 0.0, 3.0], [0.0, 0.0, 1.0]])
    other = turned @ poses
    other[2, :2, 2] += 0.25 * turned[:2, 1]
    write_place(tmp_path / "one", poses, [0.1, 0.9, 0.1, 0.9])
    write_place(tmp_path / "other", other, [0.1, 0.9, 0.9, 0.9])
    assert largest_difference(tmp_path / "one", tmp_path / "other") == pytest.approx(0.25)
    assert labels_f1(tmp_path / "one", tmp_path / "other") == pytest.approx(2 / 3)
