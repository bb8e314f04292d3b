"""Rows of dynamic hits that may be leaves of doors."""

import dataclasses

import numpy as np
from synthetic_histories import RESOLUTION, recording

from stillmap.mapping.lone_leaves import find_leaf_lines

ROW = np.column_stack([np.arange(10, 20), np.full(10, -7)])
SLANTED = np.array([[k, 40 + k] for k in range(7)])


def lines(scans, static=()):
    """The lines of scans that end in the middle of cells; those of numbers in `static` are so."""
    seen = dataclasses.replace(
        recording(range(len(scans)), 1),
        offset=np.cumsum([0, *map(len, scans)]),
        points=((np.concatenate(scans) + 0.5) * RESOLUTION).astype(np.float32),
        hit=np.ones(sum(map(len, scans)), bool),
    )
    p = np.repeat([float(k in static) for k in range(len(scans))], list(map(len, scans)))
    poses = np.tile(np.eye(3), (len(scans), 1, 1))
    found = find_leaf_lines(seen, poses, p.astype(np.float32), RESOLUTION)
    return [sorted(map(tuple, one.tolist())) for one in found]


def cells(some):
    return sorted(map(tuple, some.tolist()))


def test_a_row_of_dynamic_hits_is_one_however_often_it_is_seen():
    assert lines([ROW, ROW[:9], ROW]) == [cells(ROW)]
    assert lines([np.concatenate([ROW, SLANTED])]) == [cells(SLANTED), cells(ROW)]


def test_what_is_static_short_long_or_wide_is_none():
    long = np.column_stack([np.arange(30), np.full(30, 3)])
    person = np.array([[x, y] for x in range(6) for y in range(4)])
    assert lines([ROW], static=[0]) == []
    assert lines([ROW[:4]]) == []
    assert lines([long]) == []
    assert lines([person]) == []


def test_parts_that_are_hit_at_different_times_are_not_joined():
    assert lines([ROW[:5], ROW[5:]]) == []


def test_nothing_dynamic():
    assert lines([np.empty((0, 2), np.int64), ROW[:1]], static=[1]) == []
