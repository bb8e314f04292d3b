"""Smoothed ways, against a spline of scipy's and straight ones; stamps as recordings have them."""

import dataclasses
import time

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from synthetic_tracks import watched

from stillmap.tracking.association import assign_tracks
from stillmap.tracking.mover_path import smooth_track


@pytest.mark.parametrize("n", [5, 6, 40, 300])
@pytest.mark.parametrize(("sigma", "acceleration"), [(0.1, 1.0), (0.3, 0.2)])
def test_it_is_the_smoothing_spline(n, sigma, acceleration):
    rng = np.random.default_rng(n)
    t = np.cumsum(rng.uniform(0.05, 0.6, n))
    t = np.sort(np.concatenate([t, t[[0, 2]], t[[2]], t[[-1]]]))  # some are seen twice at a time
    xy = rng.normal(size=(len(t), 2))
    found, v = smooth_track(t, xy, sigma, acceleration)
    times, which, count = np.unique(t, return_inverse=True, return_counts=True)
    for d in (0, 1):
        mean = np.bincount(which, xy[:, d]) / count
        spline = make_smoothing_spline(times, mean, w=count, lam=sigma**2 / acceleration)
        np.testing.assert_allclose(found[:, d], spline(t), atol=1e-9)
        np.testing.assert_allclose(v[:, d], spline.derivative()(t), atol=1e-8)


@pytest.mark.parametrize("n", [2, 3, 4, 30])
def test_what_goes_straight_on_does(n):
    t = np.linspace(3.0, 9.0, n)
    xy = np.array([1.0, -2.0]) + t[:, None] * [0.7, -0.3]
    found, v = smooth_track(t, xy, 0.2, 1.0)
    np.testing.assert_allclose(found, xy, atol=1e-9)
    np.testing.assert_allclose(v, np.tile([0.7, -0.3], (n, 1)), atol=1e-9)
    # what is seen at one time has no speed
    found, v = smooth_track(np.full(n, 5.0), np.arange(2.0 * n).reshape(n, 2), 0.2, 1.0)
    np.testing.assert_allclose(found, np.tile([n - 1.0, float(n)], (n, 1)))
    assert not v.any()


def test_noise_is_taken_out():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 30.0, 0.2)
    way = np.column_stack([t, 2.0 * np.sin(0.3 * t)])
    found, v = smooth_track(t, way + rng.normal(0.0, 0.1, way.shape), 0.28, 1.0)
    assert np.sqrt(np.mean((found - way) ** 2)) < 0.05
    true = np.column_stack([np.ones(len(t)), 0.6 * np.cos(0.3 * t)])
    assert np.median(np.linalg.norm(v - true, axis=1)) < 0.1  # from place to place it would be 0.7


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
    owner = assign_tracks(dataclasses.replace(points, seconds=late), 2.0)
    assert len(np.unique(owner)) == 2


def test_time_that_stands_still_forgets_no_less():
    points, _ = watched([lambda t: (2.0 + 0.01 * t, 1.0)], seconds=400.0, points=20)
    same = dataclasses.replace(points, seconds=np.zeros_like(points.seconds))
    began = time.process_time()
    assign_tracks(same, 2.0)
    assert time.process_time() - began < 10.0
