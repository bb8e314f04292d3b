"""Observation counts, in scenes made up by hand."""

import dataclasses

import numpy as np
import pytest
from made_up import at
from recordings import of_one_sensor

from stillmap import _core, em
from stillmap.core import chunks
from stillmap.em.types import NoReturnModel

RESOLUTION = 0.1


def recording_of(ranges, hit, seconds):
    """Scans (T, N) of a fan ahead, taken from the origin at these times."""
    T, N = ranges.shape
    bearing = np.linspace(-0.5, 0.5, N)
    points = ranges[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    return of_one_sensor(
        np.round(np.asarray(seconds) * 1e9).astype(np.int64),
        np.arange(T + 1) * N,
        points.reshape(-1, 2).astype(np.float32),
        hit.reshape(-1),
    )


def coverage_of(recording, p_static, no_return=None, threads=1):
    """Of the map of (15)."""
    poses = np.tile(np.eye(3), (recording.n_scans, 1, 1))
    grid = _core.OccupancyGrid2D(RESOLUTION)
    known = np.nan_to_num(p_static, nan=0.5)
    seen = em.add_trusted_beams(grid, recording, poses, known, no_return)
    occupancy = em.make_occupancy_map(grid, observed=seen)
    chosen = em.EmOptions()
    found = em.count_observations(recording, poses, p_static, occupancy, no_return, chosen, threads)
    for layer in (found.observations, found.unobstructed, found.thinly_observed):
        assert layer.shape == occupancy.p_occupied.shape
    assert found.observations.dtype == found.unobstructed.dtype == np.uint16
    return occupancy, found


@pytest.fixture(scope="module")
def visitors():
    """A wall 4 m ahead, twenty scans; on the left a person 2 m ahead in all but two."""
    T, N = 20, 201
    ranges = np.full((T, N), 4.0) / np.cos(np.linspace(-0.5, 0.5, N))
    e = np.ones((T, N), np.float32)
    left = np.arange(N) > 140
    ranges[2:, left], e[2:, left] = 2.0, 0.02
    return recording_of(ranges, np.ones((T, N), bool), np.arange(T)), e.reshape(-1)


def test_obstructed_cells_are_thinly_observed(visitors):
    occupancy, found = coverage_of(*visitors)
    expected = {
        (4.0, 0.0): (20, 20),  # the wall that everybody sees
        (2.0, 0.0): (20, 20),
        (4.0, 1.8): (2, 2),  # behind whoever stands there
        (1.8, 0.8): (20, 2),  # where they stand, and before them
        (1.2, 0.5): (20, 20),
    }
    for place, (observations, unobstructed) in expected.items():
        assert at(occupancy, place, found.observations) == observations
        assert at(occupancy, place, found.unobstructed) == unobstructed
        assert at(occupancy, place, found.thinly_observed) == (unobstructed < 3)
    assert (found.unobstructed <= found.observations).all()
    known = ~np.isnan(occupancy.p_occupied)
    np.testing.assert_array_equal(found.observations > 0, known)
    np.testing.assert_array_equal(found.thinly_observed, known & (found.unobstructed < 3))


def test_scans_within_a_time_bin_are_one_observation(visitors):
    recording, e = visitors
    at_once = dataclasses.replace(recording, stamp_ns=recording.stamp_ns // 50)
    occupancy, found = coverage_of(at_once, e)
    assert found.observations.max() == 1
    assert found.thinly_observed.sum() == (~np.isnan(occupancy.p_occupied)).sum()


def test_threads_and_chunks_change_nothing(visitors, monkeypatch):
    _, found = coverage_of(*visitors)
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", 500)
    _, chunked = coverage_of(*visitors, threads=2)
    for name in ("observations", "unobstructed", "thinly_observed"):
        np.testing.assert_array_equal(getattr(found, name), getattr(chunked, name))


def test_beams_without_a_return_count_as_far_as_trusted():
    T, N = 5, 101
    ranges, hit = np.full((T, N), 4.0), np.zeros((T, N), bool)
    hit[:, :50] = True
    ranges[:, -1], hit[:, -1] = np.nan, False
    e = np.where(np.isnan(ranges), np.nan, 0.4 * ~hit + 0.95 * hit).astype(np.float32).reshape(-1)
    recording = recording_of(ranges, hit, np.arange(T))
    here = (3.0, 0.5), (3.85, 0.5)
    for no_return, expected in (
        (None, [5, 5]),
        (NoReturnModel(np.zeros((0, 2), np.int64), 0.4), [5, 0]),
        (NoReturnModel(np.zeros((0, 2), np.int64), np.inf), [0, 0]),
    ):
        occupancy, found = coverage_of(recording, e, no_return)
        np.testing.assert_array_equal(found.observations > 0, ~np.isnan(occupancy.p_occupied))
        # beams without a return are not dynamic
        np.testing.assert_array_equal(found.unobstructed, found.observations)
        # the map may end before
        assert np.nan_to_num(at(occupancy, here, found.observations)).tolist() == expected
