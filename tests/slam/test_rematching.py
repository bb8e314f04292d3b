"""Scans matched anew within windows: the second opinion on poses."""

import dataclasses

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import rematching
from stillmap.slam.rematching import rematch_windows, select_windows


@pytest.fixture(scope="module")
def hall():
    """800 scans of a hall, with all that a reader may note about scans and beams."""
    run = simulate(scene_by_name("hall", {"robot": {"scans": 800, "scan_rate": 4.0}}), 0)
    recording = dataclasses.replace(
        run.recording,
        record=np.arange(800),
        beam_time=np.zeros(run.recording.n_beams, np.float32),
        T_recorded_base=run.truth.T_world_base,
    )
    return recording, run.truth.T_world_base


def test_windows_are_short_spaced_and_in_the_recording(hall):
    recording, poses = hall
    (scans,) = select_windows(recording, poses)
    assert len(scans) <= 360
    assert 0.4 <= 1e-9 * np.median(np.diff(recording.stamp_ns[scans])) <= 0.6
    assert scans[0] >= 0
    assert scans[-1] < recording.n_scans


def test_long_recordings_have_few_windows(hall):
    recording, poses = hall
    many = 40
    longer = dataclasses.replace(
        recording,
        stamp_ns=np.arange(800 * many) * 10**9,
        offset=np.append(np.zeros(800 * many, np.int64), recording.n_beams),
        sensor=np.zeros(800 * many, np.int32),
        T_odom_base=None,
        T_recorded_base=None,
        record=None,
    )
    windows = select_windows(longer, np.tile(poses, (many, 1, 1)))
    assert len(windows) == 4
    assert [len(scans) for scans in windows] == [360] * 4


def test_true_poses_agree_and_bent_ones_do_not(hall):
    recording, truth = hall
    (window,) = rematch_windows(recording, truth)
    assert window.recording.n_scans == len(window.scans) < recording.n_scans
    assert window.disagreement() < 0.05
    bend = se2.matrix(*np.zeros((2, len(truth))), 0.003 * np.arange(len(truth)))
    (bent,) = rematch_windows(recording, bend @ truth)
    assert bent.disagreement() > 3.0 * window.disagreement() + 0.1


def test_parts_hold_the_beams_of_their_scans(hall):
    recording, truth = hall
    (window,) = rematch_windows(recording, truth)
    parts = list(window.split(100))
    assert np.array_equal(np.concatenate([part.scans for part in parts]), window.scans)
    for part in parts:
        t = int(part.scans[-1])
        last = part.recording.beams_of(len(part.scans) - 1)
        assert np.array_equal(part.recording.points[last], recording.points[recording.beams_of(t)])


def test_of_large_scans_every_so_many_beams_are_used(hall, monkeypatch):
    recording, truth = hall
    monkeypatch.setattr(rematching, "_MAX_BEAMS", 50)
    (window,) = rematch_windows(recording, truth)
    beams = recording.beams_of(int(window.scans[-1]))
    used = window.recording.beams_of(len(window.scans) - 1)
    assert np.array_equal(window.beams[used], np.arange(beams.start, beams.stop, 4))  # of 181
    for part in window.split(100):
        assert np.array_equal(part.recording.points, recording.points[part.beams])


def test_scans_thousands_of_kilometres_away_are_left_out(hall):
    recording, poses = hall
    far = poses.copy()
    far[0, 1, 2] = -1e7
    window = next(rematch_windows(recording, far))
    assert window.scans[0] == 1
    assert np.abs(window.rematched - window.poses).max() < 1.0
