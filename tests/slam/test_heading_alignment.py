"""Headings that agree with the directions of walls, on open routes without a loop."""

import numpy as np
import pytest
from recordings import of_one_sensor

import stillmap
from stillmap.core import se2
from stillmap.results.eval.trajectory import align
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import loop_closure
from stillmap.slam.heading_alignment import align_headings
from stillmap.slam.pose_graph import Constraint, PoseGraph

STEP = np.diag([1e-3, 3e-4, 1.6e-5])
BEARINGS = np.linspace(-np.pi, np.pi, 240, endpoint=False)


def look_at_room(heading, wall=0.0, rng=None):
    """(240, 2) end points on the walls of a room of 8 by 6 m, turned by `wall` rad."""
    bearings = BEARINGS + heading - wall
    with np.errstate(divide="ignore"):
        r = np.minimum(4.0 / np.abs(np.cos(bearings)), 3.0 / np.abs(np.sin(bearings)))
    if rng is not None:
        r = r + rng.normal(0.0, 0.01, len(r))
    return np.stack([r * np.cos(BEARINGS), r * np.sin(BEARINGS)], axis=1)


def drive(drift, walls, headings):
    """A recording of rooms, each seen from its middle, and the graph of poses whose heading drifts.

    Args:
        drift: (K,) rad of the poses.
        walls: (K,) rad, how the rooms are turned.
        headings: (K,) rad, true ones.
    """
    K, rng = len(drift), np.random.default_rng(0)
    scans = [look_at_room(*pair, rng) for pair in zip(headings, walls, strict=True)]
    n = len(BEARINGS)
    recording = of_one_sensor(
        np.arange(K, dtype=np.int64) * 10**9,
        np.arange(K + 1, dtype=np.int64) * n,
        np.concatenate(scans).astype(np.float32),
        np.ones(K * n, np.bool_),
    )
    poses = se2.matrix(np.arange(K), np.zeros(K), np.asarray(headings) + drift)
    steps = se2.inverse(poses[:-1]) @ poses[1:]
    chain = [Constraint(k, k + 1, T, STEP) for k, T in enumerate(steps)]
    return recording, PoseGraph(np.arange(K), poses, chain)


def matched(K, std=0.004):
    """(K, 3, 3) covariances of scans whose heading the local map measures to `std` rad."""
    return np.tile(np.diag([1e-4, 1e-4, std**2]), (K, 1, 1))


def align_all(recording, graph, std=0.004):
    """All beams are static."""
    e = np.ones(recording.n_beams, np.float32)
    return align_headings(recording, e, graph, matched(len(graph.poses), std))


def aligned(drift, walls, headings):
    found = align_all(*drive(drift, walls, headings))
    off = se2.wrap(se2.parameters(found.poses)[:, 2] - headings)
    return off - off.mean()


HEADINGS = 0.3 + 0.4 * np.sin(np.arange(60) / 5.0)  # rad
DRIFT = np.linspace(0.0, 0.03, 60)  # rad


def test_rooms_a_quarter_turn_apart_are_parallel():
    off = aligned(DRIFT, 0.5 * np.pi * (np.arange(60) % 3), HEADINGS)
    assert off.std() < 0.6 * DRIFT.std()


def test_a_wing_at_another_angle_stays_there():
    off = aligned(np.zeros(60), np.where(np.arange(60) < 30, 0.0, np.radians(20.0)), HEADINGS)
    assert np.abs(off).max() < 1e-3


def test_rooms_of_all_directions_change_hardly_anything():
    walls = np.random.default_rng(1).uniform(0.0, 0.5 * np.pi, 60)
    off = aligned(np.zeros(60), walls, HEADINGS)
    assert np.sqrt(np.mean(off**2)) < 0.004


def test_what_moves_says_nothing():
    recording, graph = drive(DRIFT, np.zeros(60), HEADINGS)
    found = align_headings(recording, np.zeros(recording.n_beams, np.float32), graph, matched(60))
    np.testing.assert_allclose(found.poses, graph.poses, atol=1e-9)


def test_precise_scan_matching_is_hardly_corrected():
    recording, graph = drive(DRIFT, np.zeros(60), HEADINGS)
    before = se2.parameters(graph.poses)[:, 2]
    found = (align_all(recording, graph, std) for std in (0.001, 0.004))
    precise, usual = (np.std(se2.parameters(one.poses)[:, 2] - before) for one in found)
    assert precise < 0.1 * usual


def test_a_step_across_a_break_stays_as_it_was():
    recording, graph = drive(DRIFT, np.zeros(60), HEADINGS)
    unknown = Constraint(29, 30, graph.constraints[29].T, np.diag([1e6, 1e6, 100.0]))
    graph.constraints[29] = unknown
    assert align_all(recording, graph).constraints[29] is unknown


def test_a_short_way_is_left_as_it_is():
    recording, graph = drive(DRIFT[:8], np.zeros(8), HEADINGS[:8])
    assert align_all(recording, graph) is graph


def heading_error(result, truth):
    """RMS rad of the headings, aligned."""
    off = se2.parameters(se2.inverse(truth) @ align(result.poses, truth) @ result.poses)[:, 2]
    return float(np.std(off))


@pytest.mark.slow
def test_headings_of_an_open_route(monkeypatch):
    changes = {"robot": {"scans": 600}}
    with_it, without = [], []
    for seed in (2, 100):  # that drift most of those of the benchmarks
        simulation = simulate(scene_by_name("corridor-crowd", changes), seed)
        truth = simulation.truth.T_world_base
        with_it.append(heading_error(stillmap.build(simulation.recording), truth))
        with monkeypatch.context() as patch:
            patch.setattr(loop_closure, "align_headings", lambda _, __, graph, ___: graph)
            without.append(heading_error(stillmap.build(simulation.recording), truth))
    assert np.mean(with_it) < 0.8 * np.mean(without)
    assert np.mean(with_it) < np.radians(0.12)
