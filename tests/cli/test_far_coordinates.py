"""The commands with poses in a map projection, and with poses that cannot be."""

import json
import shutil

import laspy
import numpy as np
import pytest
import yaml
from refusals import refused
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial import cKDTree

from stillmap.io.point_cloud import pcd
from stillmap.io.point_cloud.table import read_columns
from stillmap.io.trajectory import read_tum, write_tum
from stillmap.results.point_cloud import cloud_from_folder
from stillmap.sim import scene_by_name, simulate, write_simulation

UTM = np.array([500_000.0, 5_300_000.0, 800.0])


@pytest.fixture(scope="module")
def lidar(tmp_path_factory):
    """A recording of 6 sweeps, and its true poses in a projection."""
    folder = tmp_path_factory.mktemp("lidar")
    settings = {"channels": 8, "columns": 300, "sweep": False}
    made = simulate(scene_by_name("hall", {"lidar": settings, "robot": {"scans": 6}}), 3)
    write_simulation(made, folder / "sim")
    poses = made.truth.T_world_base.copy()
    poses[:, :3, 3] += UTM
    write_tum(folder / "poses.tum", made.recording.stamp_ns, poses)
    return folder


@pytest.fixture(scope="module")
def mapped(lidar):
    from stillmap.cli.main import main

    words = ["map", lidar / "sim", "-o", lidar / "out", "--poses", lidar / "poses.tum", "--quiet"]
    assert main([str(word) for word in words]) == 0
    return lidar / "out"


def test_the_result_is_in_the_frame_of_the_poses(lidar, mapped):
    (stamps, given), (stamp_ns, written) = (
        read_tum(path) for path in (lidar / "poses.tum", mapped / "trajectory.tum")
    )
    np.testing.assert_array_equal(stamps, stamp_ns)
    np.testing.assert_allclose(written, given, rtol=0, atol=1e-8)
    origin = yaml.safe_load((mapped / "map.yaml").read_text())["origin"]
    assert np.abs(np.array(origin[:2]) - UTM[:2]).max() < 50.0
    record = json.loads((mapped / "run.json").read_text())
    np.testing.assert_allclose(record["local_origin"], given[0, :3, 3], rtol=0, atol=1e-8)


def test_clouds_keep_the_millimetre(call, mapped, tmp_path):
    points = np.concatenate([block.points for block in cloud_from_folder(mapped).iter_blocks()])
    for name in ("a.las", "a.pcd"):
        done = call("convert", mapped, "-o", tmp_path / name, "--quiet")
        assert (done.returncode, done.stderr) == (0, "")
    las = laspy.read(tmp_path / "a.las")
    assert np.abs(las.header.offsets - UTM).max() < 50.0
    columns = next(read_columns(pcd.read_header(tmp_path / "a.pcd")[0], ["x", "y", "z"]))
    for found in (np.asarray(las.xyz), np.stack(columns, axis=1)):
        assert found.dtype == np.float64
        assert found.shape == points.shape
        apart, _ = cKDTree(points - UTM).query(found - UTM)
        assert apart.max() < 1e-3


@pytest.mark.parametrize("states_origin", [True, False])
def test_static_points_of_a_bag_are_near(call, mapped, tmp_path, states_origin):
    """Also of a session of a place, whose record states no origin."""
    result = shutil.copytree(mapped, tmp_path / "result")
    if not states_origin:
        record = json.loads((result / "run.json").read_text())
        del record["local_origin"]
        (result / "run.json").write_text(json.dumps(record))
    assert call("convert", result, "-o", tmp_path / "a.mcap", "--quiet").returncode == 0
    with AnyReader([tmp_path / "a.mcap"], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        messages = {
            connection.topic: reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic in ("/static_points", "/tf_static")
        }
    cloud = messages["/static_points"]
    assert cloud.header.frame_id == "map_local"
    points = np.frombuffer(cloud.data, np.float32).reshape(cloud.width, -1)[:, :3]
    assert np.abs(points).max() < 100.0
    [found] = [
        one for one in messages["/tf_static"].transforms if one.child_frame_id == "map_local"
    ]
    at = found.transform.translation
    assert found.header.frame_id == "map"
    assert np.abs(np.array([at.x, at.y, at.z]) - UTM).max() < 50.0


@pytest.mark.parametrize("command", ["map", "live --replay", "convert"])
@pytest.mark.parametrize("lidar_settings", [None, {"channels": 8, "columns": 60, "sweep": False}])
def test_a_sensor_that_is_not_on_the_robot(call, tmp_path, command, lidar_settings):
    settings = {"lidar": lidar_settings} if lidar_settings else {}
    made = simulate(scene_by_name("hall", {**settings, "robot": {"scans": 3}}), 3)
    write_simulation(made, tmp_path / "sim")
    mounts = made.recording.T_base_sensor.copy()
    mounts[0, 0, -1] = 1e7
    np.save(tmp_path / "sim" / "T_base_sensor.npy", mounts)
    done = call(*command.split(), tmp_path / "sim", "-o", tmp_path / "out", "--quiet")
    refused(done, "sensor 0 is mounted 1e+07 m from the robot's base")
    assert not (tmp_path / "out").exists()
