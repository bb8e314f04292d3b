"""A laser in front and one behind, through the live mapper."""

from dataclasses import replace

import numpy as np
from live_runs import answers, poses_of

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

# T_base_sensor of the lasers; the one behind looks back
FRONT, REAR = se2.matrix(0.2, 0.1, 0.3), se2.matrix(-0.3, 0.0, np.pi - 0.2)


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


def test_two_lasers_are_as_good_as_one_that_sees_the_same():
    """There and back through a corridor with people, looking all around."""
    laser = {"beams": 360, "fov": 2.0 * np.pi}
    changes = {"laser": laser, "robot": {"scans": 160}}
    simulation = simulate(scene_by_name("corridor", changes), 3)
    recording, true = simulation.recording, simulation.truth.T_world_base
    wanted = compute_absolute_errors(poses_of(answers(recording)), true).rmse
    updates, says, moves = [], [], []
    with LiveMapper({"threads": 1}) as mapper:
        for t, beams in enumerate(iter_beams(recording)):
            ahead, dynamic = (
                beams.points[:, 0] >= 0.0,
                ~simulation.truth.static[recording.beams_of(t)],
            )
            for scan, half in zip(halves(beams), (ahead, ~ahead), strict=True):
                updates.append(mapper.push(scan, recording.T_odom_base[t]))
                says.append(updates[-1].p_static[scan.hit] < 0.5)
                moves.append(dynamic[half & beams.hit])
        poses = mapper.poses
    for of_laser in (updates[::2], updates[1::2]):
        errors = compute_absolute_errors(poses_of(of_laser), true)
        assert errors.rmse < 1.2 * wanted + 0.002
        assert errors.max < 0.05
    assert len(poses) == len(updates)
    assert compute_absolute_errors(poses, np.repeat(true, 2, axis=0)).rmse < 0.01
    says, moves = np.concatenate(says), np.concatenate(moves)
    assert 2 * (says & moves).sum() / (says.sum() + moves.sum()) > 0.85
