"""Exports of 2D results: MCAP, read by the library of its authors, and Parquet."""

from collections import defaultdict

import numpy as np
import pytest
from bag_topics import assert_grid, convert, decode_mcap, matrix, nanoseconds

from stillmap.io.trajectory import poses_from_tum


@pytest.fixture(scope="module")
def decoded(result):
    return decode_mcap(result)


def planar(translation, q):
    return matrix(translation, q)[np.ix_([0, 1, 3], [0, 1, 3])]


@pytest.mark.slow
def test_schemas_are_complete(decoded):
    summary, _ = decoded
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
        text = schema.data.decode()
        defined = {line[5:] for line in text.splitlines() if line.startswith("MSG: ")}
        for line in text.splitlines():
            kind = line.split("#")[0].split("[")[0].split()
            if kind and "/" in kind[0] and not line.startswith("MSG:"):
                assert kind[0] in defined, f"{schema.name}: {kind[0]}"
    channels = {c.topic: (summary.schemas[c.schema_id].name, c) for c in summary.channels.values()}
    assert {topic: name for topic, (name, _) in channels.items()} == {
        "/scan": "sensor_msgs/msg/LaserScan",
        "/scan2": "sensor_msgs/msg/LaserScan",
        "/scan_dynamic": "sensor_msgs/msg/LaserScan",
        "/scan2_dynamic": "sensor_msgs/msg/LaserScan",
        "/map": "nav_msgs/msg/OccupancyGrid",
        "/trajectory": "nav_msgs/msg/Path",
        "/objects": "visualization_msgs/msg/MarkerArray",
        "/odom": "nav_msgs/msg/Odometry",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
    }
    for topic, (_, channel) in channels.items():
        assert channel.message_encoding == "cdr"
        latched = "durability: 1" in channel.metadata["offered_qos_profiles"]
        assert latched == (topic in ("/map", "/trajectory", "/tf_static"))


def test_frames_form_a_tree(decoded):
    _, topics = decoded
    parents = defaultdict(set)
    for topic in ("/tf", "/tf_static"):
        for _, message in topics[topic]:
            for one in message.transforms:
                parents[one.child_frame_id].add(one.header.frame_id)
    lasers = {"laser": {"base_link"}, "laser2": {"base_link"}}
    assert parents == {"odom": {"map"}, "base_link": {"odom"}, **lasers}
    for topic, messages in topics.items():
        for time, message in messages:
            parts = getattr(message, "transforms", getattr(message, "markers", [message]))
            for part in parts:
                assert part.header.frame_id in {"map", *parents}, topic
                assert nanoseconds(part) == time
                assert getattr(part, "child_frame_id", "odom") in parents


def test_each_beam_is_in_one_scan_topic(decoded, result, recording):
    _, topics = decoded
    p_static = np.load(result / "beams/p_static.npy")
    length = np.linalg.norm(recording.points.astype(float), axis=1)
    taken = dict.fromkeys(("/scan", "/scan2", "/scan_dynamic", "/scan2_dynamic"), 0)
    dynamic = 0
    for t in range(recording.n_scans):
        beams, number = recording.beams_of(t), "2" * int(recording.sensor[t])
        scans = []
        for topic in (f"/scan{number}", f"/scan{number}_dynamic"):
            time, scan = topics[topic][taken[topic]]
            taken[topic] += 1
            assert time == recording.stamp_ns[t]
            assert scan.time_increment > 0
            scans.append(np.array(scan.ranges))
        hit, moves = recording.hit[beams], recording.hit[beams] & (p_static[beams] < 0.5)
        expected = np.where(hit, length[beams], np.inf)
        np.testing.assert_allclose(scans[0], np.where(moves, np.nan, expected), rtol=1e-6)
        np.testing.assert_allclose(scans[1], np.where(moves, expected, np.nan), rtol=1e-6)
        dynamic += moves.sum()
    assert dynamic > 100


def test_trajectory_topic(decoded, result, recording):
    _, topics = decoded
    poses = poses_from_tum(result / "trajectory.tum", recording)
    [(_, path)] = topics["/trajectory"]
    found = [planar(p.pose.position, p.pose.orientation) for p in path.poses]
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert [nanoseconds(p) for p in path.poses] == recording.stamp_ns.tolist()
    for t, (time, tf) in enumerate(topics["/tf"]):
        assert time == recording.stamp_ns[t]
        names = [(one.header.frame_id, one.child_frame_id) for one in tf.transforms]
        assert names == [("map", "odom"), ("odom", "base_link")]
        T_map_odom, T_odom_base = (
            planar(one.transform.translation, one.transform.rotation) for one in tf.transforms
        )
        np.testing.assert_allclose(T_map_odom @ T_odom_base, poses[t], atol=1e-12)
        np.testing.assert_allclose(T_odom_base, recording.T_odom_base[t], atol=1e-12)
    assert len(topics["/tf"]) == recording.n_scans


def test_odometry_topic(decoded, recording):
    _, topics = decoded
    assert len(topics["/odom"]) == recording.n_scans
    for (time, odometry), T, stamp in zip(
        topics["/odom"], recording.T_odom_base, recording.stamp_ns, strict=True
    ):
        assert (time, odometry.child_frame_id) == (stamp, "base_link")
        pose = odometry.pose.pose
        np.testing.assert_allclose(planar(pose.position, pose.orientation), T, atol=1e-12)


def test_map_topic(decoded, result):
    _, topics = decoded
    [(_, grid)] = topics["/map"]
    assert_grid(grid, result)


def test_object_markers(decoded, result):
    import json

    _, topics = decoded
    objects = {o["id"]: o for o in json.loads((result / "objects/objects.json").read_text())}
    shown = defaultdict(list)
    for time, message in topics["/objects"]:
        first, *rest = message.markers
        assert first.action == 3  # what was there before goes
        boxes, numbers = rest[::2], rest[1::2]
        for box, number in zip(boxes, numbers, strict=True):
            assert (box.ns, box.type, number.ns, number.type) == ("objects", 1, "ids", 9)
            assert number.text == str(box.id) == str(number.id)
            assert number.pose.position.z > box.pose.position.z + box.scale.z / 2
            shown[box.id].append((time, box))
    assert set(shown) == set(objects)
    for number, boxes in shown.items():
        one = objects[number]
        assert boxes[0][0] == one["first_stamp_ns"]
        assert boxes[-1][0] == one["last_stamp_ns"]
        at = dict(boxes)
        track = one["track"]
        for stamp, x, y in zip(track["stamp_ns"], track["x"], track["y"], strict=True):
            place = at[stamp].pose.position
            np.testing.assert_allclose([place.x, place.y], [x, y], atol=1e-9)
    gone = [len(message.markers) == 1 for _, message in topics["/objects"]]
    assert any(gone) or topics["/objects"][-1][0] == topics["/tf"][-1][0]


def test_parquet_table(result, recording):
    """In the map frame: static end points lie on the walls of the map."""
    parquet = pytest.importorskip("pyarrow.parquet")
    read = parquet.read_table(convert(result, result.parent / "beams.parquet", "--overwrite"))
    table = {name: read[name].to_numpy() for name in read.column_names}
    assert len(table["scan"]) == recording.n_beams
    with np.load(result / "map.npz") as archive:
        p, origin, resolution = (archive[n] for n in ("p_occupied", "origin", "resolution"))
    cells = np.stack([(table[axis] - origin[k]) / resolution for k, axis in enumerate("xy")])
    # single precision does not say on which side of a border an end point lies
    on_border = np.any(np.abs(cells - np.rint(cells)) < 1e-4, axis=0)
    use = table["hit"] & (table["p_static"] > 0.9) & ~on_border
    column, row = cells[:, use].astype(int)
    assert use.sum() > 10_000
    # some of the cells were unknown if the motion during the scans were in it
    assert not np.isnan(p[row, column]).any()
    assert np.mean(p[row, column] > 0.5) > 0.9
