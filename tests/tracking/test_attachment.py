"""Tracks in 3D that are parts of static surfaces are no objects."""

import numpy as np
import pytest

from stillmap import Recording
from stillmap.tracking import MovingObject
from stillmap.tracking.displacement import count_neighbors, drop_surface_parts

SCANS = 6
ACROSS, UP = np.meshgrid(np.radians(np.arange(-20, 20.1, 1.0)), np.radians(np.arange(-9, 10, 2.0)))
DIRECTIONS = np.column_stack(
    [np.ones(ACROSS.size), np.tan(ACROSS.ravel()), np.tan(UP.ravel()) / np.cos(ACROSS.ravel())]
)


def room(distance):
    """Sweeps of what lies at a depth in m, one for each direction, and P(static) = 1."""
    cloud = (np.asarray(distance)[:, None] * DIRECTIONS).astype(np.float32)
    recording = Recording.from_clouds(0.1 * np.arange(SCANS), [cloud] * SCANS)
    return recording, np.ones(recording.n_beams, np.float32)


def an_object(recording, own):
    """One of which the beams `own` of each sweep are."""
    beams = np.concatenate([t * len(own) + np.flatnonzero(own) for t in range(SCANS)])
    scan, xy = np.arange(SCANS), np.zeros((SCANS, 2))
    of_scans = (scan, recording.stamp_ns, xy, xy)
    return MovingObject(0, *of_scans, (0.5, 0.5, 0.5), beams, 1.0, np.zeros(SCANS))


def degrees(low, high):
    return (np.degrees(ACROSS.ravel()) > low) & (np.degrees(ACROSS.ravel()) < high)


PATCH = degrees(-3, 3) & (np.abs(np.degrees(UP.ravel())) < 6)


def labelled(p_static, own, others=None):
    p = p_static.reshape(SCANS, -1)
    p[:, own] = 0.0
    if others is not None:
        p[:, others] = 0.0
    return p.reshape(-1)


def test_a_patch_of_a_wall_is_no_object():
    recording, p = room(np.full(len(DIRECTIONS), 5.0))
    one = an_object(recording, PATCH)
    assert drop_surface_parts([one], recording, labelled(p, PATCH)) == []


@pytest.mark.parametrize("depth", [1.0, 4.5], ids=["far before", "half a metre before"])
def test_an_object_before_a_wall_is_kept(depth):
    recording, p = room(np.where(PATCH, depth, 5.0))
    one = an_object(recording, PATCH)
    assert drop_surface_parts([one], recording, labelled(p, PATCH)) == [one]


def test_surface_on_one_side_does_not_count_enough():
    recording, p = room(np.where(PATCH | degrees(2, 8), 3.0, 6.0))
    one = an_object(recording, PATCH)
    on_it, behind = count_neighbors([one], recording, labelled(p, PATCH))[0]
    assert 0 < on_it < behind
    assert drop_surface_parts([one], recording, labelled(p, PATCH)) == [one]


def test_neighbors_that_move_do_not_count():
    """People side by side."""
    recording, p = room(np.where(degrees(-20, 20), 3.0, 6.0))
    one = an_object(recording, PATCH)
    p = labelled(p, PATCH, others=~PATCH)
    assert count_neighbors([one], recording, p).tolist() == [[0, 0]]
    assert drop_surface_parts([one], recording, p) == [one]


def test_a_single_beam_and_no_object():
    recording, p = room(np.full(len(DIRECTIONS), 5.0))
    own = np.arange(len(DIRECTIONS)) == len(DIRECTIONS) // 2
    on_it, behind = count_neighbors([an_object(recording, own)], recording, p)[0]
    assert on_it > 0
    assert behind == 0
    assert drop_surface_parts([], recording, p) == []
