"""Bags of 3D results, read by the libraries of MCAP and of rosbags."""

import json
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from bag_topics import assert_grid, convert, decode_mcap, nanoseconds, placed
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from stillmap.core.recording import Recording
from stillmap.io import stillmap_folder
from stillmap.io.point_cloud import ply
from stillmap.io.point_cloud.table import read_columns
from stillmap.io.trajectory import read_tum


def vertices(cloud):
    """The points of a PointCloud2 by its own description of the fields."""
    formats = {7: "<f4"}
    kind = np.dtype(
        {
            "names": [one.name for one in cloud.fields],
            "formats": [formats[one.datatype] for one in cloud.fields],
            "offsets": [one.offset for one in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert (cloud.height, cloud.is_bigendian) == (1, False)
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    return np.frombuffer(bytes(cloud.data), kind)


def ply_points(folder):
    """(n, 4) x, y, z, p_static of both clouds of a result."""
    names = ("x", "y", "z", "p_static")
    return np.concatenate(
        [
            np.stack(block, 1)
            for part in ("static", "dynamic")
            for block in read_columns(ply.read_layout(folder / f"{part}.ply"), names)
        ]
    )


@pytest.fixture(scope="module")
def decoded(mapped_street):
    return decode_mcap(mapped_street)[1]


@pytest.mark.slow
def test_topics(decoded):
    found = {topic: len(messages) for topic, messages in decoded.items()}
    assert 0 < found.pop("/objects") <= 40
    assert found == {
        **dict.fromkeys(("/points", "/tf", "/odom"), 40),
        **dict.fromkeys(("/static_points", "/map", "/trajectory", "/tf_static"), 1),
    }


def test_sweeps_by_the_frames_are_the_clouds(decoded, mapped_street):
    """Through map, odom, base_link and lidar, each point lies where it does in the .ply files."""
    [mount] = decoded["/tf_static"][0][1].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "lidar")
    rows = []
    for (_, tf), (_, cloud) in zip(decoded["/tf"], decoded["/points"], strict=True):
        assert (cloud.header.frame_id, cloud.is_dense) == ("lidar", True)
        names = [(one.header.frame_id, one.child_frame_id) for one in tf.transforms]
        assert names == [("map", "odom"), ("odom", "base_link")]
        T = np.eye(4)
        for one in (*tf.transforms, mount):
            assert one is mount or nanoseconds(one) == nanoseconds(cloud)
            T = T @ placed(one.transform)
        points = vertices(cloud)
        assert points.dtype.names == ("x", "y", "z", "p_static")
        xyz = np.stack([points[axis] for axis in "xyz"], 1).astype(float)
        rows.append(np.column_stack([xyz @ T[:3, :3].T + T[:3, 3], points["p_static"]]))
    found, expected = np.concatenate(rows), ply_points(mapped_street)
    assert len(found) == len(expected)
    # both are in the order of the recording within static and within dynamic points
    dynamic = found[:, 3] < 0.5
    assert min(dynamic.sum(), (~dynamic).sum()) > 300
    found = np.concatenate([found[~dynamic], found[dynamic]])
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_odom_frame_is_the_recordings(decoded, street, mapped_street):
    recording = stillmap_folder.read(street)
    _, poses = read_tum(mapped_street / "trajectory.tum")
    for t, (stamp, tf) in enumerate(decoded["/tf"]):
        T_map_odom, T_odom_base = (placed(one.transform) for one in tf.transforms)
        assert stamp == recording.stamp_ns[t]
        np.testing.assert_allclose(T_odom_base, recording.T_odom_base[t], atol=1e-9)
        np.testing.assert_allclose(T_map_odom @ T_odom_base, poses[t], atol=1e-7)


def test_map_and_static_points(decoded, mapped_street):
    [(_, grid)], [(_, cloud)] = decoded["/map"], decoded["/static_points"]
    assert_grid(grid, mapped_street)
    points = vertices(cloud)
    assert cloud.header.frame_id == "map"
    expected = ply_points(mapped_street)
    expected = expected[expected[:, 3] >= 0.5]
    assert len(points) == len(expected)  # fewer than what would be sampled
    for k, name in enumerate(points.dtype.names):
        np.testing.assert_array_equal(points[name], expected[:, k].astype(np.float32))


def test_object_boxes(decoded, mapped_street):
    objects = {o["id"]: o for o in json.loads((mapped_street / "objects/objects.json").read_text())}
    seen = set()
    for stamp, message in decoded["/objects"]:
        for box in message.markers[1::2]:
            one = objects[box.id]
            seen.add(box.id)
            size = np.maximum(one["size"], 0.1)
            np.testing.assert_allclose([box.scale.x, box.scale.y, box.scale.z], size)
            track = one["track"]
            if stamp in track["stamp_ns"]:
                k, place = track["stamp_ns"].index(stamp), box.pose.position
                expected = [track[axis][k] for axis in "xyz"]
                np.testing.assert_allclose([place.x, place.y, place.z], expected, atol=1e-9)
    assert seen == set(objects)
    assert len(seen) > 1


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a"])
def test_other_bags_hold_the_same(decoded, mapped_street, tmp_path, name):
    path = convert(mapped_street, tmp_path / name, *(["--to", "ros2"] if name == "a" else []))
    found = defaultdict(list)
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        for connection, stamp, raw in reader.messages():
            found[connection.topic].append((stamp, reader.deserialize(raw, connection.msgtype)))
    assert {k: len(v) for k, v in found.items()} == {k: len(v) for k, v in decoded.items()}
    for (before, one), (after, other) in zip(found["/points"], decoded["/points"], strict=True):
        assert before == after
        assert bytes(one.data) == bytes(other.data)
        assert [f.name for f in one.fields] == [f.name for f in other.fields]


@pytest.fixture
def coloured(mapped_street, tmp_path):
    """The result with a colour for each beam, and the colours (M, 3)."""
    result = tmp_path / "coloured"
    shutil.copytree(mapped_street, result)
    beams = len(np.load(result / "beams/hit.npy"))
    colours = np.random.default_rng(1).integers(0, 256, (beams, 3)).astype(np.uint8)
    np.save(result / "beams/colour.npy", colours)
    return result, colours


def test_colours_are_packed_as_by_pcl(coloured, tmp_path):
    result, colours = coloured
    hit = np.load(result / "beams/hit.npy")
    path, packed = convert(result, tmp_path / "a.mcap"), []
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        connections = [c for c in reader.connections if c.topic == "/points"]
        for connection, _, raw in reader.messages(connections):
            points = vertices(reader.deserialize(raw, connection.msgtype))
            packed.append(points["rgb"].copy().view(np.uint32))
    rgb = np.concatenate(packed)
    channels = np.stack([rgb >> 16 & 255, rgb >> 8 & 255, rgb & 255], 1)
    np.testing.assert_array_equal(channels, colours[hit])


def test_large_static_clouds_are_sampled(mapped_street, tmp_path, monkeypatch):
    from stillmap.results.export import bag

    monkeypatch.setattr(bag, "_MAX_POINTS", 1000)
    path = convert(mapped_street, tmp_path / "a.mcap")
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        [connection] = [c for c in reader.connections if c.topic == "/static_points"]
        [(_, _, raw)] = reader.messages([connection])
        points = vertices(reader.deserialize(raw, connection.msgtype))
    assert len(points) == 1000
    expected = ply_points(mapped_street)
    expected = {tuple(row) for row in expected[expected[:, 3] >= 0.5].astype(np.float32)}
    assert {tuple(row) for row in points.tolist()} <= {
        tuple(float(x) for x in row) for row in expected
    }


def test_without_odometry_odom_is_map(street, mapped_street, tmp_path):
    recording: Recording = stillmap_folder.read(street).without_odometry()
    stillmap_folder.write(recording, tmp_path / "bare")
    path = convert(mapped_street, tmp_path / "a.bag", "--input", str(tmp_path / "bare"))
    _, poses = read_tum(mapped_street / "trajectory.tum")
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        assert "/odom" not in {c.topic for c in reader.connections}
        connections = [c for c in reader.connections if c.topic == "/tf"]
        for t, (connection, _, raw) in enumerate(reader.messages(connections)):
            map_odom, odom_base = reader.deserialize(raw, connection.msgtype).transforms
            np.testing.assert_array_equal(placed(map_odom.transform), np.eye(4))
            np.testing.assert_allclose(placed(odom_base.transform), poses[t], atol=1e-9)
