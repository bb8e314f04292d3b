"""Scans that took time: the motion of the robot meanwhile is taken out of them."""

import dataclasses
import functools
import sys

import numpy as np
import pytest
from choices import RESOLUTION, options
from marks import slow_params

import stillmap
from stillmap import _core, em, slam
from stillmap.core.config import override
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

AT_ONCE = {"slam": {"deskew": False}}
# 1.5 m/s and 1.5 rad/s indoors, 12 m/s outdoors, ten scans a second that take all of the time
FAST = {
    "office": {
        "robot": {"scans": 120, "speed": 1.5, "turn_rate": 1.5, "scan_rate": 10.0},
        "laser": {"sweep_time": 0.1, "beams": 360, "fov": 2 * np.pi},
    },
    "street": {
        "robot": {"scans": 60, "speed": 12.0, "scan_rate": 10.0},
        "laser": {"sweep_time": 0.1},
    },
}


@functools.cache
def fast(world):
    return simulate(scene_by_name(world, FAST[world]), 100)


@pytest.fixture
def swept(room):
    """The small room, each beam a little later than the one before."""
    times = np.tile(np.linspace(0.0, 0.15, 120), 60).astype(np.float32)
    return dataclasses.replace(room.recording, beam_time=times)


def outcome(result):
    arrays = (result.poses, result.estimate.m_step.covariance, result.p_static)
    maps = [m for o in (result.map, result.raw_map) for m in (o.p_occupied, o.alpha, o.beta)]
    return [it.bound for it in result.iterations], [a.tobytes() for a in (*arrays, *maps)]


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["stillmap", "hit-ratio", "paper", "tracker"])
def test_it_can_be_left_and_the_printed_method_leaves_it(room, swept, estimator):
    chosen = options(estimator, max_iterations=3)
    at_once = stillmap.build(room.recording, chosen)
    left = stillmap.build(swept, override(chosen, AT_ONCE))
    assert outcome(left) == outcome(at_once)
    assert left.deskewed is left.recording is swept
    taken_out = stillmap.build(swept, chosen)
    assert (outcome(taken_out) == outcome(at_once)) == (estimator == "paper")


def test_where_all_beams_come_at_once_nothing_is_made_anew(room):
    for it in stillmap.iterate(room.recording, options(max_iterations=2)):
        assert it.deskewed is room.recording


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["stillmap", "hit-ratio", "tracker"])
@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("loops", [False, True])
def test_map_and_labels_are_made_of_the_same_points(room, swept, estimator, given, loops):
    chosen = override(options(estimator, max_iterations=3), {"slam": {"loop_closure": loops}})
    poses = room.truth.T_world_base if given else None
    for it in stillmap.iterate(swept, chosen, poses=poses):
        points = slam.deskew_recording(swept, it.estimate.poses, chosen.slam).points
        np.testing.assert_array_equal(it.deskewed.points, points)
        assert not np.array_equal(points, swept.points)
        grid = _core.OccupancyGrid2D(RESOLUTION, slam.FREE_SPACE_MARGIN)
        em.add_recording(grid, it.deskewed, it.estimate.poses, it.estimate.weights)
        has_counts = em.needs_counts(estimator)
        assert it.estimate.m_step.grid.dense()[1].any() == has_counts
        if has_counts:
            for ours, theirs in zip(it.estimate.m_step.grid.dense(), grid.dense(), strict=True):
                np.testing.assert_array_equal(ours, theirs)
        found = em.e_step(it.deskewed, it.estimate.poses, grid, estimator, chosen.em)
        np.testing.assert_array_equal(it.estimate.p_static, found.p_static)
    result = stillmap.build(swept, chosen, poses=poses)
    assert result.recording is swept
    raw = _core.OccupancyGrid2D(RESOLUTION)
    em.add_recording(raw, result.deskewed, result.poses, None)
    m = result.raw_map
    first_cell = np.round(np.array(m.origin[:2]) / RESOLUTION).astype(int).tolist()
    _, alpha, beta = raw.dense(first_cell, m.alpha.shape)
    np.testing.assert_array_equal(m.alpha, alpha.astype(np.float32))
    np.testing.assert_array_equal(m.beta, beta.astype(np.float32))


@pytest.mark.parametrize("odometry", [True, False])
def test_what_tells_of_the_motion(swept, monkeypatch, odometry):
    """Odometry, or else poses of the scans as they were taken; then the poses so far."""
    # the package has the function under the name of its module
    m_step = sys.modules["stillmap.slam.m_step"]
    built, found, plain = [], [], m_step.register_scans

    def noted(recording, *rest, **how):
        built.append(recording)
        found.append(plain(recording, *rest, **how))
        return found[-1]

    monkeypatch.setattr(m_step, "register_scans", noted)
    recording = swept if odometry else swept.without_odometry()
    chosen = options(max_iterations=2)
    first, _ = stillmap.iterate(recording, chosen)
    known = [swept.T_odom_base] if odometry else [None, found[0].poses]
    for seen, poses in zip(built, [*known, first.estimate.poses], strict=True):
        expected = slam.deskew_recording(recording, poses, chosen.slam)
        np.testing.assert_array_equal(seen.points, expected.points)


@pytest.mark.slow
@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("world", ["street", *slow_params("office")])
def test_poses_at_speed(world, odometry):
    """Seeds 100 to 102: 4 to 26 mm instead of 20 to 45, and 9 to 10 instead of 198 to 362."""
    simulation = fast(world)
    recording, truth = simulation.recording, simulation.truth.T_world_base
    if not odometry:
        recording = recording.without_odometry()
    ate = []
    for changes in ({}, AT_ONCE):
        result = stillmap.build(recording, override(options(max_iterations=4), changes))
        ate.append(compute_absolute_errors(result.poses, truth).rmse)
    assert ate[0] < 0.4 * ate[1]
    assert ate[0] < {"office": 0.015, "street": 0.03}[world]
