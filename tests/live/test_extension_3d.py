"""A map in 3D that is extended: what was known and is not seen again stays in it, what was taken
away does not, what is new comes in, and nobody who walked through."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rooms_3d import (
    AND_BACK,
    BOTH_ROOMS,
    CAME,
    DOOR,
    FIRST_ROOM,
    GONE,
    is_of,
    run_through_rooms,
    static_ends,
    to_world,
    true_poses,
)
from scipy.spatial import cKDTree

import stillmap
from stillmap.cli.main import main
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.em import OccupancyMap
from stillmap.io import stillmap_folder
from stillmap.io.point_cloud.ply import make_header, read_layout
from stillmap.live.known_cloud import KnownCloud
from stillmap.live.known_map import KeptMap, KnownMap, extend_map, write_extended_cloud
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import iter_beams
from stillmap.results.point_cloud import (
    FIELDS,
    Block,
    cloud_from_folder,
    coordinate_fields,
    make_vertices,
)

EDGE = 0.15  # m, of a voxel


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """The first run, and the folder of its map; the second run."""
    first = run_through_rooms(GONE, FIRST_ROOM, 70, 1)
    folder = tmp_path_factory.mktemp("rooms") / "known"
    options = {"threads": 1, "em.max_iterations": 1, "objects.enabled": False}
    stillmap.build(first.recording, options).save(folder)
    return first, folder, run_through_rooms(CAME, (*BOTH_ROOMS, *AND_BACK), 250, 101)


@pytest.fixture(scope="module")
def drive(rooms, tmp_path_factory):
    """The second run extends the map: mapper, updates, folder."""
    _, known, second = rooms
    folder = tmp_path_factory.mktemp("extended") / "out"
    options = {"threads": 1, "objects.enabled": False}
    with LiveMapper(options, place=known, mode="extend") as mapper:
        updates = [mapper.push(beams) for beams in iter_beams(second.recording)]
        mapper.save(folder)
        yield mapper, updates, folder


def read_cloud(folder):
    blocks = cloud_from_folder(folder, "static").iter_blocks()
    return np.concatenate([block.points for block in blocks])


def voxels(points):
    return (np.unique(np.floor(points / EDGE).astype(np.int64), axis=0) + 0.5) * EDGE


def share_near(points, others, most=EDGE):
    """Share of points that have one of the others near."""
    near = cKDTree(others).query(points, distance_upper_bound=most)[0]
    return float(np.isfinite(near).mean())


@pytest.mark.slow
def test_it_is_localized_beyond_the_known_map_and_back(rooms, drive):
    first, _, second = rooms
    _, updates, _ = drive
    lost = np.array(["lost" in one.doubts for one in updates])
    found = int(np.argmin(lost))
    assert found < 40
    assert not lost[found:].any()
    given, true = np.array([one.pose for one in updates]), true_poses(first, second)
    off = np.linalg.norm((given - true)[:, :3, 3], axis=1)
    x = second.truth.T_world_base[:, 0, 3]
    assert (x > DOOR + 5.0).sum() > 20
    assert off[found:].max() < 0.15
    assert x[-1] < DOOR
    assert off[-1] < 0.08


@pytest.mark.slow
def test_the_cloud_shows_old_and_new_in_one_frame_and_nobody(rooms, drive):
    first, known, second = rooms
    before, now = static_ends(first), static_ends(second)
    before = before[~is_of(before, GONE)]
    truth = np.concatenate([before, now])
    extended, was = (to_world(first, read_cloud(one)) for one in (drive[2], known))
    assert share_near(voxels(truth), extended) > 0.97
    assert share_near(voxels(truth), was) < 0.8
    assert share_near(voxels(extended), truth[::3], 0.25) > 0.995
    unseen = voxels(before)
    unseen = unseen[cKDTree(now[::3]).query(unseen)[0] > 0.3]
    assert len(unseen) > 200
    assert share_near(unseen, was) > 0.98
    assert share_near(unseen, extended) > 0.95


@pytest.mark.slow
def test_what_was_taken_away_is_gone_and_what_was_brought_is_there(rooms, drive):
    first, known, _ = rooms
    mapper, _, folder = drive
    clouds = {
        name: to_world(first, read_cloud(one)) for name, one in (("was", known), ("is", folder))
    }
    assert is_of(clouds["was"], GONE).sum() > 500
    assert is_of(clouds["is"], GONE).sum() == 0
    assert is_of(clouds["was"], CAME).sum() == 0
    assert is_of(clouds["is"], CAME).sum() > 500
    saved = stillmap.load(folder)
    for grid in (saved.map, mapper.map):
        occupied = occupied_of(first, grid)
        assert is_of(occupied, GONE).sum() <= 1
    occupied = occupied_of(first, saved.map)
    assert is_of(occupied, CAME).sum() > 10
    assert (occupied[:, 0] > DOOR + 5.0).sum() > 100
    assert is_of(occupied_of(first, stillmap.load(known).map), GONE).sum() > 50


def occupied_of(first, grid):
    """(N, 3) occupied cells of a map, half a metre high, in the world."""
    row, column = np.nonzero(grid.p_occupied > 0.65)
    xy = (np.stack([column, row], axis=1) + 0.5) * grid.resolution + grid.origin[:2]
    out = to_world(first, np.column_stack([xy, np.zeros(len(xy))]))
    out[:, 2] = 0.5
    return out


@pytest.mark.slow
def test_the_result_is_whole_and_converted_with_what_was_known(rooms, drive, tmp_path):
    """Of which its recording shows nothing."""
    mapper, updates, folder = drive
    saved, run = stillmap.load(folder), json.loads((folder / "run.json").read_text())
    np.testing.assert_allclose(saved.poses, mapper.poses, atol=1e-6)
    assert len(saved.poses) == len(updates) == run["counts"]["scans"]
    assert len(saved.p_static) == run["counts"]["beams"]
    assert run["input"]["extends_map"] is True
    assert saved.map.resolution == EDGE
    assert (folder / "live/trajectory.tum").is_file()
    stillmap_folder.write(rooms[2].recording, tmp_path / "in")
    words = ["convert", str(folder), "--input", str(tmp_path / "in"), "--only", "static", "-o"]
    assert main([*words, str(tmp_path / "out.ply")]) == 0
    assert read_layout(tmp_path / "out.ply").rows == read_layout(folder / "static.ply").rows


@pytest.mark.slow
def test_it_can_be_extended_again(rooms, drive):
    """Which then goes on from the route of both runs, though nobody drives the first one again."""
    before, once = (KnownCloud(one, KnownMap(one)) for one in (rooms[1], drive[2]))
    off = before.poses[:, None, :3, 3] - once.poses[None, :, :3, 3]
    assert np.linalg.norm(off, axis=2).min(axis=1).max() < 1.0
    kept = once.keep(None, 1.0, EDGE, (0.2, 1.8))
    assert len(kept.points) == len(once.points)
    assert len(kept.route) < len(once.poses)


@pytest.mark.slow
def test_it_is_found_again_in_what_was_added(rooms):
    """The robot is carried in the second room, which is not in the known map."""
    first, known, second = rooms
    every, true = list(iter_beams(second.recording)), true_poses(first, second)
    inside = np.flatnonzero(second.truth.T_world_base[:, 0, 3] > DOOR + 2.0)
    order = [*range(inside[-1] - 5), *range(inside[0] + 5, inside[0] + 40)]
    off, lost = [], []
    with LiveMapper({"threads": 1}, place=known, mode="extend") as mapper:
        for number, t in enumerate(order):
            update = mapper.push(replace(every[t], stamp_ns=10**8 * number))
            off.append(np.linalg.norm((update.pose - true[t])[:3, 3]))
            lost.append("lost" in update.doubts)
        kept = mapper.snapshot().kept_map
        shown = occupied_of(first, mapper.map)
    carried = inside[-1] - 5
    assert any(lost[carried : carried + 10])
    assert not lost[-1]
    assert max(off[-5:]) < 0.15
    # what was seen before it was carried is still known
    assert is_of(to_world(first, kept.points), GONE).sum() <= 5
    assert (shown[:, 0] > DOOR + 5.0).sum() > 100
    assert is_of(shown, CAME).sum() > 5


@pytest.mark.slow
def test_voxels_are_those_of_the_map(rooms):
    _, known, second = rooms
    beams = next(iter_beams(second.recording))
    with (
        LiveMapper({"slam.voxel_size": 0.3}, place=known, mode="extend") as mapper,
        pytest.raises(InputError, match=r"cells of 0\.15 m"),
    ):
        mapper.push(beams)


def test_clouds_far_from_the_origin_are_joined(tmp_path):
    """In a map projection: a known point in a voxel in which this run saw surface is left out."""
    utm = np.array([500_000.0, 5_300_000.0, 100.0])
    fields = coordinate_fields(FIELDS, is_far=True)
    point = Block(utm + np.array([[0.01, 0.0, 0.0]]), np.ones(1, np.float32), None)
    own = make_vertices(point, fields)
    (tmp_path / "static.ply").write_bytes(make_header(fields, 1) + own.tobytes())
    (tmp_path / "live").mkdir()
    points = utm + np.array([[0.02, 0.01, 0.0], [0.02, 40.003, 0.0]])
    p_static, route = np.array([0.9, 0.7], np.float32), np.eye(4)[None]
    grid, cells = GridMap(np.zeros((1, 1), np.float32), (0.0, 0.0, 0.0), EDGE), np.zeros((1, 1))
    kept = KeptMap(grid, cells, cells > 0.0, points, p_static, route)
    write_extended_cloud(tmp_path, kept, EDGE)
    (block,) = cloud_from_folder(tmp_path, "static").iter_blocks()
    expected = utm + np.array([[0.01, 0.0, 0.0], [0.02, 40.003, 0.0]])
    np.testing.assert_array_equal(block.points, expected)
    np.testing.assert_array_equal(block.p_static, np.array([1.0, 0.7], np.float32))
    np.testing.assert_array_equal(np.load(tmp_path / "live/known_route.npy"), route)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["live", "static.ply"]


def test_cells_that_were_looked_over_stay_occupied():
    """A low thing stands in the left cell: beams of this run passed above it."""
    zeros = np.zeros((1, 2), np.float32)
    known = GridMap(np.array([[0.9, 0.9]], np.float32), (0.0, 0.0, 0.0), 1.0)
    seen = OccupancyMap(np.array([[0.1, 0.1]], np.float32), (0.0, 0.0, 0.0), 1.0, zeros, zeros)
    assert extend_map(KeptMap(known, zeros), seen).p_occupied.max() < 0.2
    found = extend_map(KeptMap(known, zeros, np.array([[True, False]])), seen).p_occupied
    np.testing.assert_allclose(found, [[0.9, 0.1]], atol=1e-6)
