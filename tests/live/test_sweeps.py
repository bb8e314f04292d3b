"""The live mapper in 3D: sweeps of a spinning lidar in a sweeps."""

from dataclasses import replace

import numpy as np
import pytest
from live_runs import Run, simulate_sweeps

import stillmap
from stillmap.core import se2
from stillmap.live.causal_labels import find_pixel_size
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate


def from_first(poses):
    return se2.inverse(poses[0]) @ poses


def test_poses_and_labels_are_those_of_the_truth(sweeps):
    found, true = from_first(sweeps.poses), from_first(sweeps.truth.T_world_base)
    assert np.linalg.norm(true[-1, :3, 3]) > 4.0
    assert np.linalg.norm((found - true)[:, :3, 3], axis=1).max() < 0.05
    assert sweeps.updates[-1].covariance.shape == (6, 6)
    hit = sweeps.recording.hit.copy()
    hit[: sweeps.recording.offset[50]] = False  # little is known yet
    says, moves = (sweeps.p_static < 0.5)[hit], ~sweeps.truth.static[hit]
    both = (says & moves).sum()
    assert moves.sum() > 1000
    assert both > 0.9 * says.sum()
    assert both > 0.5 * moves.sum()


def test_the_map_has_obstacles_above_the_ground(sweeps):
    found, cells = sweeps.mapper.map, sweeps.mapper.cells
    occupied = found.p_occupied > 0.65
    assert occupied.sum() > 100
    assert (found.p_occupied < 0.2).sum() > 5 * occupied.sum()  # the ground
    assert cells.cells.shape[1] == 3
    assert np.mean(cells.p_occupied > 0.5) > 0.5


def test_threads_change_nothing():
    simulation = simulate_sweeps("hall", 12)
    one, two = (Run(simulation, threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.poses, two.poses)
    np.testing.assert_array_equal(one.p_static, two.p_static)
    for run in (one, two):
        run.mapper.close()


def test_labels_of_an_earlier_sweep_follow_from_what_is_known_now(sweeps):
    t = 40
    beams = sweeps.beams[t]
    later, at_once = sweeps.mapper.label(beams, t), sweeps.updates[t].p_static
    moves = ~sweeps.truth.static[sweeps.recording.beams_of(t)]
    right, before = (np.mean((p < 0.5) == moves, where=beams.hit) for p in (later, at_once))
    assert right > before


def cover(beams):
    nothing = np.full_like(beams.points, np.nan)
    return replace(beams, points=nothing, hit=np.zeros_like(beams.hit))


def test_a_lidar_that_is_covered_says_nothing_of_the_map(sweeps):
    """At first and later."""
    true = from_first(sweeps.truth.T_world_base[2:30])
    with LiveMapper({"threads": 1}) as mapper:
        for t, one in enumerate(sweeps.beams[:30]):
            is_covered = t < 2 or 20 <= t < 25
            update = mapper.push(cover(one) if is_covered else one)
            assert ("blind" in update.doubts) == is_covered
            if t == 1:
                assert not mapper.map.p_occupied.size
        pixel = find_pixel_size(sweeps.beams[2].points, sweeps.beams[2].hit)
        assert mapper._slam.labels._pixels[0] == pixel
        poses = mapper.poses
    assert len(poses) == 30
    assert not update.doubts
    np.testing.assert_allclose(poses[-1], update.pose, atol=1e-9)
    off = np.linalg.norm((from_first(poses[2:]) - true)[:, :3, 3], axis=1)
    assert off.max() < 0.2


def test_the_dimension_stays():
    with LiveMapper({"threads": 1}) as mapper:
        mapper.push(stillmap.Scan(0, np.full(10, 2.0), np.linspace(0.0, 1.0, 10)))
        with pytest.raises(ValueError, match="2D"):
            mapper.push(stillmap.Scan(10**8, points=np.ones((10, 3))))


@pytest.mark.parametrize(("channels", "columns"), [(16, 900), (64, 1800), (128, 1024)])
def test_pixels_are_about_the_angles_between_beams(channels, columns):
    up = np.linspace(-0.4, 0.2, channels)
    around = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    up, around = np.meshgrid(up, around)
    flat = np.stack([np.cos(around), np.sin(around), np.tan(up)], axis=-1).reshape(-1, 3)
    points = (10.0 * flat).astype(np.float32)
    azimuth, elevation = find_pixel_size(points, np.ones(len(points), bool))
    assert 0.006 <= azimuth < 0.01
    between = 0.58 / (channels - 1)  # the sum of all is atan 0.4 + atan 0.2
    assert 0.7 * between < elevation < max(2.0 * between, 0.006)


@pytest.mark.slow
@pytest.mark.parametrize("background", [False, True])
def test_loops_are_closed(background):
    lidar = {"channels": 16, "columns": 360}
    robot = {"scans": 900, "speed": 3.0}
    simulation = simulate(scene_by_name("corridor", {"lidar": lidar, "robot": robot}), 2)
    recording, true = simulation.recording, from_first(simulation.truth.T_world_base)
    assert np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum() > 120.0
    with LiveMapper({"threads": 1}, background=background) as mapper:
        for beams in iter_beams(recording):
            update = mapper.push(beams)
        poses, cells = mapper.poses, mapper.cells
        if not background:  # elsewhere they are closed in another process
            found = mapper._slam.frame._closer._found
            assert sum(not closure.rejected for closure in found) > 2
    np.testing.assert_allclose(poses[-1], update.pose, atol=1e-9)
    off = np.linalg.norm((from_first(poses) - true)[:, :3, 3], axis=1)
    assert off.max() < 0.3
    assert len(cells.cells) > 1000
