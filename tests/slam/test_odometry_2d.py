"""Incremental scan matching of whole recordings, down to empty ones."""

import dataclasses

import numpy as np
import pytest
from driven import ate, prior, silent
from marks import slow_params
from rooms import drive

from stillmap import _core, em
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import SlamOptions, m_step, odometry_2d

OPTIONS = SlamOptions()
ALL_ROUND = {"beams": 240, "fov": 2 * np.pi, "range_noise": 0.005, "max_range": 8.0}


def build(recording, e=None):
    e = prior(recording) if e is None else e
    return odometry_2d.register_scans(recording, e, OPTIONS, silent)


def small_room(laser=None, scans=60, people=0):
    laser = laser or {"range_noise": 0.01, "max_range": 8.0}
    return drive(2, people=people, laser=laser, robot={"scans": scans})


def assert_poses(mapped):
    R = mapped.poses[:, :2, :2]
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(2), R.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    assert np.all(mapped.poses[:, 2] == [0, 0, 1])
    C = mapped.covariance[1:]
    np.testing.assert_allclose(C, C.transpose(0, 2, 1), atol=1e-15)
    assert np.linalg.eigvalsh(C).min() > 0


@pytest.mark.parametrize("scene", ["hall", "corridor"])
@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize(
    ("scans", "seed"), [(200, 3), *slow_params((1000, 0), (1000, 1), (1000, 2))]
)
def test_populated_places(scene, odometry, scans, seed):
    simulation = simulate(scene_by_name(scene, {"robot": {"scans": scans}}), seed)
    recording = simulation.recording
    mapped = build(recording if odometry else recording.without_odometry())
    assert_poses(mapped)
    assert ate(mapped, simulation.truth) < (0.02 if scans == 200 else 0.1)
    if scans > 200:
        return
    truth = se2.inverse(simulation.truth.T_world_base[0]) @ simulation.truth.T_world_base
    turn = se2.wrap(se2.parameters(mapped.poses)[:, 2] - se2.parameters(truth)[:, 2])
    assert np.abs(turn).max() < np.radians(1.0)


def test_the_map_frame_is_the_first_base():
    simulation = small_room()
    mapped = build(simulation.recording)
    np.testing.assert_array_equal(mapped.poses[0], np.eye(3))
    np.testing.assert_array_equal(mapped.covariance[0], np.zeros((3, 3)))
    assert np.sqrt(mapped.covariance[:, 0, 0].max()) < 0.1
    shift = se2.matrix(100.0, -50.0, 2.0)
    odometry = shift @ simulation.recording.T_odom_base
    moved = dataclasses.replace(simulation.recording, T_odom_base=odometry)
    # rounding may decide between two starts of a search: the same to less than a cell
    np.testing.assert_allclose(build(moved).poses, mapped.poses, atol=0.02)


def test_odometry_leap():
    # wheels slip: from scan 30 on odometry has turned by 80 degrees that nobody has turned
    simulation = small_room()
    T = simulation.recording.T_odom_base.copy()
    T[30:] = T[29] @ se2.matrix(0, 0, np.radians(80)) @ se2.inverse(T[29]) @ T[30:]
    mapped = build(dataclasses.replace(simulation.recording, T_odom_base=T))
    assert ate(mapped, simulation.truth) < 0.01


def test_what_covers_the_view_does_not_hold_the_robot():
    # somebody leans on the robot: many end points, on little surface
    simulation = small_room(ALL_ROUND)
    points = simulation.recording.points.copy()
    for t in range(20, 40):
        beams = simulation.recording.beams_of(t)
        covered = points[beams][: 2 * (beams.stop - beams.start) // 3]
        covered *= np.float32(0.3) / np.linalg.norm(covered, axis=1, keepdims=True)
    recording = dataclasses.replace(simulation.recording, points=points)
    assert ate(build(recording), simulation.truth) < 0.02


def test_known_movers_do_not_bias_poses():
    # everybody marches off with the robot: with e = 0 only walls count
    simulation = small_room(people=3)
    e = np.where(simulation.truth.mover >= 0, 0.0, 1.0).astype(np.float32)
    recording = simulation.recording
    ghosts = recording.points.copy()
    assert (e == 0.0).sum() > 50
    ghosts[e == 0.0] *= np.float32(0.5)  # wherever they are
    a, b = build(recording, e), build(dataclasses.replace(recording, points=ghosts), e)
    assert ate(a, simulation.truth) < 0.01
    # ghosts still cross cells: they may shift the last digits of a pose, no more
    distance = np.linalg.norm(a.poses[:, :2, 2] - b.poses[:, :2, 2], axis=1)
    assert distance.max() < 0.01


@pytest.mark.parametrize(("x", "y", "yaw"), [(-0.04, 0, np.pi), (0.3, 0, 0), (0.1, -0.2, -1.2)])
def test_sensor_extrinsics(x, y, yaw):
    # all round: wherever the sensor looks, it sees the same world
    a, b = small_room(ALL_ROUND | {"x": 0.0}), small_room(ALL_ROUND | {"x": x, "y": y, "yaw": yaw})
    np.testing.assert_array_equal(a.truth.T_world_base, b.truth.T_world_base)
    assert not np.array_equal(a.recording.points, b.recording.points)
    of_a, of_b = build(a.recording), build(b.recording)
    distance = np.linalg.norm(of_a.poses[:, :2, 2] - of_b.poses[:, :2, 2], axis=1)
    assert distance.max() < 0.01
    turn = se2.wrap(se2.parameters(of_a.poses)[:, 2] - se2.parameters(of_b.poses)[:, 2])
    assert np.abs(turn).max() < np.radians(0.3)
    assert ate(of_b, b.truth) < 0.01


def test_two_sensors_on_one_robot():
    # in turns, one turned round: each scan goes by its own sensor's place on the robot
    ahead, behind = {"x": 0.2}, {"x": -0.25, "yaw": np.pi}
    one, other = small_room(ALL_ROUND | ahead), small_room(ALL_ROUND | behind)
    sensor = (np.arange(60) % 2).astype(np.int32)
    of_beam = np.repeat(sensor, np.diff(one.recording.offset))
    both = dataclasses.replace(
        one.recording,
        points=np.where(of_beam[:, None] == 0, one.recording.points, other.recording.points),
        hit=np.where(of_beam == 0, one.recording.hit, other.recording.hit),
        T_base_sensor=np.concatenate([r.recording.T_base_sensor for r in (one, other)]),
        sensor=sensor,
    )
    assert ate(build(both), one.truth) < 0.01


def blank(recording: Recording, scans, how: str) -> Recording:
    """Some scans without a hit (all at maximum range), all unusable, or without any beam."""
    points, hit = recording.points.copy(), recording.hit.copy()
    gone = np.zeros(recording.n_beams, bool)
    for t in scans:
        gone[recording.beams_of(t)] = True
    hit[gone] = False
    if how == "unusable":
        points[gone] = np.nan
    if how != "no beams":
        return dataclasses.replace(recording, points=points, hit=hit)
    counts = np.diff(recording.offset)
    counts[list(scans)] = 0
    offset = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return dataclasses.replace(recording, points=points[~gone], hit=hit[~gone], offset=offset)


@pytest.mark.parametrize(
    ("how", "odometry"), [("no hits", True), ("unusable", False), ("no beams", True)]
)
def test_scans_without_hits_are_bridged(how, odometry):
    simulation = small_room()
    recording = blank(simulation.recording, [0, 20, 21, 59], how)
    mapped = build(recording if odometry else recording.without_odometry())
    assert_poses(mapped)
    assert ate(mapped, simulation.truth) < (0.01 if odometry else 0.1)


def test_constant_velocity_bridges_blind_scans():
    # straight ahead, 0.1 m from scan to scan
    simulation = small_room()
    truth = se2.inverse(simulation.truth.T_world_base[0]) @ simulation.truth.T_world_base
    np.testing.assert_allclose(truth[[10, 18], 0, 2], [1.0, 1.8], atol=0.01)
    blind = blank(simulation.recording, range(10, 19), "unusable").without_odometry()
    x = build(blind).poses[:, 0, 2]
    assert x[18] == pytest.approx(1.8, abs=0.3)
    assert x[19] == pytest.approx(1.9, abs=0.03)


@pytest.mark.parametrize("how", ["no hits", "unusable", "no beams"])
def test_only_scans_without_hits_leave_odometry(how):
    recording = blank(small_room(scans=10).recording, range(10), how)
    odometry = se2.inverse(recording.T_odom_base[0]) @ recording.T_odom_base
    np.testing.assert_allclose(build(recording).poses, odometry, atol=1e-9)
    still = build(recording.without_odometry()).poses
    np.testing.assert_allclose(still, np.broadcast_to(np.eye(3), still.shape), atol=1e-12)


def test_given_poses_are_not_touched():
    simulation = small_room(people=2)
    recording, poses = simulation.recording, simulation.truth.T_world_base
    e = np.random.default_rng(0).random(recording.n_beams).astype(np.float32)
    calls = []
    mapped = [
        m_step(recording, e, OPTIONS, poses, threads, lambda *at: calls.append(at))
        for threads in (1, 2)
    ]
    assert calls == [("matching scans", 60, 60)] * 2
    grid = _core.OccupancyGrid2D(OPTIONS.resolution)
    em.add_recording(grid, recording, poses, e)
    for one in mapped:
        assert one.poses is poses
        for ours, theirs in zip(one.grid.dense(), grid.dense(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
