"""What the front end in 2D knows beside the scans: people who walk along, directions of walls."""

import math
from dataclasses import replace

import numpy as np
import pytest
from live_runs import answers, poses_of

from stillmap.core import se2
from stillmap.live.registration import Crowd
from stillmap.live.scan_odometry import WallDirections, correct_heading
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate
from stillmap.slam.heading_alignment import HeadingOffset
from stillmap.slam.scan_hits import Scan

STEP, PERIOD_NS = 0.1, 200_000_000
ROOM = np.stack(np.meshgrid(np.arange(-3.0, 30.0, 0.7), [-3.1, -2.2, 2.4, 3.3]), axis=-1).reshape(
    -1, 2
)
BESIDE = np.random.default_rng(3).uniform([0.5, -1.5], [2.5, 1.5], (40, 2))


ON_IT = np.tile([[0.2, 0.3], [0.2, -0.3]], (20, 1))  # hits on the robot


@pytest.mark.parametrize(
    ("along", "speed", "walks_along"),
    [(BESIDE, 1.0, True), (ON_IT, 1.0, False), (None, 1.0, False), (None, 0.0, False)],
)
def test_people_who_walk_along_are_noticed(along, speed, walks_along):
    """Scans of posts in a room, while odometry says STEP a scan; at speed 0 wheels spin."""
    crowd, increment, rng = Crowd(), np.eye(3), np.random.default_rng(0)
    increment[0, 2] = STEP
    for t in range(40):
        posts = ROOM - [speed * STEP * t, 0.0]
        posts = posts[np.hypot(*posts.T) < 6.0]
        points = posts if along is None else np.concatenate([posts, along])
        noisy = (points + rng.normal(0.0, 0.01, points.shape)).astype(np.float32)
        crowd.observe(noisy, None if t == 0 else increment, t * PERIOD_NS)
    assert crowd.walks_along == walks_along


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


def look(normals_deg, weight=1.0):
    """A scan of flat surfaces whose normals have these directions in its frame."""
    angles = np.radians(normals_deg)
    n = len(angles)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    flat = np.zeros(n, np.float32)
    return Scan(
        np.zeros_like(normals),
        np.full(n, weight, np.float32),
        np.eye(3),
        normals,
        flat,
        np.ones(n, np.float32),
    )


def rectangular(rng, count=120, off=0.0):
    return rng.choice([0.0, 90.0, 180.0, 270.0], count) + off + rng.normal(0.0, 1.0, count)


def turned(degrees):
    return se2.matrix(0.0, 0.0, np.radians(degrees))


@pytest.fixture
def walls():
    """Of a rectangular building, 17 degrees off the axes of the frame."""
    found, rng = WallDirections(), np.random.default_rng(0)
    for _ in range(40):
        found.add(look(rectangular(rng)), turned(17.0), 0.5)
    return found


@pytest.mark.parametrize("heading", [17.0, 107.0, -73.0])
@pytest.mark.parametrize("error", [-1.5, 0.0, 0.4, 2.0])
def test_the_heading_follows_walls_that_were_never_seen(walls, heading, error):
    scan = look(rectangular(np.random.default_rng(1)))
    offset = walls.measure(scan, turned(heading + error))
    assert np.degrees(offset.value) == pytest.approx(-error, abs=0.3)
    assert 0.2 < np.degrees(np.sqrt(offset.variance)) < 1.0


def test_walls_at_another_angle_say_nothing(walls):
    scan = look(rectangular(np.random.default_rng(1), off=30.0))
    assert walls.measure(scan, turned(17.0)) is None


def test_a_heading_takes_the_position_along():
    covariance = np.array([[0.04, 0.0, 0.01], [0.0, 0.04, 0.0], [0.01, 0.0, 0.01]])
    T = correct_heading(np.eye(3), covariance, HeadingOffset(0.1, 0.01))
    np.testing.assert_allclose(se2.parameters(T), [0.05, 0.0, 0.05], atol=1e-12)
