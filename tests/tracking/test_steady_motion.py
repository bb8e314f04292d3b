"""Windows of steady motion along a track."""

import numpy as np
import pytest

from stillmap.tracking.walker_paths import _fit_lines, count_steady_windows

RATE = 10.0


def detections(way, seconds=6.0, noise=0.03, seed=0):
    t = np.arange(0.0, seconds, 1.0 / RATE)
    rng = np.random.default_rng(seed)
    return t, np.array([way(s) for s in t]) + rng.normal(0.0, noise, (len(t), 2))


def test_a_walker_moves_in_every_window_and_a_stand_in_none():
    windows, moving = count_steady_windows(*detections(lambda s: (1.2 * s, 0.3 * s)), 0.1)
    assert windows == pytest.approx(3.0, abs=0.5)
    assert moving == windows
    windows, moving = count_steady_windows(*detections(lambda _: (2.0, 1.0)), 0.1)
    assert windows > 2.0
    assert moving == 0.0


def test_jumps_between_two_legs_of_a_chair_are_no_motion():
    t, xy = detections(lambda s: (0.7 * (int(3.0 * s) % 2), 0.0))
    assert count_steady_windows(t, xy, 0.1)[1] == 0.0


def test_one_who_walks_and_stands_moves_in_some_windows():
    windows, moving = count_steady_windows(
        *detections(lambda s: (min(s, 3.0), 0.0), seconds=9.0), 0.1
    )
    assert 0.2 * windows < moving < 0.6 * windows


def test_a_gap_without_detections_is_no_steady_motion():
    t, xy = detections(lambda s: (1.2 * s, 0.0), seconds=2.0)
    seen = (t < 0.6) | (t > 1.4)
    assert count_steady_windows(t, xy, 0.1)[1] > 0.0
    assert count_steady_windows(t[seen], xy[seen], 0.1)[1] == 0.0


def test_short_tracks_say_nothing_and_slow_scans_take_longer_windows():
    assert count_steady_windows(*detections(lambda s: (s, 0.0), seconds=1.0), 0.1) == (0.0, 0.0)
    t, xy = detections(lambda s: (s, 0.0), seconds=20.0)
    windows, moving = count_steady_windows(t[::10], xy[::10], 1.0)  # a scan per second
    assert moving == windows > 2.0


def test_lines_agree_with_least_squares_of_each_window():
    t, xy = detections(lambda s: (s + 100.0, np.sin(s) - 50.0))
    low, high = np.array([0, 7, 30]), np.array([15, 30, 60])
    speed, scatter = _fit_lines(t - t[0], xy - xy[0], low, high)
    for k in range(3):
        s, x = t[low[k] : high[k]], xy[low[k] : high[k]]
        A = np.column_stack([np.ones_like(s), s])
        fit = np.linalg.lstsq(A, x, rcond=None)[0]
        assert speed[k] == pytest.approx(np.linalg.norm(fit[1]), rel=1e-6)
        rms = np.sqrt(((x - A @ fit) ** 2).sum(axis=1).mean())
        assert scatter[k] == pytest.approx(rms, rel=1e-5)
