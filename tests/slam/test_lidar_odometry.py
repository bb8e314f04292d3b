"""Lidar odometry against truth."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import Boxes, Lidar, Way, recorded
from driven import silent

from stillmap.core import se2, se3
from stillmap.results.eval.trajectory import compute_absolute_errors, compute_relative_errors
from stillmap.slam import constant_velocity, lidar_odometry
from stillmap.slam.options import OdometryOptions

ROOM = [
    [0.0, 0.0, 1.0, 16.0, 11.0, 3.2, 0, 0, 0],
    [4.0, 3.0, 0.2, 1.5, 1.0, 1.4, 0, 0, 0],
    [-3.0, -3.5, 0.4, 1.0, 1.2, 1.8, 0, 0, 0],
]
PEOPLE = [[-5.0 + 2.0 * k, 1.8 * (-1) ** k, 0.3, 0.8, 0.9, 1.8, 0.9, 0, 0] for k in range(5)]
SPARSE = Lidar(rings=16, columns=180)


def wobbling(sweeps, speed=0.8, turn=0.5):
    """A way that speeds up, slows down, turns and tilts."""
    t = 0.02 * np.arange(5 * (sweeps + 25))
    twists = np.zeros((len(t), 6))
    twists[:, 0] = speed * (1.0 + 0.5 * np.sin(1.3 * t))
    twists[:, 3], twists[:, 4] = 0.15 * np.sin(2.0 * t), 0.1 * np.cos(3.0 * t)
    twists[:, 5] = turn * np.cos(1.1 * t)
    return Way(np.eye(4), twists, 0.02)


def built(recording, e=None, **more):
    e = np.ones(recording.n_beams, np.float32) if e is None else e
    options = OdometryOptions()
    return lidar_odometry.register_sweeps(recording, e, options, silent, threads=1, **more)


def error(found, truth):
    return compute_absolute_errors(found.poses, truth).rmse


@pytest.fixture(scope="module")
def room():
    return recorded(Boxes.of(ROOM + PEOPLE), SPARSE, wobbling(30), 30, seed=1)


def test_poses_and_motion_in_a_room(room):
    recording, truth, e = room
    found = built(recording, e)
    assert error(found, truth) < 0.01
    relative = compute_relative_errors(found.poses, truth, 1, "frames")
    assert relative.translation.rmse < 0.01
    assert relative.rotation.rmse < 0.2  # degrees
    true_twists = se3.log(se2.inverse(truth[:-1]) @ truth[1:]) / 0.1
    assert np.abs(found.twists[1:-1] - true_twists[1:]).max() < 0.25
    assert found.explained[1:].min() > 0.5


def test_movers_do_not_bias_poses():
    """In a convoy of lorries, with two towers beside the road: without e the robot stands still."""
    rows = [[0.0, 0.0, -2.0, 200.0, 200.0, 0.8, 0, 0, 0]]
    rows += [[x, y, 5.0, 3.0, 3.0, 14.0, 0, 0, 0] for x, y in ((-14, 9), (14, -9))]
    convoy = ((0.5, 3.0), (-0.5, -3.0), (9, 0), (-9, 0))
    rows += [[x, y, 0.0, 6.0, 2.2, 2.6, 0.8, 0, 0] for x, y in convoy]
    lidar = Lidar(rings=16, columns=360)
    recording, truth, e = recorded(Boxes.of(rows), lidar, wobbling(25, turn=0.0), 25, seed=2)
    assert 0.5 < 1.0 - e.mean() < 0.8
    known, unknown = (error(built(recording, x), truth) for x in (e, None))
    assert known < 0.02
    assert unknown > 0.3


def test_beam_times_are_used(room):
    """Without them the same sweeps are bent by as much as the robot moves during one."""
    recording, truth, e = room
    bent = built(replace(recording, beam_time=None), e)
    straight = built(recording, e)
    errors = [
        compute_relative_errors(f.poses, truth, 1, "frames").rotation.rmse for f in (bent, straight)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_another_base_frame_moves_the_poses(room):
    """T_map_base of another base on the same robot: X T X^-1, up to what other cells make."""
    recording, _, e = room
    X = se3.exp(np.array([0.5, -0.2, 0.4, 0.1, -0.2, 0.7]))
    moved = replace(recording, T_base_sensor=X @ recording.T_base_sensor)
    expected = X @ built(recording, e).poses @ se2.inverse(X)
    apart = se3.log(se2.inverse(expected) @ built(moved, e).poses)
    assert np.abs(apart[:, :3]).max() < 0.02
    assert np.abs(apart[:, 3:]).max() < np.radians(0.3)


def test_a_bare_corridor():
    """Nothing says how far along it; odometry helps, everything else is known."""
    corridor = Boxes.of([[0.0, 0.0, 1.0, 400.0, 2.6, 3.0, 0, 0, 0]])
    recording, truth, e = recorded(corridor, SPARSE, wobbling(25, turn=0.0), 25, seed=4)
    found = built(recording, e)
    sigma = np.sqrt(np.diagonal(found.covariance[12]))
    assert sigma[0] > 5.0 * max(sigma[1], sigma[2])
    with_odometry = replace(recording, T_odom_base=np.ascontiguousarray(truth))
    assert error(built(with_odometry, e), truth) < 0.6 * error(found, truth)


def test_odometry_gate():
    state = constant_velocity.initial_state(np.array([1.0, 0, 0, 0, 0, 0]), 0.2, 0.2)
    options = OdometryOptions()
    leap = se3.exp(np.array([3.0, 0, 0, 0, 0, 0]))
    assert constant_velocity.update_with_odometry(state, leap, 0.1, options) is state
    true = constant_velocity.update_with_odometry(
        state, se3.exp(np.array([0.12, 0, 0, 0, 0, 0])), 0.1, options
    )
    assert 1.0 < true.twist[0] < 1.2


def test_empty_sweeps(room):
    recording, truth, e = room
    gone = recording.hit.copy()
    gone[recording.beams_of(15)] = False
    found = built(replace(recording, hit=gone), e)
    assert error(found, truth) < 0.02
    assert found.explained[15] == 0.0
    nothing = built(replace(recording, hit=np.zeros_like(gone)), e)
    assert np.abs(nothing.poses - np.eye(4)).max() < 1e-9


@pytest.mark.parametrize(
    ("later", "metres"),
    [
        # a robot that drove is not looked for where it would be a year later
        (np.where(np.arange(30) > 15, 3 * 10**16, 0), 0.02),
        # the second to the fourth sweep a nanosecond after each other
        (np.concatenate([[0], np.arange(1, 4) * (1 - 10**8), np.zeros(26, np.int64)]), 0.1),
    ],
)
def test_pauses_and_stamps_nearly_at_once(room, later, metres):
    recording, truth, e = room
    found = built(replace(recording, stamp_ns=recording.stamp_ns + later), e)
    assert error(found, truth) < metres


def test_fewer_points_find_the_same_way(room):
    recording, truth, e = room
    sweep = lidar_odometry.select_sweep(recording, e, 3)
    assert len(lidar_odometry.downsample_sweep(sweep).points) > 300
    assert len(lidar_odometry.downsample_sweep(sweep, 300).points) <= 300
    assert error(built(recording, e, max_points=300), truth) < 0.02
