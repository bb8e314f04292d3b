"""Recordings written as ROS bags, decoded by rosbags."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import writers
from stillmap.io.ros.message_fields import LaserScanEncoder
from stillmap.io.ros.writer import write_recording
from stillmap.sim import scene_by_name, simulate

KINDS = {"bag": "out.bag", "ros2": "out", "db3": "out.db3", "mcap": "out.mcap"}


@pytest.fixture(scope="module")
def driven():
    """Two lasers with beam times, one with some unusable beams."""
    laser = {"beams": 90, "fov": 4.0, "second_laser": True, "sweep_time": 0.05, "x": 0.2}
    scene = scene_by_name("hall", {"robot": {"scans": 12}, "laser": laser})
    recording = simulate(scene, 2).recording
    points, hit = np.array(recording.points), np.array(recording.hit)
    points[3::17], hit[3::17], hit[5::17] = np.nan, False, False
    stamp_ns = recording.stamp_ns + np.arange(12) * 7  # not only whole milliseconds
    return dataclasses.replace(recording, points=points, hit=hit, stamp_ns=stamp_ns)


def decoded(path):
    """All messages by topic, each with its log time, and the connections by topic."""
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        topics, told = {}, {c.topic: c for c in reader.connections}
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            topics.setdefault(connection.topic, []).append((time, message))
    return topics, told


def nanoseconds(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def matrix(translation, rotation):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([getattr(rotation, k) for k in "xyzw"]).as_matrix()
    T[:3, 3] = translation.x, translation.y, translation.z
    return T


def planar(T):
    return T[np.ix_([0, 1, 3], [0, 1, 3])]


@pytest.mark.parametrize("kind", KINDS)
def test_laser_scans(tmp_path, driven, kind):
    assert write_recording(kind, driven, tmp_path / KINDS[kind]) == []
    topics, told = decoded(tmp_path / KINDS[kind])
    assert set(topics) == {"/scan", "/scan2", "/odom", "/tf", "/tf_static"}
    for s, topic in enumerate(("/scan", "/scan2")):
        its = np.flatnonzero(driven.sensor == s)
        assert [time for time, _ in topics[topic]] == driven.stamp_ns[its].tolist()
        for t, (time, scan) in zip(its, topics[topic], strict=True):
            assert nanoseconds(scan.header) == time
            assert scan.header.frame_id == ("laser", "laser2")[s]
            points, hit = driven.points[driven.beams_of(t)], driven.hit[driven.beams_of(t)]
            expected = np.linalg.norm(points.astype(float), axis=1)
            expected[~hit & ~np.isnan(expected)] = np.inf
            assert {np.isnan(r) or np.isinf(r) for r in expected} == {True, False}
            np.testing.assert_allclose(scan.ranges, expected, rtol=1e-7)
            assert np.all(scan.ranges[hit] < np.float32(scan.range_max))
            angle = scan.angle_min + scan.angle_increment * np.arange(len(points))
            ends = expected[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            np.testing.assert_allclose(ends[hit], points[hit], atol=2e-5)
            assert np.isclose(angle[-1], scan.angle_max, atol=1e-5)
            taken = scan.time_increment * np.arange(len(points))
            its_times = driven.beam_time[driven.beams_of(t)]
            np.testing.assert_allclose(taken, its_times, atol=0.0006)
    assert [time for time, _ in topics["/odom"]] == driven.stamp_ns.tolist()
    for t, ((_, odometry), (time, tf)) in enumerate(
        zip(topics["/odom"], topics["/tf"], strict=True)
    ):
        pose, (moved,) = odometry.pose.pose, tf.transforms
        assert nanoseconds(odometry.header) == nanoseconds(moved.header) == time
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_link")
        T = matrix(pose.position, pose.orientation)
        np.testing.assert_allclose(planar(T), driven.T_odom_base[t], atol=1e-12)
        moved = matrix(moved.transform.translation, moved.transform.rotation)
        np.testing.assert_array_equal(moved, T)
    [(_, placed)] = topics["/tf_static"]
    assert [p.child_frame_id for p in placed.transforms] == ["laser", "laser2"]
    for one, T in zip(placed.transforms, driven.T_base_sensor, strict=True):
        assert one.header.frame_id == "base_link"
        found = matrix(one.transform.translation, one.transform.rotation)
        np.testing.assert_allclose(planar(found), T, atol=1e-12)
    if kind == "bag":
        assert told["/tf_static"].ext.latching == 1
    else:
        [qos] = told["/tf_static"].ext.offered_qos_profiles
        assert qos.durability is QosDurability.TRANSIENT_LOCAL


def clouds(beam_time=None):
    rng = np.random.default_rng(0)
    points = rng.normal(0, 10, (50, 3)).astype(np.float32)
    points[7] = np.nan
    hit = ~np.isnan(points[:, 0])
    hit[9] = False
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3] = Rotation.random(3, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(0, 3, (3, 3))
    return Recording(
        stamp_ns=np.array([5, 1_000_000_007, 1_500_000_000], np.int64),
        offset=np.array([0, 20, 20, 50], np.int64),
        points=points,
        hit=hit,
        T_base_sensor=T[:1],
        sensor=np.zeros(3, np.int32),
        T_odom_base=T,
        beam_time=beam_time,
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("timed", [True, False])
def test_clouds(tmp_path, kind, timed):
    times = np.linspace(-0.05, 0.05, 50).astype(np.float32)
    recording = clouds(times if timed else None)
    [lost] = write_recording(kind, recording, tmp_path / KINDS[kind])
    assert lost.startswith("1 beams at maximum range")
    topics, _ = decoded(tmp_path / KINDS[kind])
    for t, (time, cloud) in enumerate(topics["/points"]):
        beams = recording.beams_of(t)
        assert time == nanoseconds(cloud.header) == recording.stamp_ns[t]
        assert [f.name for f in cloud.fields] == list("xyzt" if timed else "xyz")
        assert [f.offset for f in cloud.fields] == [0, 4, 8, 12][: len(cloud.fields)]
        table = cloud.data.view("<f4").reshape(cloud.width, cloud.point_step // 4)
        expected = np.where(recording.hit[beams, None], recording.points[beams], np.nan)
        np.testing.assert_array_equal(table[:, :3], expected)
        assert cloud.is_dense == (not np.isnan(expected).any())
        if timed:
            np.testing.assert_array_equal(table[:, 3], times[beams])
    pose = topics["/odom"][2][1].pose.pose
    T = matrix(pose.position, pose.orientation)
    np.testing.assert_allclose(T, recording.T_odom_base[2], atol=1e-12)
    [(_, placed)] = topics["/tf_static"]
    [one] = placed.transforms
    T = matrix(one.transform.translation, one.transform.rotation)
    np.testing.assert_allclose(T, recording.T_base_sensor[0], atol=1e-12)


def test_scans_with_equal_stamps_share_the_odometry(tmp_path, driven):
    stamp_ns, T = np.array(driven.stamp_ns), np.array(driven.T_odom_base)
    stamp_ns[1], T[1] = stamp_ns[0], T[0]
    same = dataclasses.replace(driven, stamp_ns=stamp_ns, T_odom_base=T)
    write_recording("bag", same, tmp_path / "a.bag")
    topics, _ = decoded(tmp_path / "a.bag")
    assert [len(topics[name]) for name in ("/odom", "/tf", "/scan", "/scan2")] == [11, 11, 6, 6]


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_recording_gives_the_same_bytes(tmp_path, driven, kind):
    texts = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / KINDS[kind]
        write_recording(kind, driven, path)
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        texts.append([(file.name, file.read_bytes()) for file in files])
        assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    assert texts[0] == texts[1]
    if kind == "ros2":
        assert [name for name, _ in texts[0]] == ["metadata.yaml", "out.db3"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_appears_complete_or_not_at_all(tmp_path, driven, kind, monkeypatch):
    path = tmp_path / KINDS[kind]
    write_recording(kind, driven, path)
    before = [(p, p.read_bytes()) for p in sorted(Path(tmp_path).rglob("*")) if p.is_file()]
    monkeypatch.setattr(LaserScanEncoder, "make_message", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_recording(kind, driven, path, overwrite=True)
    assert [(p, p.read_bytes()) for p in sorted(tmp_path.rglob("*")) if p.is_file()] == before


@pytest.mark.parametrize(
    ("kind", "first", "last"), [("bag", -1, 0), ("bag", 0, 2**32), ("mcap", 0, 2**31)]
)
def test_stamps_out_of_range(tmp_path, driven, kind, first, last):
    stamp_ns = np.linspace(first, last, 12).astype(np.int64) * 10**9
    odd = dataclasses.replace(driven, stamp_ns=stamp_ns)
    with pytest.raises(InputError, match="do not fit into a ROS bag"):
        write_recording(kind, odd, tmp_path / KINDS[kind])
    assert not list(tmp_path.iterdir())


def test_a_recording_without_scans_is_refused(tmp_path, driven):
    with pytest.raises(InputError, match="holds no scan"):
        writers.write(driven.slice_scans(0, 0), tmp_path / "b.mcap")
