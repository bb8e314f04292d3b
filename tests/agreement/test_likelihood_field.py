"""Likelihood field of registration: kernel against twin."""

import numpy as np
import pytest
import reference
from reference.likelihood_field import retract

from stillmap import _core

FLOOR, UNKNOWN = 0.02, 0.3


def scan(beams):
    """The largest scan."""
    t = int(np.argmax(np.diff(beams.offset)))
    a, b = beams.offset[t], beams.offset[t + 1]
    return np.ascontiguousarray(beams.points[a:b]), beams.e[a:b], beams.T_map_sensor[t]


@pytest.fixture(params=[1, 2])
def beams(request, some_beams):
    return some_beams(request.param, 2)


@pytest.fixture
def grids(beams):
    return beams.grid(_core), beams.grid(reference)


@pytest.mark.parametrize(("sigma", "radius"), [(0.5, 2), (1.0, 3), (0.3, 1), (1.0, 0)])
def test_cost(beams, grids, sigma, radius):
    points, weights, T = scan(beams)
    assert len(points) > 5
    costs = []
    for i in range(4):
        delta = np.random.default_rng(i).normal(scale=0.2, size=3)
        pose = retract(T, delta)
        options = sigma * beams.resolution, radius, FLOOR, UNKNOWN
        core, plain = (
            k.registration_cost(g, points, weights, pose, *options)
            for k, g in zip((_core, reference), grids, strict=True)
        )
        assert core == pytest.approx(plain, rel=1e-6)
        costs.append(plain)
    assert np.ptp(costs) > 1e-2


def test_gradient(beams, grids):
    points, weights, T = scan(beams)
    for i in range(3):
        delta = np.random.default_rng(i).normal(scale=0.1, size=3)
        pose = retract(T, delta)
        options = 0.6 * beams.resolution, 3, FLOOR, UNKNOWN
        core, plain = (
            k.registration_gradient(g, points, weights, pose, *options)
            for k, g in zip((_core, reference), grids, strict=True)
        )
        assert core.shape == delta.shape
        assert np.abs(plain).max() > 1
        assert core == pytest.approx(plain, rel=1e-4, abs=1e-3 * np.abs(plain).max())


def curvature_of(grid, points, weights, T, sigma, radius):
    """Curvature of the kernel from the covariance without a step."""
    prior = np.eye(3)
    _, covariance, *_ = _core.register_scan(
        grid, points, weights, T, prior, sigma=sigma, radius=radius, floor=FLOOR, unknown=UNKNOWN,
        information_scale=1.0, max_iterations=0, window_translation=0.0, window_rotation=0.0,
        search_range=9.0, max_candidates=1, T_start=T,
    )  # fmt: skip
    return np.linalg.inv(covariance) - prior


@pytest.mark.parametrize(("sigma", "radius"), [(0.5, 2), (1.0, 3), (0.3, 1)])
def test_curvature(beams, grids, sigma, radius):
    points, weights, T = scan(beams)
    options = sigma * beams.resolution, radius
    core = curvature_of(grids[0], points, weights, T, *options)
    plain = reference.registration_curvature(grids[1], points, weights, T, *options, FLOOR, UNKNOWN)
    assert core.shape == plain.shape
    assert np.linalg.eigvalsh(plain).min() > 1
    np.testing.assert_allclose(core, plain, rtol=0, atol=1e-6 * np.abs(plain).max())


def test_curvature_has_no_negative_part(beams, grids):
    # beam by beam: where means are spread wider than the Gaussians, F is convex there
    sigma = 0.5 * beams.resolution
    rng = np.random.default_rng(3)
    ends = beams.T_map_sensor[5, :2, 2] + rng.normal(scale=0.7, size=(150, 2))
    kept, kinds = np.ones(1, np.float32), set()
    for y in ends.astype(np.float32):
        core = curvature_of(grids[0], y[None], kept, np.eye(3), sigma, 2)
        given = y[None], kept, np.eye(3), sigma, 2, FLOOR, UNKNOWN
        plain = reference.registration_curvature(grids[1], *given)
        np.testing.assert_allclose(core, plain, rtol=0, atol=1e-5 * sigma**-2)
        values = np.linalg.eigvalsh(plain[:2, :2])
        assert values.min() > -1e-6
        kinds.add(int((values > 1e-3).sum()))
    assert kinds == {0, 1, 2}  # from no axis to all axes


def test_far_from_the_map(beams, grids):
    points, weights, T = scan(beams)
    T = T.copy()
    T[0, -1] += 1000
    usable = np.isfinite(points).all(axis=1)
    expected = -weights[usable].sum(dtype=float) * np.log(FLOOR + UNKNOWN)
    for k, g in zip((_core, reference), grids, strict=True):
        cost = k.registration_cost(g, points, weights, T, 0.2, 2, FLOOR, UNKNOWN)
        assert cost == pytest.approx(expected, rel=1e-6)
        assert not k.registration_gradient(g, points, weights, T, 0.2, 2, FLOOR, UNKNOWN).any()
