"""Worlds in which scans say little: poses stay with odometry, and nobody was carried."""

import math

import pytest
from driven import mapped
from marks import slow_params

import stillmap
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

SHORT_180 = {"max_range": 6.0}
NARROW = {"beams": 121, "fov": math.pi / 2, "max_range": 8.0, "range_noise": 0.03}
SHORTEST = {"max_range": 4.0}


def assert_held(simulation, ratio):
    """No break, and no worse than that ratio to odometry alone."""
    truth = simulation.truth.T_world_base
    found = mapped(simulation.recording)
    assert found.diagnostics.breaks == []
    of_odometry = compute_absolute_errors(simulation.recording.T_odom_base, truth).rmse
    assert compute_absolute_errors(found.poses, truth).rmse < ratio * of_odometry


def hall(laser, people, seed, scans=900, **more):
    changes = {"laser": laser, "crowd": {"people": people}, "robot": {"scans": scans}, **more}
    return simulate(scene_by_name("hall", changes), seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("laser", "people", "seed"),
    [
        (SHORT_180, 20, 0),
        (NARROW, 30, 0),
        *slow_params((SHORT_180, 20, 1), (NARROW, 30, 1), (SHORT_180, 20, 2), (NARROW, 30, 2)),
    ],
)
def test_short_and_narrow_views_in_a_crowd(laser, people, seed):
    assert_held(hall(laser, people, seed), 1.0)


@pytest.mark.slow
def test_people_who_walk_along():
    simulation = hall(SHORT_180, 20, 2)
    truth = simulation.truth.T_world_base
    result = stillmap.build(simulation.recording)
    assert result.doubts.breaks == []
    of_odometry = compute_absolute_errors(simulation.recording.T_odom_base, truth).rmse
    assert compute_absolute_errors(result.poses, truth).rmse < 0.5 * of_odometry


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_hardly_a_wall_in_reach(seed):
    assert_held(hall(SHORTEST, 20, seed, scans=2000), 1.2)


@pytest.mark.parametrize("seed", [0, *slow_params(1, 2)])
def test_half_a_minute_without_a_return(seed):
    blind = {"max_range": 12.0, "blind_at": 0.5, "blind_time": 30.0}
    assert_held(hall(blind, 10, seed, scans=600), 1.0)
