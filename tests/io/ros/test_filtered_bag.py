"""Filtered copies of bags."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from small_bags import FLOAT, SECOND, START, UINT16, UINT32, cloud_message, write_bag

from stillmap.io import read
from stillmap.io.filtered_clouds import FilterJob, Omissions
from stillmap.io.ros.bag import Bag
from stillmap.io.ros.filtered import write_filtered
from stillmap.io.ros.messages import load_typestore
from stillmap.io.ros.writer import _TRANSIENT_LOCAL
from stillmap.prepare.options import ReadOptions


def filtered(source, out, recording, blank):
    return write_filtered(FilterJob(source, out, recording, blank, ReadOptions()))


def scans(messages, n=6):
    content = []
    for k in range(n):
        stamp = START + k * SECOND
        changes = {"angle_increment": 0.0} if k == 2 else {}
        scan = messages.scan(stamp, 2.0 + 0.1 * np.arange(5) + k, **changes)
        content.append(("/scan", stamp, scan))
        odometry = messages.odometry(stamp, (k, 0, 0), (0, 0, 0, 1))
        content.append(("/odom", stamp, odometry))
    return content


def contents(path, messages):
    with AnyReader([path], default_typestore=load_typestore(messages.encoding)) as reader:
        return [
            (c.topic, log_ns, reader.deserialize(raw, c.msgtype))
            for c, log_ns, raw in reader.messages()
        ]


def test_other_messages_are_copied(bag, messages, tmp_path):
    source = bag(scans(messages))
    recording = read(source)
    blank = np.zeros(recording.n_beams, np.bool_)
    blank[[1, 7, 8]] = True  # of the first and the second scan
    out = tmp_path / f"out{source.suffix}"
    done = filtered(source, out, recording, blank)
    assert done == Omissions(scans=1)
    before, after = contents(source, messages), contents(out, messages)
    damaged = [one for one in before if one[0] == "/scan"][2]
    before.remove(damaged)
    assert [one[:2] for one in after] == [one[:2] for one in before]
    got = np.stack([m.ranges for topic, _, m in after if topic == "/scan"]).ravel()
    expected = np.stack([m.ranges for topic, _, m in before if topic == "/scan"]).ravel()
    np.testing.assert_array_equal(np.flatnonzero(np.isinf(got)), [1, 7, 8])
    np.testing.assert_array_equal(got[~blank], expected[~blank])
    again = read(out)
    np.testing.assert_array_equal(again.hit, recording.hit & ~blank)
    np.testing.assert_array_equal(again.T_odom_base, recording.T_odom_base)


def test_damaged_messages_are_left_out(bag, kind, messages, tmp_path):
    """Magic numbers say that they are compressed: of a topic that is read, and of another."""
    name, _ = messages.odometry(START, (0, 0, 0), (0, 0, 0, 1))
    broken = name, b"\x28\xb5\x2f\xfd" + b"\xff" * 20
    source = bag([*scans(messages), ("/odom", START + 9, broken), ("/more", START + 9, broken)])
    recording = read(source)
    out = tmp_path / f"out{source.suffix}"
    done = filtered(source, out, recording, np.ones(recording.n_beams, np.bool_))
    # messages of ROS 1 are never compressed one by one
    assert done.notes == (() if kind == "bag" else ("2 damaged messages are left out",))
    again = read(out)
    assert not again.hit.any()
    np.testing.assert_array_equal(again.T_odom_base, recording.T_odom_base)


@pytest.mark.parametrize("zeros", [20, 0])
def test_the_no_return_code_of_the_laser_is_used(bag, messages, tmp_path, zeros):
    """Zeros are frequent: added infinities must not make them unusable."""
    rng = np.random.default_rng(0)
    content = []
    for k in range(8):
        ranges = rng.uniform(2.0, 9.0, 100)
        ranges[rng.permutation(100)[:zeros]] = 0.0
        stamp = START + k * SECOND
        content.append(("/scan", stamp, messages.scan(stamp, ranges)))
    source = bag(content)
    recording = read(source)
    blank = recording.hit & (rng.random(recording.n_beams) < 0.3)
    out = tmp_path / f"out{source.suffix}"
    filtered(source, out, recording, blank)
    got = np.concatenate([m.ranges for _, _, m in contents(out, messages)])
    assert (got[blank] == (0.0 if zeros else np.inf)).all()
    again = read(out)
    rules = [one.source.sensors[0].ranges.zero_means for one in (recording, again)]
    assert rules == ["max-range" if zeros else "unusable"] * 2
    np.testing.assert_array_equal(again.hit, recording.hit & ~blank)
    assert np.isfinite(again.points).all()


def test_unknown_types_are_copied(tmp_path, kind, messages):
    """The bag holds their definitions."""
    from rosbags.typesys import get_types_from_msg

    own = "strange_msgs/msg/Thing"
    messages.store.register(get_types_from_msg("int32 number\nstring words\n", own))
    try:
        thing = messages.make(own, 7, "seven")
        content = [*scans(messages, 3)[:4], ("/thing", START, (own, thing))]
        source = write_bag(tmp_path, kind, messages, content)
        del messages.store.fielddefs[own]
        recording = read(source)
        out = tmp_path / f"out{source.suffix}"
        blank = np.zeros(recording.n_beams, np.bool_)
        assert filtered(source, out, recording, blank).notes == ()
        things = [m for topic, _, m in contents(out, messages) if topic == "/thing"]
        assert [(m.number, m.words) for m in things] == [(7, "seven")]
    finally:
        messages.store.fielddefs.pop(own, None)


def cloud(messages, k, n=24, **changes):
    rng = np.random.default_rng(k + 1)
    x, y, z = rng.normal(size=(3, n)).astype(np.float32) * 5.0
    x[2], y[5] = np.nan, np.inf
    x[7] = y[7] = z[7] = 0.0
    columns = [
        ("intensity", FLOAT, rng.random(n)),
        *(("x", FLOAT, x), ("y", FLOAT, y), ("z", FLOAT, z)),
        ("ring", UINT16, np.arange(n) % 16),
        ("t", UINT32, np.linspace(0.0, 9e7, n).astype(np.uint32)),
    ]
    stamp = START + k * SECOND
    return "/points", stamp, cloud_message(messages, stamp, columns, step=32, **changes)


def decode_cloud(messages, raw):
    store, kind = load_typestore(messages.encoding), "sensor_msgs/msg/PointCloud2"
    if messages.encoding == "ros1":
        return store.deserialize_ros1(raw, kind)
    return store.deserialize_cdr(raw, kind)


def raw_contents(path, messages):
    with AnyReader([path], default_typestore=load_typestore(messages.encoding)) as reader:
        return [(c.topic, log_ns, bytes(raw)) for c, log_ns, raw in reader.messages()]


@pytest.mark.parametrize(
    ("height", "changes"),
    [
        *((1, {}), (1, {"padding": 8}), (1, {"row_step": 0}), (1, {"big": True})),
        *((4, {"padding": 8}), (4, {"big": True})),
    ],
)
def test_points_of_clouds(bag, kind, messages, tmp_path, height, changes):
    """Points go, or in organised clouds their coordinates; each other byte stays."""
    if changes and kind in ("db3", "folder"):
        pytest.skip("messages are those of MCAP files")
    content = [cloud(messages, k, height=height, **changes) for k in range(6)]
    content[2] = (*content[2][:2], (content[2][2][0], b"no cloud"))
    back = cloud(messages, -1, height=height, **changes)[2]
    content[3] = (*content[3][:2], back)  # its stamp goes back
    for k in range(4):
        stamp = START + k * SECOND
        content.append(("/odom", stamp, messages.odometry(stamp, (k, 0, 0), (0, 0, 0, 1))))
        other = cloud_message(messages, stamp, [(a, FLOAT, np.ones(3)) for a in "xyz"], frame="b")
        content.append(("/other", stamp, other))
    source = bag(sorted(content, key=lambda one: one[1]))
    recording = read(source, ReadOptions(topic="/points"))
    rng = np.random.default_rng(0)
    blank = recording.hit & (rng.random(recording.n_beams) < 0.4)
    blank[recording.beams_of(1)] = False
    out = tmp_path / f"out{source.suffix}"
    done = filtered(source, out, recording, blank)
    assert done == Omissions(2, ("/other is as it was: it was not mapped",))
    before, after = raw_contents(source, messages), raw_contents(out, messages)
    others = [one for one in before if one[0] != "/points"]
    assert [one for one in after if one[0] != "/points"] == others
    clouds, old_clouds = (
        [decode_cloud(messages, raw) for topic, _, raw in part if topic == "/points"]
        for part in (after, [one for one in before if one[2] != b"no cloud"])
    )
    del old_clouds[2]  # before its time
    assert [t for n, t, _ in after if n == "/points"] == [START + k * SECOND for k in (0, 1, 4, 5)]
    assert len(clouds) == recording.n_scans == 4
    for scan, (old, new) in enumerate(zip(old_clouds, clouds, strict=True)):
        gone = blank[recording.beams_of(scan)]
        assert new.header == old.header
        assert [vars(f) for f in new.fields] == [vars(f) for f in old.fields]
        assert (new.point_step, new.is_bigendian) == (old.point_step, old.is_bigendian)
        assert new.height == height
        if height == 1:
            padding = changes.get("padding", 0)
            assert new.width == 24 - gone.sum()
            assert new.row_step == (old.row_step - 32 * gone.sum() if old.row_step else 0)
            rows = np.array(old.data[: 24 * 32]).reshape(24, 32)
            expected = np.append(rows[~gone].ravel(), np.full(padding, 0xAB, np.uint8))
            np.testing.assert_array_equal(new.data, expected)
            assert new.is_dense
        else:
            assert (new.width, new.row_step) == (old.width, old.row_step)
            assert new.is_dense == (not gone.any())
            rows = [np.array(one.data).reshape(height, -1) for one in (old, new)]
            np.testing.assert_array_equal(rows[0][:, 6 * 32 :], rows[1][:, 6 * 32 :])
            old_points, new_points = (one[:, : 6 * 32].reshape(24, 32) for one in rows)
            np.testing.assert_array_equal(old_points[~gone], new_points[~gone])
            fields = [*range(4), *range(16, 32)]
            np.testing.assert_array_equal(old_points[:, fields], new_points[:, fields])
            order = ">" if changes.get("big") else "<"
            assert np.isnan(new_points[gone][:, 4:16].copy().view(f"{order}f4")).all()
    again = read(out, ReadOptions(topic="/points"))
    np.testing.assert_array_equal(again.points[again.hit], recording.points[recording.hit & ~blank])
    np.testing.assert_array_equal(
        again.beam_time[again.hit], recording.beam_time[recording.hit & ~blank]
    )


def test_clouds_in_another_kind_of_ros2_bag(bag, messages, kind, tmp_path):
    """Every message of every topic moves over."""
    if kind == "bag":
        pytest.skip("messages of ROS 1 are others")
    source = bag([cloud(messages, k) for k in range(3)])
    recording = read(source)
    blank = np.zeros(recording.n_beams, np.bool_)
    for target in ("db3", "mcap", "ros2"):
        out = tmp_path / f"out.{target}"
        write_filtered(FilterJob(source, out, recording, blank, ReadOptions(), kind=target))
        assert read(out).n_scans == 3
        assert out.is_dir() == (target == "ros2")
        if target == "ros2":
            assert raw_contents(out, messages) == raw_contents(source, messages)


def test_publishers_and_quality_of_service_stay(tmp_path, kind, messages):
    qos = _TRANSIENT_LOCAL._replace(depth=5, durability=QosDurability.VOLATILE)
    if kind == "bag":
        source, more = tmp_path / "a.bag", {"callerid": "/lidar"}
        writer = Writer1(source)
    else:
        source, more = tmp_path / "a", {"offered_qos_profiles": [qos]}
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(source, version=9, storage_plugin=plugin)
    with writer:
        topic, stamp, (type, message) = cloud(messages, 0)
        connection = writer.add_connection(topic, type, typestore=messages.store, **more)
        writer.write(connection, stamp, messages.raw(type, message))
    recording = read(source)
    out = tmp_path / f"out{source.suffix}"
    filtered(source, out, recording, recording.hit)
    bag = Bag([out], None, trusted=True)
    assert [(c.publisher, c.qos) for c in bag.channels] == [
        ("/lidar", ()) if kind == "bag" else ("", (qos,))
    ]
    bag.close()
