"""Wheels that spin, and stretches in which only odometry says where the robot is."""

import math
from dataclasses import replace

import numpy as np
import pytest
from live_runs import answers, poses_of

from stillmap.core import se2
from stillmap.live.dead_reckoning import DeadReckoning
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

FIRST, SPINNING = 90, 20  # scans at 5 Hz
SPEED = 0.5  # m/s of wheels that spin


def spin(scene, times=1):
    """Scans, odometry and true poses of a robot that stands for some scans on its way.

    The laser is so many times faster than 5 Hz.
    """
    rate, total, first = 5 * times, 170 * times, FIRST * times
    changes = {
        "robot": {"scans": total, "scan_rate": rate},
        "laser": {"max_range": 8.0, "fov": math.pi},
        "crowd": {"people": 0},
    }
    simulation = simulate(scene_by_name(scene, changes), 5)
    step = se2.matrix(SPEED / rate, 0.0, 0.0)
    recording, rng = simulation.recording, np.random.default_rng(0)
    true, odometry = simulation.truth.T_world_base, recording.T_odom_base
    beams = list(iter_beams(recording))
    order = [*range(first), *[first] * SPINNING * times, *range(first + 1, total)]
    given, out = np.eye(3), []
    for n, k in enumerate(order):
        is_spinning = first < n < first + SPINNING * times
        if n:
            given = given @ (step if is_spinning else se2.inverse(odometry[k - 1]) @ odometry[k])
        noise = 0.002 * rng.normal(size=(len(beams[k].points), 1)) * is_spinning
        points = (beams[k].points * (1.0 + noise)).astype(np.float32)
        out.append((replace(beams[k], points=points, stamp_ns=n * 10**9 // rate), given))
    return out, true[order]


def follow(scans):
    """Poses and doubts at the time."""
    with LiveMapper({"threads": 1}) as mapper:
        updates = [mapper.push(*scan) for scan in scans]
    return poses_of(updates), [one.doubts for one in updates]


SCENES = [("office", 1), ("hall", 1), ("warehouse", 1), ("hall", 2), ("office", 4), ("hall", 8)]


@pytest.mark.parametrize(("scene", "times"), SCENES)
def test_wheels_that_spin_on_the_spot(scene, times):
    scans, true = spin(scene, times)
    assert compute_absolute_errors(np.array([T for _, T in scans]), true).rmse > 0.5
    poses, doubts = follow(scans)
    assert compute_absolute_errors(poses, true).rmse < 0.05
    slips = np.array(["slip" in of_scan for of_scan in doubts])
    assert slips[FIRST * times : (FIRST + SPINNING) * times].mean() > 0.7
    assert not slips[: FIRST * times].any()
    assert not slips[(FIRST + SPINNING + 3) * times :].any()


@pytest.mark.parametrize("scene", ["office", "corridor"])
def test_a_robot_that_drives_on_does_not_stand(scene):
    laser = {"max_range": 8.0, "fov": math.pi}
    simulation = simulate(scene_by_name(scene, {"robot": {"scans": 170}, "laser": laser}), 6)
    recording = simulation.recording
    assert recording.T_odom_base is not None
    assert not any("slip" in one.doubts for one in answers(recording))


def test_an_error_of_the_heading_grows_with_the_way():
    """Against many runs with a heading that is off from the start."""
    reckoning, rng = DeadReckoning(), np.random.default_rng(0)
    step = se2.matrix(0.1, 0.0, 0.01)
    noise = np.diag([1e-4, 1e-4, 4e-4])
    runs, pose = [np.eye(3)] * 2000, np.eye(3)
    for _ in range(60):
        after = pose @ step
        reckoning.move(pose, after, noise)
        shocks = rng.normal(size=(len(runs), 3)) * np.sqrt(np.diag(noise))
        runs = [
            one @ step @ se2.matrix(*shock)
            for one, shock in zip(runs, shocks.tolist(), strict=True)
        ]
        pose = after
    off = np.array([se2.parameters(one) - se2.parameters(pose) for one in runs])
    bias = np.square([0.03 * 6.0, 0.03 * 6.0, 0.01 * 6.0 + 0.02 * 0.6])
    expected = np.diag(np.cov(off.T)) + bias
    np.testing.assert_allclose(np.diag(reckoning.covariance), expected, rtol=0.15)
    assert reckoning.is_far
    reckoning.reset()
    assert not reckoning.is_far


def test_a_place_that_is_not_mapped_is_no_contradiction():
    """After a stretch without a return the robot sees, between people, what the map lacks."""
    changes = {
        "laser": {"beams": 180, "fov": 0.5 * math.pi, "max_range": 14.0},
        "crowd": {"people": 36},
        "robot": {"scans": 420},
    }
    simulation = simulate(scene_by_name("hall", changes), 1)
    recording, true = simulation.recording, simulation.truth.T_world_base
    hit = recording.hit.copy()
    hit[recording.beams_of(200).start : recording.beams_of(320).start] = False
    updates = answers(replace(recording, hit=hit))
    assert not any("carried" in one.doubts for one in updates)
    # of noise that was learned, not that of the options, which would be metres
    assert math.sqrt(updates[319].covariance[0, 0]) < 1.0
    poses = poses_of(updates)
    off = poses[-1] - se2.inverse(true[0]) @ true[-1]
    assert np.hypot(*off[:2, 2]) < 3.0 * math.sqrt(updates[319].covariance[:2, :2].trace())
    assert compute_absolute_errors(poses, true).rmse < 0.4


def test_the_robot_was_not_carried_while_it_saw_nothing():
    laser = {"beams": 120, "fov": math.pi, "max_range": 15.0}
    changes = {"laser": laser, "crowd": {"people": 0}, "robot": {"scans": 450}}
    simulation = simulate(scene_by_name("corridor", changes), 1)
    recording, true = simulation.recording, simulation.truth.T_world_base
    hit = recording.hit.copy()
    hit[recording.beams_of(150).start : recording.beams_of(250).start] = False
    # a heading that drifts while nothing is seen
    turn = se2.matrix(0.0, 0.0, 0.004)
    odometry = [recording.T_odom_base[0]]
    for before, after in zip(recording.T_odom_base[:-1], recording.T_odom_base[1:], strict=True):
        is_blind = 150 <= len(odometry) < 250
        odometry.append(
            odometry[-1] @ se2.inverse(before) @ after @ (turn if is_blind else np.eye(3))
        )
    updates = answers(replace(recording, hit=hit, T_odom_base=np.array(odometry)))
    poses, doubts = poses_of(updates), [one.doubts for one in updates]
    assert all("blind" in one for one in doubts[150:250])
    assert not any("carried" in one for one in doubts)
    assert doubts[-1] == ()
    assert compute_absolute_errors(poses[:150], true[:150]).rmse < 0.1
    assert compute_absolute_errors(poses[300:], true[300:]).rmse < 0.2
