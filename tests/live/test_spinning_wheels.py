"""Wheels that spin while the robot stands: the scans say that it does, and live mapping follows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from live_runs import answers, poses_of

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.odometry_faults import standing_prior
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

FIRST, SPINNING, PERIOD_NS = 90, 20, 200_000_000
STEP = se2.matrix(0.1, 0.0, 0.0)


def spin(scene, changes):
    """Scans, odometry and true poses of a robot that stands for some scans on its way."""
    laser = {"max_range": 8.0, "fov": math.pi}
    simulation = simulate(
        scene_by_name(scene, {"robot": {"scans": 170}, "laser": laser, **changes}), 5
    )
    recording, rng = simulation.recording, np.random.default_rng(0)
    true, odometry = simulation.truth.T_world_base, recording.T_odom_base
    beams = list(iter_beams(recording))
    order = [*range(FIRST), *[FIRST] * SPINNING, *range(FIRST + 1, 170)]
    given, out = np.eye(3), []
    for n, k in enumerate(order):
        is_spinning = FIRST < n < FIRST + SPINNING
        if n:
            given = given @ (STEP if is_spinning else se2.inverse(odometry[k - 1]) @ odometry[k])
        noise = 0.002 * rng.normal(size=(len(beams[k].points), 1)) * is_spinning
        points = (beams[k].points * (1.0 + noise)).astype(np.float32)
        out.append((replace(beams[k], points=points, stamp_ns=n * PERIOD_NS), given))
    return out, true[order]


def follow(scans):
    """Poses and doubts at the time."""
    with LiveMapper({"threads": 1}) as mapper:
        updates = [mapper.push(*scan) for scan in scans]
    return poses_of(updates), [one.doubts for one in updates]


@pytest.mark.parametrize("scene", ["office", "hall", "warehouse"])
def test_wheels_that_spin_on_the_spot(scene):
    scans, true = spin(scene, {"crowd": {"people": 0}})
    by_odometry = np.array([T for _, T in scans])
    assert compute_absolute_errors(by_odometry, true).rmse > 0.5
    poses, doubts = follow(scans)
    assert compute_absolute_errors(poses, true).rmse < 0.1
    assert sum("slip" in one for one in doubts[FIRST : FIRST + SPINNING + 5]) > SPINNING // 2
    assert not any("slip" in one for one in doubts[FIRST + SPINNING + 10 :])


@pytest.mark.parametrize("scene", ["office", "corridor"])
def test_a_robot_that_drives_on_does_not_stand(scene):
    laser = {"max_range": 8.0, "fov": math.pi}
    simulation = simulate(scene_by_name(scene, {"robot": {"scans": 170}, "laser": laser}), 6)
    recording = simulation.recording
    assert recording.T_odom_base is not None
    assert not any("slip" in one.doubts for one in answers(recording))


def test_the_standing_robot_is_free_to_move_on():
    prior = standing_prior(se2.matrix(1.0, 2.0, 0.5), se2.matrix(0.3, 0.4, -0.2))
    np.testing.assert_allclose(prior.T_map_base, se2.matrix(1.0, 2.0, 0.5))
    assert prior.translation_std == pytest.approx(0.5)
    assert prior.rotation_std == pytest.approx(0.2)
    assert not prior.is_odometry
    assert standing_prior(np.eye(3), np.eye(3)).translation_std > 0.0
