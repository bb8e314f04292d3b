"""Deskewing against scans taken at one instant."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import of_one_sensor
from scipy.linalg import expm

from stillmap.core import se2
from stillmap.core.source import Source
from stillmap.slam import SlamOptions, deskew_recording

PERIOD = 0.1
OPTIONS = SlamOptions()
PLACES = [(0.0, 0.0, 0.0), (0.4, -0.3, 2.0)]
# straight on, a turn, an arc, at rest
TWISTS = [(1.5, 0.2, 0.0), (0.0, 0.0, -2.5), (5.0, -0.4, 1.2), (0.0, 0.0, 0.0)]


def moved(twist, seconds):
    """(N, 3, 3) how far a robot in even motion comes in so many seconds (N,)."""
    vx, vy, turn = twist
    rate = np.array([[0.0, -turn, vx], [turn, 0.0, vy], [0.0, 0.0, 0.0]])
    return np.asarray(expm(seconds[:, None, None] * rate))


def made(stamps, way, places, sensor, times, beams=12):
    """A recording of posts that stand around, and where they are: (M, 2) in the map.

    Args:
        stamps: (T,) seconds.
        way: poses of the robot at the time of each beam (M, 3, 3).
        places, sensor: where the sensors sit, and which took each scan.
        times: (M,) seconds after the stamps.
    """
    T = len(stamps)
    posts = np.random.default_rng(1).uniform(-9, 9, (T * beams, 2))
    T_base_sensor = se2.matrix(*np.array(places).T)
    T_map_sensor = way @ T_base_sensor[np.repeat(sensor, beams)]
    seen = np.einsum("nij,nj->ni", se2.inverse(T_map_sensor), np.c_[posts, np.ones(T * beams)])
    stamp_ns, points = np.round(1e9 * stamps).astype(np.int64) + 10**18, seen[:, :2].astype("f4")
    recording = replace(
        of_one_sensor(stamp_ns, np.arange(T + 1) * beams, points, np.ones(T * beams, bool)),
        T_base_sensor=T_base_sensor,
        sensor=np.array(sensor, np.int32),
        beam_time=times.astype(np.float32),
    )
    return recording, posts


def even(twist, times, place=(0.0, 0.0, 0.0), T=5):
    """A robot in even motion; the poses at the stamps, and the posts."""
    stamps = PERIOD * np.arange(T)
    all_times = np.tile(times, T)
    when = np.repeat(stamps, len(times)) + all_times
    way = moved(twist, when)
    recording, posts = made(stamps, way, [place], [0] * T, all_times, len(times))
    return recording, moved(twist, stamps), posts


def laid(recording, poses):
    """(M, 2) points in the map, every scan taken at once."""
    T = np.repeat(recording.T_map_sensor(poses), np.diff(recording.offset), axis=0)
    return np.einsum("nij,nj->ni", T[:, :2, :2], recording.points) + T[:, :2, 2]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("twist", TWISTS)
@pytest.mark.parametrize(("first", "last"), [(0.0, 0.1), (-0.1, 0.0), (-0.05, 0.05), (0.0, 0.03)])
def test_posts_stay_in_place(twist, place, first, last):
    recording, poses, posts = even(twist, np.linspace(first, last, 12), place)
    seen = deskew_recording(recording, poses, OPTIONS)
    np.testing.assert_allclose(laid(seen, poses), posts, atol=2e-5)
    if any(twist):
        assert np.abs(laid(recording, poses) - posts).max() > 0.02
    else:
        np.testing.assert_array_equal(seen.points, recording.points)


def test_numbers_by_hand():
    # 2 m/s ahead: what lies 5 m ahead 0.1 s after the stamp was 5.2 m away at it
    recording, poses, _ = even((2.0, 0.0, 0.0), np.array([0.0, 0.1]), T=3)
    points = np.tile(np.array([[5.0, 1.0]], np.float32), (6, 1))
    seen = deskew_recording(replace(recording, points=points), poses, OPTIONS)
    np.testing.assert_allclose(seen.points, [[5.0, 1.0], [5.2, 1.0]] * 3, atol=1e-6)
    # a quarter turn to the left in 0.1 s: what is ahead at its end was to the left
    recording, poses, _ = even((0.0, 0.0, 5 * np.pi), np.array([0.0, 0.1]), T=3)
    slower = replace(recording, stamp_ns=(recording.stamp_ns - 10**18) * 2)
    times = slower.beam_time * 2
    seen = deskew_recording(replace(slower, points=points, beam_time=times), poses, OPTIONS)
    np.testing.assert_allclose(seen.points, [[5.0, 1.0], [-1.0, 5.0]] * 3, atol=1e-6)


def test_nothing_else_changes():
    recording, poses, _ = even((5.0, 0.0, 1.0), np.linspace(0.0, 0.1, 12))
    points = recording.points.copy()
    points[7] = np.nan
    recording = replace(recording, points=points, T_odom_base=poses, source=Source("a"))
    before = points.copy()
    seen = deskew_recording(recording, poses, OPTIONS)
    np.testing.assert_array_equal(recording.points, before)
    assert np.isnan(seen.points[7]).all()
    assert np.isfinite(np.delete(seen.points, 7, axis=0)).all()
    assert seen.beam_time is None
    for name in ("stamp_ns", "offset", "hit", "T_base_sensor", "sensor", "T_odom_base", "source"):
        assert getattr(seen, name) is getattr(recording, name)
    # the frame of the poses says nothing
    elsewhere = deskew_recording(recording, se2.matrix(30.0, -7.0, 2.0) @ poses, OPTIONS)
    np.testing.assert_allclose(elsewhere.points, seen.points, atol=1e-5)


def test_unchanged_without_times_poses_or_option():
    recording, poses, _ = even((5.0, 0.0, 1.0), np.linspace(0.0, 0.1, 12))
    assert deskew_recording(recording, None, OPTIONS) is recording
    assert deskew_recording(recording, poses, SlamOptions(deskew=False)) is recording
    at_once = replace(recording, beam_time=None)
    assert deskew_recording(at_once, poses, OPTIONS) is at_once


def test_alternating_errors_are_suppressed():
    """A pose that lies ahead must not pull its own scan back, and the one before ahead."""
    recording, poses, posts = even((5.0, 0.0, 0.0), np.linspace(0.0, 0.1, 12), T=9)
    off = poses @ se2.matrix(0.03 * (-1.0) ** np.arange(9), 0.0, 0.0)
    seen = deskew_recording(recording, off, OPTIONS)
    errors = np.abs(laid(seen, poses) - posts).reshape(9, -1)
    assert errors[1:-2].max() < 1e-4  # the first and the last two have fewer neighbours


@pytest.mark.parametrize("early", [False, True])
def test_two_lasers_in_turns(early):
    """2 ms apart: 1 cm between their poses is an error, not 5 m/s."""
    twist, apart, T = (3.0, 0.0, 0.5), 0.002, 12
    stamps = PERIOD * (np.arange(T) // 2) + apart * (np.arange(T) % 2)
    times = np.tile(np.linspace(0.0, 0.09, 12) - (0.09 if early else 0.0), T)
    when = np.repeat(stamps, 12) + times
    way = moved(twist, when)
    places = [(0.4, 0.2, 0.1), (-0.5, 0.0, 3.0)]
    recording, posts = made(stamps, way, places, [0, 1] * (T // 2), times)
    poses = moved(twist, stamps)
    off = poses @ se2.matrix(0.005 * (-1.0) ** np.arange(T), 0.0, 0.0)
    seen = deskew_recording(recording, off, OPTIONS)
    assert np.abs(laid(seen, poses) - posts).max() < 0.012
    assert np.abs(laid(recording, poses) - posts).max() > 0.25


@pytest.mark.parametrize("leap", [(40.0, 0.0, 0.0), (0.0, -3.0, 1.0), (0.0, 0.0, 2.0)])
def test_leaps_are_no_motion(leap):
    recording, poses, posts = even((1.0, 0.0, 0.0), np.linspace(0.0, 0.1, 12), T=30)
    leaping, leap = poses.copy(), poses[4] @ se2.matrix(*leap) @ se2.inverse(poses[4])
    leaping[4:] = leap @ leaping[4:]
    seen = deskew_recording(recording, leaping, OPTIONS)
    errors = np.abs(laid(seen, poses) - posts).reshape(30, -1).max(axis=1)
    np.testing.assert_allclose(np.delete(errors, [2, 3, 4]), 0.0, atol=1e-5)
    # the scan before it stays as it was taken, half of its motion lends to those beside it
    assert errors.max() < 0.06


def test_equal_stamps_single_scan_and_no_beams():
    recording, poses, _ = even((5.0, 0.0, 1.0), np.linspace(0.0, 0.1, 12))
    together = deskew_recording(replace(recording, stamp_ns=np.full(5, 10**18)), poses, OPTIONS)
    np.testing.assert_array_equal(together.points, recording.points)
    one, pose, _ = even((5.0, 0.0, 1.0), np.linspace(-0.1, 0.1, 12), T=1)
    np.testing.assert_array_equal(deskew_recording(one, pose, OPTIONS).points, one.points)
    empty = replace(
        recording,
        offset=np.zeros(6, np.int64),
        points=recording.points[:0],
        hit=recording.hit[:0],
        beam_time=recording.beam_time[:0],
    )
    assert deskew_recording(empty, poses, OPTIONS).n_beams == 0


def test_scans_without_beams():
    recording, poses, posts = even((5.0, 0.0, 1.0), np.linspace(0.0, 0.1, 12))
    kept = np.ones(60, bool)
    kept[24:36] = kept[:12] = False
    fewer = replace(
        recording,
        offset=np.array([0, 0, 12, 12, 24, 36]),
        points=recording.points[kept],
        hit=recording.hit[kept],
        beam_time=recording.beam_time[kept],
    )
    seen = deskew_recording(fewer, poses, OPTIONS)
    np.testing.assert_allclose(laid(seen, poses), posts[kept], atol=2e-5)


@pytest.mark.parametrize(
    ("steps", "seconds"),
    [
        ([0.0, 6.0, 6.0], 15.0),  # scans longer than the drive: so near poses do not show the speed
        ([0.0, 10.1, 20.2], 0.1),  # faster than any robot
    ],
)
def test_steps_that_are_no_motion(steps, seconds):
    times = np.tile(np.linspace(0.0, seconds, 12), 3)
    poses = se2.matrix(np.array(steps), np.zeros(3), np.zeros(3))
    way = np.repeat(poses, 12, axis=0)
    recording, _ = made(PERIOD * np.arange(3), way, [(0, 0, 0)], [0, 0, 0], times)
    seen = deskew_recording(recording, poses, OPTIONS)
    np.testing.assert_array_equal(seen.points, recording.points)
