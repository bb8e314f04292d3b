"""Beams that were taken about when a picture was."""

from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.mesh import inputs
from stillmap.mesh.inputs import MeshInputs, TrackedBox
from stillmap.tracking.boxes import Box

T, N = 4, 3


def _inputs(times=None, velocity=(0.0, 0.0), owned=(), p=None, y=10.0):
    """Four scans of three beams, 0.1 s apart; those `owned` are of a thing that moves."""
    points = np.zeros((T * N, 3), np.float32)
    points[:, 0] = np.arange(T * N) + 1.0
    recording = of_one_sensor(
        np.arange(T) * 100_000_000,
        np.arange(T + 1, dtype=np.int64) * N,
        points,
        np.ones(T * N, np.bool_),
        beam_time=times,
    )
    p = np.float32(np.arange(T * N) / 11.0 if p is None else p)
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 1, 3] = y * np.arange(T)
    way, ahead = np.outer([0.0, 1.0], velocity), np.tile([1.0, 0.0], (2, 1))
    box = Box(0, np.array([0.0, 1.0]), way, ahead, np.tile(velocity, (2, 1)), (1.0, 1.0), 0.5)
    objects = [SimpleNamespace(id=0, beams=np.array(owned, int))]
    boxes = [TrackedBox(box, np.zeros(2), 1.0)]
    return MeshInputs(recording, recording, poses, p, objects, boxes, 0)


def near_time(beams, stamp_ns, window, tilting=None, tracked=0.5):
    """The returns near a time, by windows in seconds."""
    windows = {"_WINDOW": window, "_WINDOW_TILTING": tilting or window, "_WINDOW_TRACKED": tracked}
    with mock.patch.multiple(inputs, **windows):
        return beams.returns_near(stamp_ns)


def test_of_scans_taken_at_once_the_nearest_counts_at_least():
    ends, p = near_time(_inputs(), 140_000_000, 0.01)
    np.testing.assert_allclose(ends, [[4, 10, 0], [5, 10, 0], [6, 10, 0]])
    np.testing.assert_allclose(p, np.arange(3, 6) / 11.0)
    assert len(near_time(_inputs(), 150_000_000, 0.06)[0]) == 6


def test_with_times_each_beam_counts_by_its_own():
    times = np.tile(np.array([0.0, 0.03, 0.06], np.float32), T)
    ends, _ = near_time(_inputs(times), 145_000_000, 0.02)
    np.testing.assert_allclose(ends[:, 0], [5.0, 6.0])


def test_what_is_of_a_thing_goes_on_with_it():
    beams = _inputs(velocity=(1.0, 2.0), owned=(4, 9))
    ends, _ = near_time(beams, 140_000_000, 0.01)
    np.testing.assert_allclose(ends, [[4, 10, 0], [5.04, 10.08, 0], [6, 10, 0]], atol=1e-6)


def test_of_a_row_what_moves_is_told_longer_and_goes_on():
    p = np.ones(T * N)
    p[::N] = 0.2, 0.3, 0.4, 0.1
    beams = _inputs(velocity=(0.0, 1.0), owned=(0, 3, 6, 9), p=p, y=0.0)
    beams.__dict__["is_planar"] = True
    ends, p = near_time(beams, 100_000_000, 0.01, 0.01, 0.15)
    np.testing.assert_allclose(ends[:, 0], [1.0, 4.0, 5.0, 6.0, 7.0])
    np.testing.assert_allclose(ends[:, 1], [0.1, 0.0, 0.0, 0.0, -0.1], atol=1e-6)
    assert p == pytest.approx([0.2, 0.3, 1.0, 1.0, 0.4])
