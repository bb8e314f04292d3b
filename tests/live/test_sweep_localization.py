"""A lidar in a known map in 3D: found from anywhere, tracked in a crowd, found again; or lost."""

from dataclasses import replace

import numpy as np
import pytest
from live_runs import simulate_sweeps

import stillmap
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.live.known_cloud import KnownCloud
from stillmap.live.known_map import KnownMap
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

LIDAR = {"channels": 16, "columns": 240}
FIRST = 60  # sweep at which the robot is switched on


def run_through_hall(seed, people, scans):
    changes = {"lidar": LIDAR, "robot": {"scans": scans, "speed": 2.0}, "crowd": {"people": people}}
    return simulate(scene_by_name("hall", changes), seed)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """The result of a run through the hall, and T_map_world."""
    simulation = run_through_hall(1, 4, 130)
    folder = tmp_path_factory.mktemp("place") / "hall"
    changes = {"threads": 1, "em.max_iterations": 1, "objects.enabled": False}
    T_map_world = se2.inverse(simulation.truth.T_world_base[0])
    poses = T_map_world @ simulation.truth.T_world_base
    stillmap.build(simulation.recording, changes, poses=poses).save(folder)
    return folder, T_map_world


@pytest.fixture(scope="module")
def drive(place):
    """A drive through a crowd, and then from an earlier place again: updates, m off in hindsight
    and at the time, mapper, sweeps."""
    folder, T_map_world = place
    simulation = run_through_hall(2, 20, 95)
    order = [*range(FIRST, 95), *range(10, 45)]
    every = list(iter_beams(simulation.recording))
    sweeps = [replace(every[t], stamp_ns=10**8 * k) for k, t in enumerate(order)]
    true = T_map_world @ simulation.truth.T_world_base[order]
    with LiveMapper({"threads": 1}, place=folder) as mapper:
        updates = [mapper.push(one) for one in sweeps]
        given = np.array([one.pose for one in updates])
        yield updates, errors(mapper.poses, true), errors(given, true), mapper, sweeps


def errors(poses, true):
    return np.linalg.norm((poses - true)[:, :3, 3], axis=1)


def is_lost(updates):
    return np.array(["lost" in one.doubts for one in updates])


def test_it_is_found_without_a_prior_and_tracked_in_a_crowd(drive):
    updates, _, off, _, _ = drive
    lost = is_lost(updates)[:35]
    found = int(np.argmin(lost))
    assert found < 30
    assert lost[:found].all()
    assert not lost[found:].any()
    assert off[found:35].max() < 0.2
    assert off[:found].min() > 1.0  # until then in a frame of its own
    assert updates[found].covariance.shape == (6, 6)


def test_it_is_found_again_when_it_was_carried(drive):
    updates, _, off, _, _ = drive
    lost = is_lost(updates)
    carried = next(k for k, one in enumerate(updates) if "carried" in one.doubts)
    assert 35 <= carried < 43
    found = carried + int(np.argmin(lost[carried:]))
    assert carried < found < carried + 30
    assert not lost[found:].any()
    assert off[found:].max() < 0.2


def test_in_hindsight_all_poses_are_in_the_map(drive):
    _, off, _, mapper, sweeps = drive
    unknown = np.flatnonzero(np.isnan(off))  # while it was not clear that it was carried
    assert 0 < len(unknown) < 12
    assert unknown.min() > 28
    assert unknown.max() < 43
    assert np.nanmax(off) < 0.25
    labels = mapper.label(sweeps[0], 0)
    np.testing.assert_array_equal(labels, mapper._slam.labels.label(sweeps[0], mapper.poses[0]))


def test_map_and_result_are_in_the_frame_of_the_known_map(drive, tmp_path):
    mapper = drive[3]
    assert (mapper.map.p_occupied > 0.65).sum() > 500
    assert np.all(np.array(mapper.map.p_occupied.shape) * mapper.map.resolution > 15.0)
    mapper.save(tmp_path / "out")
    poses = mapper.poses
    known = np.isfinite(poses).all(axis=(1, 2))
    np.testing.assert_allclose(stillmap.load(tmp_path / "out").poses, poses[known], atol=1e-6)


@pytest.mark.slow
def test_elsewhere_it_stays_lost(place):
    corridor = simulate_sweeps("corridor", 30)
    with LiveMapper({"threads": 1}, place=place[0]) as mapper:
        assert all("lost" in mapper.push(one).doubts for one in iter_beams(corridor.recording))
        assert not np.isfinite(mapper.poses).any()
        assert mapper.map.p_occupied.size > 0


def test_sweeps_need_a_map_in_space(tmp_path):
    beams = next(iter_beams(run_through_hall(1, 0, 1).recording))
    flat = simulate(scene_by_name("hall", {"robot": {"scans": 20}}), 1)
    stillmap.build(flat.recording, {"em.max_iterations": 1}).save(tmp_path / "flat")
    with (
        LiveMapper(place=tmp_path / "flat") as mapper,
        pytest.raises(InputError, match=r"static\.ply"),
    ):
        mapper.push(beams)


def test_what_is_known_of_voxels(place):
    cloud = KnownCloud(place[0], KnownMap(place[0]))
    assert 0.5 <= cloud.p_static.min() <= cloud.p_static.max() <= 1.0
    cells, is_surface = cloud.find_voxels(0.15, (0.2, 1.8))
    assert len(np.unique(cells[is_surface], axis=0)) == is_surface.sum() > 1000
    free = (cells[~is_surface] + 0.5) * 0.15
    assert len(free) > 10_000
    off_route = np.linalg.norm(free[:, None, :2] - cloud.poses[None, ::20, :2, 3], axis=2)
    height = free[off_route.min(axis=1) < 3.0, 2]
    assert 0.2 < height.min() < 0.4  # the floor lies at 0
    assert 1.5 < height.max() < 1.8


def test_where_nothing_stands_there_is_nothing_to_search(place):
    sky = stillmap.Scan(0, points=np.random.default_rng(0).uniform(5.0, 9.0, (400, 3)))
    with LiveMapper({"threads": 1}, place=place[0]) as mapper:
        update = mapper.push(sky)
    assert "lost" in update.doubts
    assert "ambiguous" not in update.doubts
