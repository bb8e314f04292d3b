"""Cost of steps given odometry, and evidence of maps, against plain twins."""

import itertools
from functools import partial

import numpy as np
import pytest
from rooms import drive
from scipy.special import betaln
from scipy.stats import norm

from stillmap import _core
from stillmap.core import se2
from stillmap.slam import motion_model, scan_hits, trajectory_cost
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_matching import FAULT_COST, INFORMATION_SCALE


def run_with_a_fault(scans=9):
    simulation = drive(2, robot={"scans": scans})
    recording, poses = simulation.recording, simulation.truth.T_world_base
    recording.T_odom_base[4:] = recording.T_odom_base[4:] @ se2.matrix(0.5, 0.2, 0.3)
    return recording, poses


def test_cost_is_that_of_the_likeliest_states():
    recording, poses = run_with_a_fault()
    cost = trajectory_cost.OdometryCost(recording, poses, OdometryOptions())
    steps, measured = se2.increments(poses), se2.increments(recording.T_odom_base)
    onward = np.concatenate([steps[:1], steps[:-1]])

    def nats(expected, std):
        d = se2.parameters(se2.inverse(expected) @ steps)
        return -norm.logpdf(d, scale=std).sum(axis=1) - 1.5 * np.log(2.0 * np.pi)

    emission = np.array([nats(measured, cost.std), nats(onward, cost.onward_std)])
    change = np.array([[0.0, FAULT_COST], [trajectory_cost._RECOVERY_COST, 0.0]])
    costs = []
    for states in itertools.product((0, 1), repeat=len(steps)):
        changes = change[(0, *states[:-1]), states].sum()
        costs.append(changes + emission[states, np.arange(len(steps))].sum())
    assert cost(poses, 1, len(poses)) == pytest.approx(min(costs), rel=1e-9)
    assert np.argmin(costs) != 0  # of states that are all valid


def test_a_part_starts_with_valid_odometry():
    recording, poses = run_with_a_fault()
    cost = trajectory_cost.OdometryCost(recording, poses, OdometryOptions())
    assert cost(poses, 1, 4) + cost(poses, 4, 9) == pytest.approx(cost(poses, 1, 9), rel=1e-9)


def test_without_odometry_steps_cost_nothing():
    recording, poses = run_with_a_fault()
    cost = trajectory_cost.OdometryCost(recording.without_odometry(), poses, OdometryOptions())
    assert cost(poses, 1, len(poses)) == 0.0


def test_motion_at_constant_velocity_is_less_certain_over_longer_times():
    std = motion_model.onward_std(np.array([0, 1e8, 4e8, 14e8], np.int64))
    assert (np.diff(std, axis=0) >= 0.0).all()
    assert std[0, 0] < std[2, 0]


def test_where_cells_begin_is_no_evidence():
    # walls of the room lie along the cells
    simulation = drive(2, robot={"scans": 20})
    recording, poses = simulation.recording, simulation.truth.T_world_base
    e, scans = np.ones(recording.n_beams, np.float32), np.arange(len(poses))
    evidence, of_grids = [], []
    for shift in (0.0, 0.025):
        moved = se2.matrix(shift, shift, 0.0) @ poses
        evidence.append(trajectory_cost.map_evidence(recording, e, scans, moved, 0.05))
        grid = scan_hits.count_beams(recording, e, scans, moved, 0.05)
        of_grids.append(INFORMATION_SCALE * grid.log_evidence(0.02, 0.5))
    assert evidence == pytest.approx([np.mean(of_grids)] * 2, abs=1.0)
    assert abs(of_grids[0] - of_grids[1]) > 20.0


def test_evidence_gain_is_that_of_beta_distributions():
    simulation = drive(2, robot={"scans": 20})
    recording, poses = simulation.recording, simulation.truth.T_world_base
    e = np.random.default_rng(0).uniform(size=recording.n_beams).astype(np.float32)
    halves = np.split(np.arange(len(poses)), [12])
    count = partial(scan_hits.count_beams, recording, e, resolution=0.1)
    first, second = (count(scans=k, poses=poses[k], everywhere=True) for k in halves)
    near = count(scans=halves[1], poses=poses[halves[1]], other=first)
    together = count(scans=np.arange(len(poses)), poses=poses, everywhere=True)
    weights, every_beam = e.copy(), _core.OccupancyGrid2D(0.1)
    for beams in map(recording.beams_of, range(recording.n_scans)):
        hit = recording.hit[beams]
        weights[beams][hit] *= scan_hits.evidence_shares(recording.points[beams][hit])
    data = recording.points, recording.hit, weights, recording.offset
    _core.add_beams(every_beam, *data, recording.T_map_sensor(poses))
    np.testing.assert_allclose(together.dense()[1:], every_beam.dense()[1:], atol=1e-6)
    counts = [np.array(grid.dense(*together.bounding_box())[1:]) for grid in (first, second)]
    both = (counts[0].sum(axis=0) > 0.0) & (counts[1].sum(axis=0) > 0.0)
    has_hits = both & (sum(counts)[0] > 0.0)
    assert 100 < has_hits.sum() < both.sum()
    for a, b in ((0.02, 0.5), (2.0, 1.0)):
        evidence = [
            (betaln(alpha + a, beta + b) - betaln(a, b))[has_hits].sum()
            for alpha, beta in (sum(counts), *counts)
        ]
        expected = evidence[0] - evidence[1] - evidence[2]
        assert first.evidence_gain(second, a, b) == pytest.approx(expected, rel=1e-9)
        assert second.evidence_gain(first, a, b) == pytest.approx(expected, rel=1e-9)
        assert first.evidence_gain(near, a, b) == pytest.approx(expected, rel=1e-9)
        assert near.log_evidence(a, b) == pytest.approx(second.log_evidence(a, b), rel=1e-9)
    with pytest.raises(ValueError, match="resolution"):
        first.evidence_gain(_core.OccupancyGrid2D(0.05), 1.0, 1.0)
    with pytest.raises(ValueError, match="pseudo-counts"):
        first.evidence_gain(second, 0.0, 1.0)
