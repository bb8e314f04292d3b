"""Recordings of a spinning lidar: truth of each point, time within a turn, options, files."""

import functools

import numpy as np
import pytest

from stillmap.sim import scene_by_name, simulate
from stillmap.sim.geometry import make_pose

EXACT = {"range_noise": 0.0, "no_return_share": 0.0}
SMALL = {"channels": 16, "columns": 360}


@functools.cache
def street(sweep=True):
    lidar = {**SMALL, **EXACT, "channels": 32, "columns": 720, "sweep": sweep}
    return simulate(scene_by_name("street", {"lidar": lidar, "robot": {"scans": 12}}), 3)


def in_world(run, times=True):
    """Ends of all beams at the true poses of their times, the scan of each, and when in it."""
    recording, rate = run.recording, run.scene.scan_rate
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))
    T = run.truth.T_world_base
    later = np.zeros(len(scan))
    if times and recording.beam_time is not None:
        later = recording.beam_time.astype(float) * rate
    R, last = T[:, :3, :3].transpose(1, 2, 0), len(T) - 1
    angles = [np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])]
    parameters = np.concatenate([T[:, :3, 3].T, np.unwrap(angles, axis=1)])
    now = parameters[:, scan] * (1 - later)
    now += parameters[:, np.minimum(scan + 1, last)] * later
    poses = make_pose(now[:3].T, *now[3:]) @ recording.T_base_sensor[0]
    ends = np.einsum("nij,nj->ni", poses[:, :3, :3], recording.points.astype(float))
    return ends + poses[:, :3, 3], scan, later


def test_the_recording_is_in_3d_and_says_when_beams_were_taken():
    run = street()
    recording, truth = run.recording, run.truth
    assert recording.dimension == 3
    assert recording.n_beams == 12 * 32 * 720
    assert truth.T_world_base.shape == (12, 4, 4)
    np.testing.assert_array_equal(recording.T_odom_base[:, 2, 3], 0.0)
    assert recording.T_base_sensor[0, 2, 3] == 1.8
    assert np.diff(recording.stamp_ns).tolist() == [100_000_000] * 11
    times = recording.beam_time[: 32 * 720].reshape(720, 32)
    np.testing.assert_allclose(times, np.tile(np.arange(720)[:, None] / 7200, 32), atol=1e-6)
    far = np.linalg.norm(recording.points[~recording.hit], axis=1)
    np.testing.assert_allclose(far, 100.0, rtol=1e-6)


def test_static_points_of_a_street_lie_on_what_its_plan_and_its_heights_say():
    run = street()
    ends, scan, _ = in_world(run)
    use = run.truth.static & (scan < 11)
    x, y, z = ends[use].T
    assert use.sum() > 100_000
    road = (np.abs(y) < 5.9) & (x > -29) & (x < 209)
    np.testing.assert_allclose(z[road & (z < 1)], 0.0, atol=1e-4)
    front = (np.abs(y) > 9.5) & (x > -29) & (x < 209)
    assert z[front].min() > 0.12 - 1e-4
    assert z.max() < 9.0 + 1e-4
    # trunks stand, crowns hang
    assert (z > 2.3).sum() > 1000


@pytest.mark.parametrize("kind", ["car", "person"])
def test_points_of_movers_lie_on_them_at_the_time_of_the_beam(kind):
    run = street()
    ends, scan, later = in_world(run)
    kinds = np.array(run.truth.scene["mover_kinds"])
    mover = run.truth.mover
    hit = np.flatnonzero((mover >= 0) & (kinds[mover] == kind) & (scan < 11))
    assert len(hit) > 100
    n, share = np.arange(len(hit)), later[hit, None]
    at = run.truth.movers[:, mover[hit], :]
    now = at[scan[hit], n] * (1 - share) + at[scan[hit] + 1, n] * share
    off = ends[hit, :2] - now[:, :2]
    c, s = np.cos(now[:, 2]), np.sin(now[:, 2])
    ahead, aside = off[:, 0] * c + off[:, 1] * s, off[:, 1] * c - off[:, 0] * s
    sizes = run.truth.scene["mover_sizes"]
    tall = np.array([sizes[m][2] for m in mover[hit].tolist()])
    assert (ends[hit, 2] < tall + 0.12 + 1e-3).all()
    if kind == "car":
        half = np.array([sizes[m][:2] for m in mover[hit].tolist()]) / 2 + 0.01
        assert (np.abs(ahead) < half[:, 0]).all()
        assert (np.abs(aside) < half[:, 1]).all()
    else:
        assert np.hypot(ahead, aside).max() < 0.6
        # they walk on the pavement; legs, torso and head
        assert (ends[hit, 2] - tall).max() > 0.12 - 0.1
        assert (ends[hit, 2] > 1.5).any()
        assert (ends[hit, 2] < 0.7).any()


def test_a_wall_is_straight_once_the_turn_is_undone(yard):
    shaking = {"vibration_roll": 0.01, "vibration_pitch": 0.01, "vibration_z": 0.02}
    run = yard(robot={"scans": 40}, lidar={**SMALL, **EXACT, "low": -0.5, "high": 0.5, **shaking})
    for times, worst in ((True, 1e-3), (False, np.inf)):
        ends, scan, _ = in_world(run, times)
        use = run.recording.hit & (scan < run.recording.n_scans - 1)
        x, y, z = np.abs(ends[use] - [0, 0, 1.4]).T
        walls = np.minimum(np.abs(x - 7), np.abs(y - 5))
        off = np.minimum(walls, np.abs(z - 1.4))
        around = np.hypot(ends[use, 0] - 0.5, ends[use, 1] - 0.3) < 0.65
        around |= np.hypot(ends[use, 0] + 3, ends[use, 1] - 2.5) < 0.25
        assert off[~around].max() < worst
    assert np.quantile(off[~around], 0.95) > 0.05


@pytest.mark.slow
def test_the_robot_stands_on_the_slope_and_shakes():
    lidar = {**SMALL, "vibration_roll": 0.01, "vibration_pitch": 0.02, "vibration_z": 0.03}
    ground = {"slope_x": 0.05}
    scene = scene_by_name("street", {"lidar": lidar, "ground": ground, "robot": {"scans": 80}})
    T = simulate(scene, 1).truth.T_world_base
    level = 0.05 * T[:, 0, 3]
    assert np.std(T[:, 2, 3] - level) == pytest.approx(0.03, rel=0.3)
    nose = np.arcsin(T[:, 2, 0]) - np.arctan(0.05)
    assert np.std(nose) == pytest.approx(0.02, rel=0.3)
    assert np.std(np.arctan2(T[:, 2, 1], T[:, 2, 2])) == pytest.approx(0.01, rel=0.3)
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (80, 1, 1)), atol=1e-12
    )


def test_beams_without_return_may_be_left_out(yard):
    lidar = {**SMALL, **EXACT, "max_range": 6.0}
    kept, left_out = (
        yard(people=4, robot={"scans": 40}, lidar={**lidar, "no_returns": how})
        for how in ("kept", "left out")
    )
    assert left_out.recording.hit.all()
    use = kept.recording.hit
    assert 0 < use.sum() < len(use)
    np.testing.assert_array_equal(kept.recording.points[use], left_out.recording.points)
    np.testing.assert_array_equal(kept.truth.mover[use], left_out.truth.mover)
    np.testing.assert_array_equal(kept.truth.static[use], left_out.truth.static)


def test_the_robot_itself_is_neither_static_nor_a_mover(yard):
    lidar = {**SMALL, **EXACT, "low": -1.3, "high": 0.2}
    without, run = (
        yard(people=4, robot={"scans": 40}, lidar={**lidar, "sees_robot": sees})
        for sees in (False, True)
    )
    own = run.truth.mover == -2
    assert 0.02 < own.mean() < 0.6
    assert not run.truth.static[own].any()
    x, y, z = run.recording.points[own].T
    assert np.abs(x).max() <= 0.22 + 1e-6
    assert np.abs(y).max() <= 0.22 + 1e-6
    np.testing.assert_allclose(z, -0.35, atol=1e-6)
    np.testing.assert_array_equal(run.recording.points[~own], without.recording.points[~own])


@pytest.mark.slow
def test_doors_have_lintels_and_rooms_have_ceilings():
    lidar = {**EXACT, "channels": 32, "columns": 360, "low": -0.5, "high": 0.5}
    run = simulate(scene_by_name("office", {"lidar": lidar, "robot": {"scans": 60}}), 3)
    assert run.recording.hit.mean() > 0.95  # glass loses some
    ends, scan, _ = in_world(run)
    use = run.recording.hit & (scan < 59)
    assert ends[use, 2].min() > -1e-4
    assert ends[use, 2].max() == pytest.approx(2.8, abs=1e-4)
    kinds = np.array(run.truth.scene["mover_kinds"])
    leaf = use & (run.truth.mover >= 0) & (kinds[run.truth.mover] == "door")
    assert leaf.sum() > 50
    assert ends[leaf, 2].max() < 2.05 + 1e-4
