"""Loop verification of views from the other side of walls and streets."""

import functools

import numpy as np
import pytest
from driven import driven

from stillmap import _core
from stillmap.core import se2
from stillmap.sim.walls import box
from stillmap.slam import loop_candidates
from stillmap.slam.loop_verification import (
    Submap,
    _select_comparable,
    _View,
    verify_candidate,
    verify_candidates,
)
from stillmap.slam.scan_hits import make_scan
from stillmap.slam.types import LoopCandidate


@functools.cache
def divided(width):
    """A room with a wall of 0.2 m across it, and a robot that drives around that."""
    walls = (*box(0, 0, 24, 14), *box(0, 0, width, 0.2))
    route = ((-8, -3.5), (9.5, -3.5), (9.5, 3.5), (-8, 3.5))
    return driven(walls, route, {"beams": 180, "max_range": 30.0})


def over_the_wall(context):
    """(N, 3) by what closures over the wall miss the truth, and their chi-square (N,)."""
    x, off, chi = se2.parameters(context.poses), [], []
    south = [k for k in context.keyframes if context.travelled[k] < 16.0]
    north = [k for k in context.keyframes if context.travelled[k] > 28.0]
    submap = Submap(context, 8.0)
    for k in north:
        i = min(south, key=lambda i: np.linalg.norm(x[i, :2] - x[k, :2]))
        T = se2.inverse(context.poses[i]) @ context.poses[k]
        closure = verify_candidate(context, submap, LoopCandidate(i, k, T, 0.0), 0.2, 0.02)
        if not closure.rejected:
            d = se2.parameters(se2.inverse(T) @ closure.T)
            off.append(d)
            chi.append(d @ np.linalg.solve(closure.covariance, d))
    return np.array(off).reshape(-1, 3), np.array(chi)


def test_the_back_of_a_wall_is_not_its_front():
    # as far as what is seen goes, the room beyond a wall could begin where that on this side ends
    off, chi = over_the_wall(divided(14))
    assert np.abs(off[:, 1]).max() < 0.05
    assert chi.max() < 9.0


@pytest.mark.parametrize("width", [5, 7])
def test_structure_beside_a_wall_locates_a_view_behind_it(width):
    off, chi = over_the_wall(divided(width))
    assert len(off) >= 3
    assert np.abs(off[:, 1]).max() < 0.02
    assert np.abs(off[:, 2]).max() < 0.015
    assert chi.max() < 9.0  # along the walls it may slide, and says so


@functools.cache
def street():
    """Fronts of houses 24 m apart; up on one side, back on the other, looking the other way."""
    rng = np.random.default_rng(1)
    fronts = [
        wall
        for x in np.arange(0.0, 80.0, 8.0)
        for y, sign in ((-12.0, -1.0), (12.0, 1.0))
        for wall in box(x + 4.0, y + sign * (3.0 + rng.uniform(-2.0, 2.0)), 6.0, 6.0)
    ]
    route = ((2.0, -5.0), (78.0, -5.0), (78.0, 5.0), (2.0, 5.0))
    return driven(tuple(fronts), route, {"beams": 361, "max_range": 80.0}, speed=5.0)


def test_loops_close_across_a_street():
    context = street()
    looks = loop_candidates.view_centers(context)
    keyframes = context.poses[context.keyframes]
    every = context, keyframes, looks, 0, len(looks), []
    asked = list(loop_candidates.propose_candidates(*every))
    # never nearer than that
    assert min(np.linalg.norm(c.T[:2, 2]) for c in asked if context.travelled[c.later] > 90.0) > 9.9
    found = [c for c in verify_candidates(context, asked) if not c.rejected]
    assert len(found) > 20
    for closure in found:
        T = se2.inverse(context.poses[closure.earlier]) @ context.poses[closure.later]
        assert np.linalg.norm((se2.inverse(T) @ closure.T)[:2, 2]) < 0.2


def test_comparable_beams_were_observed_from_the_same_side():
    # one beam along x that ends at 5 m: the wall is seen from the left
    grid = _core.OccupancyGrid2D(0.1, 0.5)
    T = np.eye(3)[None]
    ends = np.array([[5.05, 0.05], [5.05, 0.05], [5.05, 3.0]], np.float32)
    once = np.array([True]), np.ones(1, np.float32), np.array([0, 1])
    _core.add_beams(grid, ends[:1], *once, T, remove=False)
    weights = np.array([0.5, 0.3, 0.2], np.float32)
    hits = make_scan(ends, weights, np.eye(3))
    # from the left, from the right, and where nobody looked
    before = ends + np.array([[-1, 0], [1, 0], [-1, 0]], np.float32)
    view = _View([0], np.eye(3)[None], hits, before)
    part, share = _select_comparable(grid, view, np.eye(3))
    np.testing.assert_array_equal(part.weights, hits.weights * np.array([1, 0, 0], np.float32))
    assert share == pytest.approx(hits.weights[0] / hits.weights.sum())
    assert part.points is hits.points
