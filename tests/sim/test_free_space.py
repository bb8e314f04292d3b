"""Clearance and shortest ways in worlds where the answer is known."""

import itertools

import numpy as np
import pytest

from stillmap.sim.planner import FreeSpace, Planner, compute_segment_distance
from stillmap.sim.walls import box, polyline, wall


def test_clearance_is_the_distance_from_the_nearest_wall_up_to_its_limit():
    walls = np.array([*box(5, 5, 10, 10), (4.0, 4.0, 6.0, 6.0)])
    xy = np.random.default_rng(0).uniform(0.3, 9.7, (500, 2))
    true = np.min([compute_segment_distance(xy, w) for w in walls], axis=0)
    clear, gradient = FreeSpace(walls).clearance_at(xy)
    np.testing.assert_allclose(clear, np.minimum(true, 1.5), atol=0.051)
    beside = (xy[:, 0] > 0.2) & (xy[:, 0] < 1.3) & (xy[:, 1] > 2) & (xy[:, 1] < 8)
    np.testing.assert_allclose(gradient[beside], [[1, 0]] * beside.sum(), atol=1e-9)


def test_the_way_goes_around_a_wall_and_keeps_its_distance():
    walls = np.array([*box(5, 5, 10, 10), (5.0, 0.0, 5.0, 8.0)])
    start, end = np.array([2.0, 2.0]), np.array([8.0, 2.0])
    planner = Planner(FreeSpace(walls), start, 0.4)
    way = np.concatenate([start[None], planner.path(start, planner.node(end))])
    np.testing.assert_allclose(way[-1], end, atol=0.15)
    length = np.hypot(*np.diff(way, axis=0).T).sum()
    shortest = 2 * np.hypot(3.0, 6.0)  # over the wall's end, without any distance
    assert shortest < length < shortest + 1.5
    dense = np.concatenate([np.linspace(a, b, 200) for a, b in itertools.pairwise(way)])
    assert min(compute_segment_distance(dense, w).min() for w in walls) > 0.3


def test_only_the_part_that_can_be_reached_counts():
    walls = np.array([*box(5, 5, 10, 10), *box(5, 5, 4, 4)])
    planner = Planner(FreeSpace(walls), np.array([1.0, 1.0]), 0.3)
    points = planner.point(planner.nodes)
    inside = np.all(np.abs(points - 5) < 2, axis=1)
    assert not inside.any()
    assert len(points) == pytest.approx((9.4**2 - 4.6**2) / 0.04, rel=0.1)


def test_a_room_behind_an_open_door_can_be_entered_and_a_niche_cannot():
    door = (4.0, 1.0, 0.2, True)
    walls = [*wall((0, 0), 10, "south", [door, (7.0, 1.0, 0.2)]), *box(5, 5, 10, 10)[1:]]
    walls += polyline([(4, -0.2), (2, -0.2), (2, -3.2), (8, -3.2), (8, -0.2), (5, -0.2)])
    inside = np.array([3.0, -2.0])
    planner = Planner(FreeSpace(np.array(walls)), np.array([5.0, 5.0]), 0.36)
    np.testing.assert_allclose(planner.point(np.array(planner.node(inside))), inside, atol=0.15)
    behind_the_niche = np.array([7.5, -0.1])
    assert planner.point(np.array(planner.node(behind_the_niche)))[1] > 0.2
