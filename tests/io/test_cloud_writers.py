"""Clouds are read back as they were written, as far as the format allows."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import ARRAYS, of_one_sensor, require_same_arrays

from stillmap.core.errors import InputError
from stillmap.io import read, writers
from stillmap.io import write as write_folder
from stillmap.io.point_cloud import kitti, las, pcd, ply

WRITERS = {"KITTI": kitti.write, "PCD": pcd.write, "own": write_folder}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_round_trip(space, tmp_path, write):
    write(space, tmp_path / "out")
    found = read(tmp_path / "out")
    require_same_arrays(found, space, ARRAYS[:6])
    np.testing.assert_allclose(found.T_recorded_base, space.T_recorded_base, atol=1e-12)
    assert found.source.skipped == {}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_the_same_recording_gives_the_same_bytes(space, tmp_path, write):
    for name in ("a", "b"):
        write(space, tmp_path / name)
    files = [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file()]
    assert files
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_odometry_becomes_poses_of_kitti_where_there_are_no_others(space, tmp_path):
    odom = replace(space, T_odom_base=space.T_recorded_base, T_recorded_base=None)
    points, hit = space.points.copy(), space.hit.copy()
    points[3], hit[3], hit[5] = np.nan, False, False
    odom = replace(odom, points=points, hit=hit)
    lost = ["its odometry is written as poses", "2 beams without a return are left out"]
    assert kitti.write(odom, tmp_path / "out") == lost
    np.testing.assert_array_equal(read(tmp_path / "out").points, points[hit])
    np.testing.assert_allclose(read(tmp_path / "out").T_recorded_base, odom.T_odom_base, atol=1e-12)


def test_the_place_of_the_sensor_is_part_of_its_poses(space, tmp_path):
    moved = space.T_base_sensor.copy()
    moved[0, :3, 3] = 0.1, 0.2, 1.5
    mounted = replace(space, T_base_sensor=moved)
    for name, write in (("k", kitti.write), ("p", pcd.write)):
        write(mounted, tmp_path / name)
        T = read(tmp_path / name).T_recorded_base
        np.testing.assert_allclose(T, mounted.T_map_sensor(mounted.T_recorded_base), atol=1e-12)


@pytest.mark.parametrize("name", ["kitti", "pcd"])
def test_several_sensors_do_not_fit(space, tmp_path, name):
    two = replace(space, T_base_sensor=np.stack([np.eye(4)] * 2))
    with pytest.raises(InputError, match="it has 2 sensors, the format holds 1"):
        writers.write(two, tmp_path / "out", name=name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_nothing_is_written_over(space, tmp_path, write):
    write(space, tmp_path / "out")
    with pytest.raises(InputError, match="already holds"):
        write(space, tmp_path / "out")
    shorter = replace(space, points=np.ones_like(space.points))
    write(shorter, tmp_path / "out", overwrite=True)
    np.testing.assert_array_equal(read(tmp_path / "out").points, shorter.points)


def test_beam_times_go_into_pcd(space, tmp_path):
    times = np.linspace(0.0, 0.1, space.n_beams).astype(np.float32)
    pcd.write(replace(space, beam_time=times), tmp_path / "out")
    np.testing.assert_array_equal(read(tmp_path / "out").beam_time, times)


def test_stamps_that_repeat_or_are_negative(space, tmp_path):
    stamps = np.array([-7, -7, 0, 0], np.int64)
    for name, write in (("k", kitti.write), ("p", pcd.write)):
        write(replace(space, stamp_ns=stamps), tmp_path / name)
        repeated = replace(space, stamp_ns=stamps)
        require_same_arrays(read(tmp_path / name), repeated, ARRAYS[:6])


def test_a_recording_of_the_plane_lies_at_height_zero(tmp_path):
    plane = of_one_sensor(
        np.array([1], np.int64),
        np.array([0, 2]),
        np.array([[1, 2], [3, 4]], np.float32),
        np.ones(2, bool),
        T_recorded_base=np.array([[[0.0, -1, 5], [1, 0, 6], [0, 0, 1]]]),
    )
    pcd.write(plane, tmp_path / "p")
    found = read(tmp_path / "p")
    np.testing.assert_array_equal(found.points, [[1, 2, 0], [3, 4, 0]])
    np.testing.assert_allclose(found.T_recorded_base[0] @ [1, 2, 0, 1], [3, 7, 0, 1])
    ply.write(plane, tmp_path / "p.ply", plane.T_recorded_base)
    np.testing.assert_allclose(read(tmp_path / "p.ply").points, [[3, 7, 0], [1, 9, 0]])


@pytest.mark.parametrize(
    ("module", "ending", "tolerance"), [(ply, "ply", 1e-6), (las, "las", 6e-5), (las, "laz", 6e-5)]
)
def test_one_cloud_of_all_hits(space, tmp_path, module, ending, tolerance):
    if module is las:
        pytest.importorskip("laspy")
    path = tmp_path / f"cloud.{ending}"
    hit = space.hit.copy()
    hit[[2, 40]] = False
    some = replace(space, hit=hit)
    module.write(some, path, some.T_recorded_base)
    placed = some.end_points(np.flatnonzero(hit), some.T_recorded_base)
    found = read(path)
    np.testing.assert_allclose(found.points, placed, atol=tolerance + 4e-6)
    assert found.n_scans == 1
    before = path.read_bytes()
    with pytest.raises(InputError, match="is there already"):
        writers.write(some, path)
    lost = writers.write(some, path, overwrite=True)
    assert lost == ["2 beams without a return are left out"]
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
