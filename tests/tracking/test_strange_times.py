"""Stamps as recordings have them: at once, nearly at once, far apart, many points at a time."""

import dataclasses
import time

import numpy as np
import pytest
from synthetic_tracks import watched

from stillmap.tracking.association import assign_tracks
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.mover_path import smooth_track

MAX_GAP = 2.0


@pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-8, 1e-6, 1e-4])
def test_scans_nearly_at_once_are_one(apart):
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 20.0, 0.1)
    both = np.sort(np.concatenate([t, t + apart]))
    way = np.column_stack([0.8 * both, 0.1 * both])
    found, v = smooth_track(both, way + rng.normal(0.0, 0.02, way.shape), 0.28, 1.0)
    assert np.abs(found - way).max() < 0.05
    assert np.abs(v - [0.8, 0.1]).max() < 0.1


def test_a_gap_of_hours_is_no_trouble():
    points, _ = watched([lambda t: (2.0 + 0.5 * t, 1.0)])
    late = np.where(points.seconds > 4.0, points.seconds + 20_000.0, points.seconds)
    owner = assign_tracks(dataclasses.replace(points, seconds=late), MAX_GAP)
    assert len(np.unique(owner)) == 2


@pytest.mark.slow
def test_large_crowds_take_a_while_and_little_memory():
    rng = np.random.default_rng(1)
    scans, n = 12, 2000
    xy = rng.uniform(-20.0, 20.0, (scans * n, 2))
    scan = np.repeat(np.arange(scans), n)
    points = DynamicPoints(
        0.05 * np.arange(scans),
        scan,
        np.arange(scans * n),
        xy,
        np.linalg.norm(xy, axis=1),
        np.zeros((scans, 2)),
        np.repeat(np.arange(scans * n // 10), 10),
        np.arange(scans + 1) * n,
    )
    began = time.process_time()
    assert assign_tracks(points, MAX_GAP).min() >= 0
    assert time.process_time() - began < 30.0


def test_time_that_stands_still_forgets_no_less():
    points, _ = watched([lambda t: (2.0 + 0.01 * t, 1.0)], seconds=400.0, points=20)
    same = dataclasses.replace(points, seconds=np.zeros_like(points.seconds))
    began = time.process_time()
    assign_tracks(same, MAX_GAP)
    assert time.process_time() - began < 10.0
