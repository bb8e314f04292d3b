"""Loop closure on small worlds: true loops close, false ones are rejected."""

import dataclasses
import functools

import numpy as np
import pytest
from driven import ate, chained, loop_context, mapped, picked, prior, silent
from rooms import drive

from stillmap import _core, em
from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate
from stillmap.sim.walls import box
from stillmap.slam import SlamOptions, local_map, odometry_2d
from stillmap.slam.loop_candidates import odometry_constraints
from stillmap.slam.loop_closure import close_loops, reject_inconsistent
from stillmap.slam.types import LoopClosure, MStepResult

OPTIONS = SlamOptions()
OPEN = SlamOptions(loop_closure=False)
LASER = {"beams": 120, "max_range": 6.0}


@functools.cache
def square():
    """A square of corridors with pillars along the walls; one lap and a bit, and drift."""
    pillars = [
        wall
        for x in range(-5, 7, 2)
        for at in ((x, -6.9), (6.9, x), (x + 1, 6.9), (-6.9, x))
        for wall in box(*at, 0.2 + 0.03 * x, 0.3)
    ]
    walls = *box(0, 0, 14, 14), *box(0, 0, 10, 10), *pillars
    route = ((-3, -6), (6, -6), (6, 6), (-6, 6), (-6, -6), (3, -6))
    return drive(1, walls, route, laser=LASER, odometry={"drift_noise": 0.02})


@functools.cache
def repetitive():
    """A corridor with a niche every two metres; forth, back and forth again."""
    niches = [wall for x in range(0, 40, 2) for wall in box(x, 1.15, 0.5, 0.3)]
    route = ((-1, -0.2), (30, -0.2), (1, -0.3), (20, -0.2))
    walls = *box(19, 0, 44, 2.6), *niches
    return drive(2, walls, route, laser=LASER, odometry={"drift_noise": 0.01})


def errors(found, simulation):
    """(L, 2) by what the accepted closures miss the true relation: metres, and chi-square.

    Metres may be many where a view can slide along a wall: then the covariance has to say so.
    """
    truth = simulation.truth.T_world_base
    accepted = [c for c in found if not c.rejected]
    wanted = [se2.inverse(truth[c.earlier]) @ truth[c.later] for c in accepted]
    missed = [se2.parameters(se2.inverse(T) @ c.T) for T, c in zip(wanted, accepted, strict=True)]
    chi2 = [d @ np.linalg.solve(c.covariance, d) for d, c in zip(missed, accepted, strict=True)]
    metres = [np.hypot(*d[:2]) for d in missed]
    return np.array([metres, chi2]).T.reshape(-1, 2)


def test_a_square_with_drift_closes():
    simulation = square()
    truth = se2.inverse(simulation.truth.T_world_base[0]) @ simulation.truth.T_world_base
    steps = se2.inverse(truth[:-1]) @ truth[1:] @ se2.matrix(4e-4, 2e-4, 6e-5)
    poses, n = chained(steps), len(truth)
    drifted = MStepResult(poses, np.zeros((n, 3, 3)), _core.OccupancyGrid2D(0.05), np.ones(n))
    before = compute_absolute_errors(drifted.poses, truth)
    recording = simulation.recording
    found = close_loops(recording, prior(recording), OPTIONS, drifted, silent)
    metres, chi2 = errors(found.loops, simulation).T
    assert np.count_nonzero(metres < 0.1) >= 4
    assert chi2.max() < 11.3  # 99 %
    assert compute_absolute_errors(found.poses, truth).rmse < 0.5 * before.rmse
    end = se2.parameters(se2.inverse(truth[-1]) @ found.poses[-1])
    assert np.hypot(*end[:2]) < 0.08
    assert np.hypot(*se2.parameters(se2.inverse(truth[-1]) @ drifted.poses[-1])[:2]) > 0.2


@functools.cache
def mapped_square():
    return mapped(square().recording)


def test_a_square_is_mapped():
    found = mapped_square()
    metres, chi2 = errors(found.loops, square()).T
    assert np.count_nonzero(metres < 0.1) >= 4
    assert chi2.max() < 11.3
    assert ate(found, square().truth) < 0.02
    # the grid is what the poses make
    grid = _core.OccupancyGrid2D(OPTIONS.resolution)
    em.add_recording(grid, square().recording, found.poses, prior(square().recording))
    for ours, theirs in zip(found.grid.dense(), grid.dense(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(found.poses[0], np.eye(3))


def test_a_repetitive_corridor_makes_no_false_loop():
    found = mapped(repetitive().recording)
    metres, chi2 = errors(found.loops, repetitive()).T
    assert len(metres) >= 5
    assert metres.max() < 0.5  # a niche further would be 2 m
    assert chi2.max() < 25


def test_straight_travel_has_no_loops():
    short = picked(repetitive().recording, np.arange(250))  # 25 m
    assert mapped(short).loops == []


def straight_context(spacing=1.0):
    """Twice along the same way, 21 keyframes each."""
    x = spacing * np.concatenate([np.arange(21.0), np.arange(21.0)])
    recording = dataclasses.replace(square().recording, T_odom_base=None)
    n = len(x)
    travelled = spacing * np.arange(float(n))
    return loop_context(recording, se2.matrix(x, 0.0, 0.0), travelled, np.arange(n))


def closures(shifts, score=70.0):
    """The second time at keyframe k is the first time there, moved by shift; nats of each."""
    covariance = np.diag([0.03**2, 0.03**2, 0.006**2])
    return [
        LoopClosure(k, 21 + k, se2.matrix(shift, 0.0, 0.0), covariance, 1.0, score=score)
        for k, shift in enumerate(shifts)
    ]


@pytest.mark.parametrize("spacing", [1.0, 5.0])
def test_inconsistent_closure_is_rejected(spacing):
    context = straight_context(spacing)
    chain = odometry_constraints(context, [])
    shifts = [0.5] * 8
    shifts[4] = -0.5
    rejected = [c.rejected for c in reject_inconsistent(context, chain, closures(shifts))]
    assert rejected == ["nearby closures disagree" if k == 4 else "" for k in range(8)]
    for score, refused in ((15.0, False), (10.0, True)):
        (single,) = reject_inconsistent(context, chain, closures([0.1], score))
        assert bool(single.rejected) == refused
    pair = reject_inconsistent(context, chain, closures([0.1, 0.1], 10.0))
    assert not any(closure.rejected for closure in pair)


def test_the_more_likely_of_closures_that_disagree_are_kept():
    context = straight_context()
    chain = odometry_constraints(context, [])
    first, *others = closures([0.5, -0.5, -0.5, -0.5])
    for score, kept in ((100.0, False), (300.0, True)):
        weighed = [dataclasses.replace(first, score=score), *others]
        accepted = [not c.rejected for c in reject_inconsistent(context, chain, weighed)]
        assert accepted == [kept, *[not kept] * 3]


def test_closures_disagree_with_none_beyond_a_break():
    context, shifts = straight_context(), [0.5] * 4 + [-0.5]
    for breaks, kept in (([], False), ([25], True)):
        chain = odometry_constraints(context, breaks)
        rejected = [c.rejected for c in reject_inconsistent(context, chain, closures(shifts))]
        assert [not reason for reason in rejected] == [*[True] * 4, kept]


def test_odometry_at_fault_loosens_no_step():
    # whether it failed is decided before loops are closed
    simulation = square()
    T = simulation.recording.T_odom_base.copy()
    T[100:] = se2.inverse(T[100]) @ T[100:]
    poses = simulation.truth.T_world_base
    frames = local_map.select_keyframes(poses, 1.0, 0.5)
    recording = dataclasses.replace(simulation.recording, T_odom_base=T)
    context = loop_context(recording, poses, local_map.travelled_distance(poses), frames)
    chain = odometry_constraints(context, [])
    assert max(np.linalg.eigvalsh(step.covariance[:2, :2]).max() for step in chain) < 0.1**2


def test_corrections_spread_between_keyframes():
    poses = se2.matrix(np.arange(11.0), 0.0, 0.0)
    frames = np.array([0, 10])
    moved = se2.matrix(np.array([0.0, 10.0]), np.array([0.0, 1.0]), 0.0)
    spread = se2.parameters(local_map.propagate_corrections(poses, frames, moved))
    np.testing.assert_allclose(spread[:, 1], np.arange(11) / 10, atol=1e-5)
    np.testing.assert_allclose(spread[:, 0], np.arange(11), atol=1e-9)


def test_keyframes_by_hand():
    # a metre a scan, two scans turning by 0.3 rad each, one on the spot
    x = se2.matrix([0, 1, 2, 2, 2, 2], 0.0, [0, 0, 0, 0.3, 0.6, 0.6])
    assert local_map.select_keyframes(x, 1.0, 0.5).tolist() == [0, 1, 2, 4, 5]
    assert local_map.select_keyframes(x[:1], 1.0, 0.5).tolist() == [0]
    assert local_map.travelled_distance(x).tolist() == [0, 1, 2, 2, 2, 2]


def test_keyframes_per_sensor():
    x = np.tile(np.eye(3), (8, 1, 1))
    x[:, 0, 2] = 0.3 * np.arange(8)
    sensor = np.array([0, 1, 0, 1, 0, 1, 0, 1])
    frames = local_map.select_keyframes_per_sensor(x, sensor, 1.0, 0.5)
    assert frames.tolist() == [0, 1, 4, 5, 6, 7]
    assert local_map.select_keyframes_per_sensor(x, 0 * sensor, 1.0, 0.5).tolist() == [0, 4, 7]


def test_without_loops_poses_are_incremental():
    recording = square().recording
    plain = odometry_2d.register_scans(recording, prior(recording), OPEN, silent)
    found = mapped(recording, OPEN)
    np.testing.assert_array_equal(found.poses, plain.poses)
    assert found.loops == []


def test_start_is_only_refined():
    first = mapped_square()
    again = mapped(square().recording, initial=first)
    assert again.loops == first.loops  # no search; the closures are kept
    assert first.loops
    assert np.linalg.norm(again.poses[:, :2, 2] - first.poses[:, :2, 2], axis=1).max() < 0.03


@pytest.mark.parametrize("scans", [1, 2, 3])
def test_hardly_any_scans(scans):
    simulation = simulate(scene_by_name("hall", {"robot": {"scans": scans}}), 0)
    found = mapped(simulation.recording)
    assert len(found.poses) == scans
    assert np.all(np.isfinite(found.poses))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_corridors_close(seed):
    simulation = simulate(scene_by_name("corridor"), seed)
    assert ate(mapped(simulation.recording), simulation.truth) < 0.03
