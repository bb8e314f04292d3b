"""Cluster pooling and ground contact: a car of which only the front was observed to arrive."""

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap import _core
from stillmap.core.chunks import ScanBeams
from stillmap.em import spatial_coupling
from stillmap.em.ground import ground_from_surfels
from stillmap.em.spatial_coupling import (
    apply_pooled_evidence,
    label_far_ground,
    pool_clusters,
    select_obstacles,
)
from stillmap.em.types import GroundMap

FLAT = GroundMap(np.zeros((40, 40)), np.array([-20.0, -20.0]), 1.8, True)


def box(x, y, length, width=1.6, height=1.4):
    """Points on the faces of a box over the ground, 5 cm apart, from 0.3 m on."""
    u, v = np.arange(0, length, 0.05), np.arange(0.3, height, 0.05)
    side = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    front = np.stack(np.meshgrid(np.arange(0, width, 0.05), v), axis=-1).reshape(-1, 2)
    sides = np.insert(side, 1, 0.0, axis=1), np.insert(front, 0, 0.0, axis=1)
    return np.concatenate(sides) + np.array([x, y, 0.0])


def standing(*things, scans=3):
    """A recording that sees the same things in every scan, and its surface."""
    ground = np.stack(np.meshgrid(*[np.arange(-8, 8, 0.1)] * 2), axis=-1).reshape(-1, 2)
    ends = np.concatenate([np.column_stack([ground, np.zeros(len(ground))]), *things])
    n = len(ends)
    recording = of_one_sensor(
        np.arange(scans) * 10**8,
        np.arange(scans + 1) * n,
        np.tile(ends, (scans, 1)).astype(np.float32),
        np.ones(scans * n, bool),
    )
    T = np.tile(np.eye(4), (scans, 1, 1))
    surface = _core.SurfelMap3D(0.15)
    surface.add_end_points(recording.points, recording.hit, recording.offset, T)
    surface.fit()
    return recording, T, surface


def labelled(surface, moving):
    """P(static) of surfels, low where `moving` says so."""
    means = surface.surfels()[1]
    return np.where(moving(means), 0.02, 0.99).astype(np.float32), means


def pooled(surface, p, change, recording, T):
    """P(static) after pooling over clusters on flat ground."""
    return pool_clusters(p, change, select_obstacles(FLAT, surface), recording, T)


CAR, OTHER, WALL = box(2.0, 2.0, 4.0), box(-5.0, 2.0, 4.0), box(-6.0, -5.0, 13.0, height=2.5)


def front(means):
    return (means > [4.0, 1.9, 0.2]).all(axis=1)


def test_a_cluster_follows_its_dynamic_part():
    recording, T, surface = standing(CAR, OTHER, WALL)
    p, means = labelled(surface, front)
    found = pooled(surface, p, 0 * p, recording, T)
    car = (means > [1.9, 1.9, 0.25]).all(axis=1)
    assert (found[car] < 0.5).all()
    np.testing.assert_array_equal(found[~car], p[~car])
    assert (p[car] > 0.5).mean() > 0.4  # before


def test_weak_evidence_of_all_surfels_adds_up():
    recording, T, surface = standing(CAR, OTHER, WALL)
    p, means = labelled(surface, lambda means: np.zeros(len(means), bool))
    car = (means > [1.9, 1.9, 0.25]).all(axis=1)
    noise = np.random.default_rng(0).normal(0.0, 1.0, len(p))
    change = (noise + np.where(car, 1.6, -0.3)).astype(np.float32)
    assert (change[~car] > 1.6).sum() > 20  # elsewhere some say more, alone
    found = pooled(surface, p, change, recording, T)
    assert (found[car] < 0.5).all()
    np.testing.assert_array_equal(found[~car], p[~car])
    calm = pooled(surface, p, change - 0.9, recording, T)
    np.testing.assert_array_equal(calm, p)


PERSON = box(0.0, -4.9, 0.4, width=0.3, height=1.8)


@pytest.mark.parametrize(
    ("things", "low", "high"),
    [
        ((CAR,), (5.5, 1.9, 0.2), (np.inf, np.inf, np.inf)),
        ((WALL, PERSON), (-0.1, -4.92, 0.2), (0.5, np.inf, np.inf)),  # one who stands at a wall
    ],
)
def test_small_dynamic_parts_do_not_move_a_cluster(things, low, high):
    recording, T, surface = standing(*things)
    p, _ = labelled(surface, lambda means: ((means > low) & (means < high)).all(axis=1))
    assert (p < 0.5).sum() > 10
    np.testing.assert_array_equal(pooled(surface, p, 0 * p, recording, T), p)


def test_ground_is_no_obstacle_and_has_at_least_its_mean_p_static():
    crown = np.random.default_rng(0).uniform([-2, -2, 3.5], [2, 2, 5], (2000, 3))
    _, _, surface = standing(CAR, crown)
    obstacles = select_obstacles(FLAT, surface)
    z = surface.surfels()[1][:, 2]
    np.testing.assert_array_equal(obstacles.is_obstacle, (z > 0.2) & (z < 3.0))
    assert 100 < obstacles.is_obstacle.sum() < len(z)
    ground = np.abs(z) <= obstacles.min_end_height
    np.testing.assert_array_equal(obstacles.is_ground, ground)
    p, _ = labelled(surface, front)
    p[ground] = np.random.default_rng(0).uniform(0.3, 1.0, ground.sum())
    before, mean = p.copy(), np.float32(p[ground].mean(dtype=np.float64))
    found, raised = label_far_ground(p, obstacles)
    np.testing.assert_array_equal(p, before)
    np.testing.assert_array_equal(found, np.where(ground, np.maximum(p, mean), p))
    np.testing.assert_array_equal(raised.was_dynamic, ground & (p < 0.5))
    assert 100 < raised.was_dynamic.sum() < ground.sum() < len(p)


def test_what_is_hit_below_a_mover_goes_with_it():
    """A sole on ground that is grazed: dynamic where the leg above it was hit in the same sweep."""
    leg = np.column_stack([np.full(40, 3.07), np.full(40, 3.07), np.linspace(0.3, 1.5, 40)])
    sole = np.array([[3.07, 3.07, 0.02]])
    recording, T, surface = standing(leg, sole, scans=1)
    p, means = labelled(surface, lambda m: (m[:, 0] > 3.0) & (m[:, 0] < 3.15) & (m[:, 2] > 0.2))
    obstacles = select_obstacles(FLAT, surface)
    hidden = np.linalg.norm(means - sole[0], axis=1) < 0.12
    p[hidden] = 0.1
    found, raised = label_far_ground(p, obstacles)
    assert (found[hidden] > 0.5).all()
    data = recording.points, recording.hit, recording.offset, T
    surfel = surface.associate_beams(*data)
    above = raised.label_ground_contact(found, ScanBeams(*data), surfel)
    at_sole = hidden[surfel]
    assert at_sole.any()
    np.testing.assert_allclose(above[at_sole], 0.02, atol=1e-6)
    assert np.isnan(obstacles.label_ground_contact(found, ScanBeams(*data), surfel)).all()


def test_ground_from_static_surfels():
    _, T, surface = standing(CAR)
    T[:, :3, 3] = [0.0, 0.0, 1.8]
    means = surface.surfels()[1]
    low = means[:, 2] < 0.1
    ground = ground_from_surfels(surface, np.ones(len(means), np.float32), T[:, :3, 3])
    assert ground.observed
    assert ground.sensor_height == pytest.approx(1.8, abs=0.02)
    np.testing.assert_allclose(ground.height_at(means[low, :2]), 0.0, atol=0.02)
    unknown = ground_from_surfels(surface, np.where(low, 0.1, 1.0).astype(np.float32), T[:, :3, 3])
    assert not unknown.observed or unknown.sensor_height < 1.0  # roofs at most


def test_pooled_log_odds(monkeypatch):
    monkeypatch.setattr(spatial_coupling, "_POOLED_P_DYNAMIC", 0.25)
    p = np.array([0.9, 0.9, 0.9, 0.9, 0.3, 0.9, 0.52, 0.9, 0.9, 0.001], np.float32)
    moves = [np.nan, 0.2, 0.3, 1.0, 1.0, 0.25, 0.251, 0.0, 0.3, 1.0]
    change = [np.nan, 0.9, 0.0, -4.0, 4.0, 1.0, 0.0, 1.1, 4.0, 0.0]
    means = np.array([moves, change], np.float32).T
    found = apply_pooled_evidence(p, means)
    nats = np.array([1.0, 4.0, 0.02, 2.0, 4.0])
    np.testing.assert_allclose(found[[2, 3, 6, 7, 8]], 1 / (1 + np.exp(nats)), rtol=1e-4)
    assert found[4] == pytest.approx(1 / (1 + np.exp(4.0)), rel=1e-4)
    assert found[9] == p[9]  # surer than its body
    kept = [0, 1, 5]
    np.testing.assert_array_equal(found[kept], p[kept])
