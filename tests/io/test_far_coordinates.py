"""Coordinates of map projections in files that are read and written, and such that cannot be."""

import numpy as np
import pytest
from recordings import of_one_sensor

from stillmap.core.errors import InputError
from stillmap.io import read, writers
from stillmap.io.point_cloud import pcd, ply, table
from stillmap.io.trajectory import read_tum, write_tum

UTM = np.array([500_000.0, 5_300_000.0, 800.0])


@pytest.fixture
def cloud(tmp_path):
    """(200, 3) points in a projection, and a file of them."""
    points = np.random.default_rng(3).uniform(-20.0, 20.0, (200, 3)).astype(np.float32)
    recording = of_one_sensor(np.zeros(1, np.int64), np.array([0, 200]), points, np.ones(200, bool))
    T = np.eye(4)[None]
    T[0, :3, 3] = UTM
    ply.write(recording, tmp_path / "cloud.ply", T)
    return points + UTM, tmp_path / "cloud.ply"


def test_a_cloud_is_converted_where_it_was(cloud, tmp_path):
    points, path = cloud
    recording = read(path)
    assert recording.source.origin
    writers.write(recording, tmp_path / "out.ply")
    columns = list(table.read_columns(ply.read_layout(tmp_path / "out.ply"), ("x", "y", "z")))
    found = np.stack(columns[0], axis=1)
    np.testing.assert_allclose(found, points, rtol=0, atol=1e-4)


def test_las_has_an_offset(cloud, tmp_path):
    laspy = pytest.importorskip("laspy")
    points, path = cloud
    writers.write(read(path), tmp_path / "out.las")
    found = laspy.read(tmp_path / "out.las")
    np.testing.assert_allclose(found.xyz, points, rtol=0, atol=2e-4)
    assert np.abs(found.header.offsets - UTM).max() < 50.0


def test_a_folder_of_pcd_says_where_it_was(cloud, tmp_path):
    points, path = cloud
    pcd.write(read(path), tmp_path / "out")
    found = read(tmp_path / "out")
    ends = found.end_points(np.arange(found.n_beams), found.T_recorded_base)
    np.testing.assert_allclose(ends, points, rtol=0, atol=1e-4)


def test_scans_without_a_pose_beside_others(tmp_path):
    """Only the one in the projection is shifted, and its pose says so."""
    points = np.random.default_rng(3).uniform(-20.0, 20.0, (50, 3))
    for name, viewpoint, these in (
        ("1.pcd", "0 0 0 1 0 0 0", points + UTM),
        ("2.pcd", "500003 5300004 800 1 0 0 0", points),
    ):
        head = (
            "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 50\nHEIGHT 1\n"
        )
        head += f"VIEWPOINT {viewpoint}\nPOINTS 50\nDATA binary\n"
        (tmp_path / name).write_bytes(head.encode() + these.astype("<f8").tobytes())
    found = read(tmp_path)
    ends = found.end_points(np.arange(found.n_beams), found.T_recorded_base)
    np.testing.assert_allclose(ends[:50], points + UTM, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ends[50:], points + UTM + (3.0, 4.0, 0.0), rtol=0, atol=1e-5)
    assert found.source.origin is None


@pytest.mark.parametrize("number", ["1e9", "-3e300", "1e12"])
def test_a_trajectory_a_million_kilometres_away(tmp_path, number):
    path = tmp_path / "poses.tum"
    path.write_text(f"1 0 0 0 0 0 0 1\n2 0 {number} 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"poses\.tum:2: is no pose"):
        read_tum(path)


def test_a_trajectory_in_a_projection_keeps_the_nanometre(tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = np.array([1e7, -1e7, 9000.0]) + np.arange(3)[:, None] * 0.123456789
    write_tum(tmp_path / "poses.tum", np.arange(3) * 10**9, poses)
    np.testing.assert_allclose(read_tum(tmp_path / "poses.tum")[1], poses, rtol=0, atol=4e-9)
