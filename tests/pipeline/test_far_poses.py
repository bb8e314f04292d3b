"""A map frame that begins far away, as map projections do: the same result, shifted."""

import dataclasses
import json

import numpy as np
import pytest
import yaml
from choices import options
from scipy.spatial import cKDTree

import stillmap
from stillmap.core.config import override
from stillmap.io.point_cloud.ply import read_layout
from stillmap.io.trajectory import read_tum, write_tum
from stillmap.results.point_cloud import cloud_from_folder
from stillmap.results.writer import crop_result
from stillmap.sim import scene_by_name, simulate

UTM = np.array([477_123.4567, 5_312_345.678, 812.345])


def shift(poses, by=UTM):
    moved, D = poses.copy(), poses.shape[-1] - 1
    moved[:, :D, D] += by[:D]
    return moved


def from_zero(poses):
    """The poses in a frame with the same axes that begins where the robot does."""
    return shift(poses, -poses[0, :-1, -1])


@pytest.fixture(scope="module")
def lidar():
    """10 sweeps of 8 channels."""
    settings = {"channels": 8, "columns": 400, "sweep": False}
    scene = scene_by_name("hall", {"lidar": settings, "robot": {"scans": 10}})
    return simulate(scene, 3)


def require_shifted(far, near, dimension):
    """The same labels and map, at poses shifted by UTM."""
    places = far.poses[:, :-1, -1] - UTM[:dimension]
    np.testing.assert_allclose(places, near.poses[:, :-1, -1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(far.p_static, near.p_static, rtol=0, atol=1e-5)
    maps = (np.asarray(one.map.p_occupied) for one in (far, near))
    np.testing.assert_allclose(*maps, rtol=0, atol=1e-5)
    corner = np.array(far.map.origin[:2]) - UTM[:2]
    np.testing.assert_allclose(corner, near.map.origin[:2], atol=1e-8)
    assert len(far.objects) == len(near.objects)
    for one, other in zip(far.objects, near.objects, strict=True):
        np.testing.assert_allclose(one.xy - UTM[:2], other.xy, rtol=0, atol=1e-5)
    ours, theirs = ([(c.kind, len(c.cells)) for c in one.mapping.changes] for one in (far, near))
    assert ours == theirs


def test_a_planar_laser(room, tmp_path):
    poses = from_zero(room.truth.T_world_base)
    near = stillmap.build(room.recording, options(max_iterations=2), poses=poses)
    far = stillmap.build(room.recording, options(max_iterations=2), poses=shift(poses))
    require_shifted(far, near, 2)
    assert near.objects
    assert "local_origin" not in near.run
    assert far.run["local_origin"] == [*UTM[:2], 0.0]
    folders = tmp_path / "near", tmp_path / "far"
    near.save(folders[0])
    far.save(folders[1])
    origins = [yaml.safe_load((one / "map.yaml").read_text())["origin"][:2] for one in folders]
    np.testing.assert_allclose(np.subtract(*origins[::-1]), UTM[:2], atol=1e-8)
    assert len({(one / "map.pgm").read_bytes() for one in folders}) == 1
    np.testing.assert_array_equal(*(np.load(one / "map.npz")["changed"] for one in folders))
    _, written = read_tum(tmp_path / "far" / "trajectory.tum")
    np.testing.assert_allclose(written[:, :2, 3], shift(poses)[:, :2, 2], rtol=0, atol=1e-6)
    track = json.loads((tmp_path / "far" / "objects" / "objects.json").read_text())[0]["track"]
    np.testing.assert_allclose(track["x"], far.objects[0].xy[:, 0], rtol=0, atol=1e-3)
    again = stillmap.load(tmp_path / "far", recording=room.recording)
    assert again.map.origin == pytest.approx(far.map.origin, abs=1e-9)


def points_of(folder):
    return np.concatenate([block.points for block in cloud_from_folder(folder).iter_blocks()])


def test_a_lidar(lidar, tmp_path):
    poses = from_zero(lidar.truth.T_world_base)
    results, points = [], []
    for name, kind in (("near", "float32"), ("far", "float64")):
        given = poses if name == "near" else shift(poses)
        results.append(stillmap.build(lidar.recording, {"threads": 1}, poses=given))
        results[-1].save(tmp_path / name)
        points.append(points_of(tmp_path / name))
        dtype = read_layout(tmp_path / name / "static.ply").dtype
        assert {str(dtype[axis]) for axis in "xyz"} == {kind}
    require_shifted(*results[::-1], 3)
    # near ones are written with 32 bits
    np.testing.assert_allclose(points[1] - UTM, points[0], rtol=0, atol=2e-5)


def test_a_region_is_in_the_map_frame(room):
    region = (UTM[0] - 1.0, UTM[1] - 1.0, UTM[0] + 2.0, UTM[1] + 1.5)
    chosen = override(options(max_iterations=1), {"output": {"region": region}})
    poses = shift(from_zero(room.truth.T_world_base))
    result = stillmap.build(room.recording, chosen, poses=poses)
    cropped = crop_result(result.mapping)
    assert cropped.map.origin[:2] == pytest.approx(region[:2], abs=1e-6)
    assert cropped.map.p_occupied.shape == (50, 60)


def test_odometry_that_begins_far_away(room):
    """In numbers that are exact in either place: matching makes millimetres of rounding errors."""
    odometry = room.recording.T_odom_base.copy()
    odometry[:, :2, 2] = np.round(odometry[:, :2, 2] * 2**20) / 2**20
    near = dataclasses.replace(room.recording, T_odom_base=odometry)
    far = dataclasses.replace(near, T_odom_base=shift(odometry))
    one, other = (stillmap.build(each, options(max_iterations=2)) for each in (near, far))
    np.testing.assert_array_equal(other.poses, one.poses)
    np.testing.assert_array_equal(other.p_static, one.p_static)
    np.testing.assert_array_equal(other.recording.T_odom_base, far.T_odom_base)
    assert "local_origin" not in other.run


def test_clouds_in_a_map_projection(tmp_path):
    """Coordinates that are shifted when they are read come back where they were."""
    rng = np.random.default_rng(1)
    walls = rng.uniform(-8.0, 8.0, (4000, 3))
    walls[:2000, 0], walls[2000:, 1] = 8.0, -8.0
    (tmp_path / "clouds").mkdir()
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(walls)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    xyz = (walls + UTM).astype("<f8").tobytes()
    (tmp_path / "clouds" / "1.ply").write_bytes(head.encode() + xyz)
    recording = stillmap.read(tmp_path / "clouds")
    result = stillmap.build(recording, {"threads": 1})
    result.save(tmp_path / "out")
    points = points_of(tmp_path / "out")
    apart, _ = cKDTree(walls).query(points - UTM)
    assert len(points) == len(walls)
    assert apart.max() < 1e-3
    np.testing.assert_allclose(result.poses[0][:3, 3], recording.source.origin, atol=1e-9)


def test_a_trajectory_that_was_written_is_read_again(room, tmp_path):
    poses = shift(room.truth.T_world_base)
    write_tum(tmp_path / "poses.tum", room.recording.stamp_ns, poses)
    result = stillmap.build(room.recording, options(max_iterations=1), poses=tmp_path / "poses.tum")
    np.testing.assert_allclose(result.poses, poses, rtol=0, atol=1e-8)


def test_absurd_poses_are_refused(room, tmp_path):
    recording = room.recording
    poses = shift(room.truth.T_world_base, 1e10 * np.ones(3))
    with pytest.raises(ValueError, match=r"(?s)poses: .* within a million km, got .* at 0"):
        stillmap.build(recording, poses=poses)
    write_tum(tmp_path / "poses.tum", recording.stamp_ns, poses)
    with pytest.raises(stillmap.InputError, match=r"poses\.tum:1: is no pose"):
        stillmap.build(recording, poses=tmp_path / "poses.tum")
