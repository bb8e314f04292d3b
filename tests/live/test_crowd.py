"""People who walk along with the robot are noticed, and do not take its map along."""

import math
from dataclasses import replace

import numpy as np
import pytest
from live_runs import answers, poses_of

from stillmap.live.front_end import Crowd
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate

STEP, PERIOD_NS = 0.1, 200_000_000
ROOM = np.stack(np.meshgrid(np.arange(-3.0, 30.0, 0.7), [-3.1, -2.2, 2.4, 3.3]), axis=-1).reshape(
    -1, 2
)
BESIDE = np.random.default_rng(3).uniform([0.5, -1.5], [2.5, 1.5], (40, 2))


def drive(crowd, scans, *, companions, speed=1.0):
    """Scans of posts in a room, while odometry says STEP a scan."""
    increment = np.eye(3)
    increment[0, 2] = STEP
    rng = np.random.default_rng(0)
    for t in range(scans):
        posts = ROOM - [speed * STEP * t, 0.0]
        posts = posts[np.hypot(*posts.T) < 6.0]
        points = np.concatenate([posts, BESIDE]) if companions else posts
        noisy = (points + rng.normal(0.0, 0.01, points.shape)).astype(np.float32)
        crowd.observe(noisy, None if t == 0 else increment, t * PERIOD_NS)
    return crowd


def test_people_who_walk_along_are_noticed():
    assert drive(Crowd(), 40, companions=True).walks_along
    assert not drive(Crowd(), 40, companions=False).walks_along


def test_wheels_that_spin_are_no_crowd():
    assert not drive(Crowd(), 40, companions=False, speed=0.0).walks_along
    assert not drive(Crowd(), 40, companions=True, speed=0.0).walks_along


def test_hits_on_the_robot_are_no_crowd():
    on_it = np.tile([[0.2, 0.3], [0.2, -0.3]], (20, 1))
    crowd = Crowd()
    increment = np.eye(3)
    increment[0, 2] = STEP
    for t in range(40):
        posts = ROOM - [STEP * t, 0.0]
        points = np.concatenate([posts[np.hypot(*posts.T) < 6.0], on_it]).astype(np.float32)
        crowd.observe(points, increment, t * PERIOD_NS)
    assert not crowd.walks_along


def surrounded(recording, count, first):
    """The recording with people 0.7 to 2.5 m around the robot from a scan on."""
    rng = np.random.default_rng(4)
    bearing, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.7, 2.5, count)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    points, hit = recording.points.copy(), recording.hit.copy()
    for t in range(first, recording.n_scans):
        angle = bearing + 0.15 * np.sin(0.1 * t + phase[0])
        away = distance + 0.15 * np.sin(0.07 * t + phase[1])
        beams = recording.beams_of(t)
        length = np.linalg.norm(points[beams], axis=1)
        direction = points[beams] / length[:, None]
        centres = away * np.stack([np.cos(angle), np.sin(angle)])
        along = direction @ centres
        off2 = away**2 - along**2
        meets = (along > 0.0) & (off2 < 0.04)
        reach = np.where(meets, along - np.sqrt(np.maximum(0.04 - off2, 0.0)), np.inf).min(axis=1)
        nearer = reach < length
        points[beams][nearer] = direction[nearer] * reach[nearer, None]
        hit[beams][nearer] = True
    return replace(recording, points=points, hit=hit)


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_the_map_stays_where_visitors_surround_the_robot(seed):
    changes = {"robot": {"scans": 300}, "laser": {"max_range": 8.0, "fov": math.pi}}
    simulation = simulate(scene_by_name("hall", {**changes, "crowd": {"people": 0}}), seed)
    recording = surrounded(simulation.recording, 20, 50)
    poses = poses_of(answers(recording))
    true = simulation.truth.T_world_base
    off = compute_absolute_errors(poses, true).rmse
    assert off < 0.3
    assert off < 1.5 * compute_absolute_errors(recording.T_odom_base, true).rmse + 0.1
