"""Normals of a scan and the covariance that follows from them, against the NumPy twins."""

import numpy as np
import pytest
from reference import surface_normals
from surfel_maps import together

from stillmap import _core
from stillmap.slam.scan_hits import make_scan

OPTIONS = {"radius": 0.3, "max_gap": 1.0, "flat_below": 0.1, "round_from": 0.4}
FIELD = {"sigma": 0.04, "radius": 2, "floor": 0.05, "unknown": 0.2, "information_scale": 0.2}
SEARCH = {"search_range": 20.0, "max_candidates": 1, "max_iterations": 20}
SEARCH |= {"window_translation": 0.0, "window_rotation": 0.0}


def scans(seed):
    """A wall, a corner, clutter, and end points on their own."""
    rng = np.random.default_rng(seed)
    wall = np.stack([np.linspace(-3, 3, 80), np.full(80, 2.0)], axis=-1)
    side = np.stack([np.full(30, 3.0), np.linspace(2.0, 0.0, 30)], axis=-1)
    clutter = rng.uniform(-1.5, 1.5, (20, 2))
    alone = rng.uniform(5, 30, (6, 2)) * [1, -1]
    points = np.concatenate([alone[:3], wall, side, clutter, alone[3:]])
    return (points + 0.01 * rng.standard_normal(points.shape)).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("changed", [{}, {"radius": 0.8}, {"max_gap": 0.05}, {"flat_below": 0.0}])
def test_normals_agree_with_the_twin(seed, changed):
    points, options = scans(seed), {**OPTIONS, **changed}
    normals, isotropy = _core.estimate_normals(points, **options)
    expected = surface_normals.estimate_normals(points.astype(float), **options)
    # the sign of a normal says nothing
    cosine = np.abs((normals * expected[0]).sum(axis=1))
    lines = expected[1] < 1.0  # of a round neighborhood any direction may be the least
    has_normal = np.abs(expected[0]).any(axis=1)
    np.testing.assert_allclose(cosine[lines & has_normal], 1.0, atol=1e-5)
    assert not normals[~has_normal].any()
    np.testing.assert_allclose(isotropy, expected[1], atol=1e-5)


def test_a_wall_a_corner_and_a_single_point():
    wall = np.stack([np.linspace(-1, 1, 41), np.full(41, 2.0)], axis=-1)
    corner = np.stack([np.full(40, 1.0), np.linspace(1.95, 0.0, 40)], axis=-1)
    points = np.concatenate([wall, corner, [[9.0, -9.0]]]).astype(np.float32)
    normals, isotropy = _core.estimate_normals(points, **OPTIONS)
    np.testing.assert_allclose(np.abs(normals[10]), [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(np.abs(normals[70]), [1.0, 0.0], atol=1e-6)
    assert not normals[-1].any()
    assert isotropy[10] == isotropy[70] == isotropy[-1] == 0.0
    assert isotropy[40] > 0.4


@pytest.mark.parametrize("length", [0.1, 3.0])
def test_shares_of_evidence_agree_with_the_twin(length):
    points = scans(4)
    shares = _core.evidence_shares(points, correlation_length=length)
    expected = surface_normals.evidence_shares(points.astype(float), length)
    np.testing.assert_allclose(shares, expected, atol=1e-6)
    assert 0.0 <= shares.min() < 0.9 < shares.max() <= 1.0


def test_a_surface_has_as_much_evidence_near_the_laser_as_far_from_it():
    angles = np.linspace(-1.0, 1.0, 400)
    near, far = (
        np.stack([np.full(400, x), x * np.tan(angles)], axis=-1).astype(np.float32)
        for x in (0.3, 3)
    )
    sums = [_core.evidence_shares(wall, correlation_length=0.1).sum() for wall in (near, far)]
    metres = [2 * x * np.tan(1.0) for x in (0.3, 3)]
    np.testing.assert_allclose(sums, np.array(metres) / 0.1, atol=1.5)
    assert len(_core.evidence_shares(np.zeros((0, 2), np.float32), correlation_length=0.1)) == 0


def test_empty_scans_and_points_at_the_sensor():
    normals, isotropy = _core.estimate_normals(np.zeros((0, 2), np.float32), **OPTIONS)
    assert normals.shape == (0, 2)
    assert isotropy.shape == (0,)
    normals, isotropy = _core.estimate_normals(np.zeros((1, 2), np.float32), **OPTIONS)
    assert np.all(np.isfinite(normals))
    assert np.all(np.isfinite(isotropy))


def corridor():
    y = np.linspace(-6, 6, 200)
    return np.concatenate([np.stack([y, np.full(200, s)], axis=-1) for s in (-1.0, 1.0)])


def covariance_of(points, normals):
    """Covariance of a scan at its true place in a map that the same end points make."""
    grid, e = _core.OccupancyGrid2D(0.05), np.ones(len(points), np.float32)
    points, hit, offset, T = together(points)
    _core.add_beams(grid, points, hit, e, offset, T)
    prior = np.eye(3), np.diag(np.full(3, 4.0)), np.eye(3)
    options = {**FIELD, **SEARCH, **normals, "T_start": prior[2]}
    return _core.register_scan(grid, points, e, *prior[:2], **options)[1]


def normals_of(points):
    found = make_scan(points, np.ones(len(points), np.float32), np.eye(3))
    return {"normals": found.normals, "isotropy": found.isotropy}


def test_a_bare_corridor_says_nothing_along_it():
    points = corridor().astype(np.float32)
    by_normals, by_curvature = covariance_of(points, normals_of(points)), covariance_of(points, {})
    assert np.sqrt(by_normals[0, 0]) == pytest.approx(0.5, rel=0.02)
    assert np.sqrt(by_normals[1, 1]) < 0.02
    assert np.sqrt(by_curvature[0, 0]) < 0.1  # what the pattern of the end points pretends


def test_covariance_agrees_with_the_twin():
    points = np.concatenate([corridor(), [[6.0, y] for y in np.linspace(-1, 1, 40)]])
    points = points.astype(np.float32)
    known = normals_of(points)
    C = covariance_of(points, known)
    of_all = surface_normals.surface_information(
        points.astype(float), np.ones(len(points)), *known.values(), np.eye(3)
    )
    # the same information, but for the share of each beam that the field explains
    measured = np.linalg.inv(C) - np.diag(np.full(3, 4.0))
    share = np.diag(measured) / np.diag(0.2 / 0.04**2 * of_all)
    assert np.all((share > 0.75) & (share <= 1.0))
