"""A laser in front and one behind, through the live mapper."""

from dataclasses import replace

import numpy as np
import pytest
from live_runs import answers, poses_of

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

# T_base_sensor of the lasers; the one behind looks back
FRONT, REAR = se2.matrix(0.2, 0.1, 0.3), se2.matrix(-0.3, 0.0, np.pi - 0.2)


@pytest.fixture(scope="module")
def simulation():
    """There and back through a corridor with people, looking all around."""
    laser = {"beams": 360, "fov": 2.0 * np.pi}
    return simulate(scene_by_name("corridor", {"laser": laser, "robot": {"scans": 160}}), 3)


@pytest.fixture(scope="module")
def both(simulation):
    """The mapper, its updates, and whether each is of the laser in front."""
    recording = simulation.recording
    updates, is_front = [], []
    with LiveMapper({"threads": 1}) as mapper:
        for t, beams in enumerate(iter_beams(recording)):
            for scan in halves(beams):
                updates.append(mapper.push(scan, recording.T_odom_base[t]))
                is_front.append(scan.sensor == "front")
        yield mapper, updates, np.array(is_front)


def halves(beams):
    """A scan all around as those of two lasers, with their stamps a little apart."""
    ahead = beams.points[:, 0] >= 0.0
    for name, sees, T, later in (("front", ahead, FRONT, 0), ("rear", ~ahead, REAR, 1000)):
        to_sensor = se2.inverse(T) @ beams.T_base_sensor
        points = beams.points[sees] @ to_sensor[:2, :2].T + to_sensor[:2, 2]
        yield replace(
            beams,
            stamp_ns=beams.stamp_ns + later,
            points=np.ascontiguousarray(points, np.float32),
            hit=np.ascontiguousarray(beams.hit[sees]),
            T_base_sensor=T,
            sensor=name,
        )


def test_poses_are_as_good_as_those_of_one_laser_that_sees_the_same(simulation, both):
    true = simulation.truth.T_world_base
    wanted = compute_absolute_errors(poses_of(answers(simulation.recording)), true).rmse
    mapper, updates, is_front = both
    for is_its in (is_front, ~is_front):
        errors = compute_absolute_errors(poses_of(updates)[is_its], true)
        assert errors.rmse < 1.2 * wanted + 0.002
        assert errors.max < 0.05
    assert len(mapper.poses) == len(updates)
    assert compute_absolute_errors(mapper.poses, np.repeat(true, 2, axis=0)).rmse < 0.01


def test_both_lasers_tell_movers(simulation, both):
    updates, recording = both[1], simulation.recording
    says, moves = [], []
    for t in range(recording.n_scans):
        beams = recording.beams_of(t)
        static, hit = simulation.truth.static[beams], recording.hit[beams]
        ahead = recording.points[beams][:, 0] >= 0.0
        for update, half in ((updates[2 * t], ahead), (updates[2 * t + 1], ~ahead)):
            says.append(update.p_static[hit[half]] < 0.5)
            moves.append(~static[half & hit])
    says, moves = np.concatenate(says), np.concatenate(moves)
    assert 2 * (says & moves).sum() / (says.sum() + moves.sum()) > 0.85
