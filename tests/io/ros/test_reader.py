"""Reading bags of every kind as recordings."""

import numpy as np
import pytest
from recordings import require_same_arrays
from small_bags import SECOND, START, turned

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.pipeline import inputs
from stillmap.prepare.options import ReadOptions


def ranges_at(k, n=5):
    return 2.0 + 0.1 * k + 0.01 * np.arange(n)


def scan_at(messages, k, ranges=None, **changes):
    stamp, ranges = START + k * SECOND, ranges_at(k) if ranges is None else ranges
    return "/scan", stamp, messages.scan(stamp, ranges, **changes)


def drive(messages, n_scans=10, n_beams=5):
    """A robot moving by 0.1 m per scan, laser 0.2 m ahead, transforms between the scans."""
    content = [
        ("/tf_static", START, messages.tf(messages.transform(0, "base_link", "laser", (0.2, 0, 0))))
    ]
    for k in range(-1, 2 * n_scans):
        stamp = START + k * SECOND // 20
        step = messages.transform(stamp, "odom", "base_link", (0.05 * k, 0, 0))
        content.append(("/tf", stamp, messages.tf(step)))
    for k in range(n_scans):
        stamp = START + k * SECOND // 10 + SECOND // 40  # half way between two transforms
        content.append(("/scan", stamp, messages.scan(stamp, ranges_at(k, n_beams))))
    return sorted(content, key=lambda one: one[1])


def test_a_drive(bag, messages):
    recording = read(bag(drive(messages)))
    assert recording.n_scans == 10
    np.testing.assert_array_equal(
        recording.stamp_ns, START + np.arange(10) * SECOND // 10 + SECOND // 40
    )
    x, y, theta = se2.parameters(recording.T_odom_base).T
    np.testing.assert_allclose(x, 0.1 * np.arange(10) + 0.025, atol=1e-9)
    np.testing.assert_allclose([y, theta], 0.0, atol=1e-9)
    np.testing.assert_allclose(se2.parameters(recording.T_base_sensor), [[0.2, 0, 0]], atol=1e-9)
    expected = np.stack([ranges_at(k) for k in range(10)])
    got = np.linalg.norm(recording.points, axis=1).reshape(10, 5)
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    angle = np.arctan2(recording.points[:, 1], recording.points[:, 0]).reshape(10, 5)
    np.testing.assert_allclose(angle, np.tile([-0.5, -0.25, 0, 0.25, 0.5], (10, 1)), atol=1e-6)
    assert recording.hit.all()
    assert recording.source.odometry["from"] == "TF from odom to base_link"
    assert recording.source.base_frame == "base_link"
    assert not recording.source.warnings


def test_no_transforms(bag, messages):
    recording = read(bag([scan_at(messages, k) for k in range(3)]))
    assert recording.T_odom_base is None
    np.testing.assert_array_equal(recording.T_base_sensor[0], np.eye(3))
    assert "is used as the base frame" in recording.source.warnings[0]


def test_odometry_messages(bag, messages):
    content = [
        ("/tf_static", START, messages.tf(messages.transform(0, "base_link", "laser", (0, 0, 0))))
    ]
    for k in range(4):
        stamp = START + k * SECOND
        odometry = messages.odometry(stamp, (k, 2 * k, 0), turned(0.1 * k))
        content.append(("/odom", stamp, odometry))
        content.append(("/scan", stamp, messages.scan(stamp, ranges_at(k))))
    recording = read(bag(content))
    x, y, theta = se2.parameters(recording.T_odom_base).T
    np.testing.assert_allclose(
        np.stack([x, y, theta]), [[0, 1, 2, 3], [0, 2, 4, 6], 0.1 * np.arange(4)]
    )
    assert recording.source.odometry["from"] == "/odom"
    assert recording.source.base_frame_how == "/odom names it"


def test_infinity_means_no_return(bag, messages):
    """REP 117: +inf no return, -inf too near, NaN no measurement."""
    readings = [1.0, np.inf, -np.inf, np.nan, 0.05, -1.0, 15.0]
    recording = read(bag([scan_at(messages, k, readings) for k in range(2)]))
    np.testing.assert_array_equal(recording.hit[:7], [1, 0, 0, 0, 0, 0, 1])
    length = np.linalg.norm(recording.points[:7], axis=1)
    np.testing.assert_allclose(length, [1.0, 15.0, np.nan, np.nan, np.nan, np.nan, 15.0], rtol=1e-6)


def test_beam_times(bag, messages):
    recording = read(bag([scan_at(messages, k, time_increment=0.01) for k in range(3)]))
    np.testing.assert_allclose(recording.beam_time, np.tile(0.01 * np.arange(5), 3), rtol=1e-6)


def test_upside_down_laser(bag, messages):
    """Its angles rise to the right of the robot, seen from above."""
    over = messages.transform(0, "base_link", "laser", (0.1, 0.2, 0.3), turned(0.3, np.pi))
    content = [("/tf_static", START, messages.tf(over))]
    content += [scan_at(messages, k) for k in range(2)]
    recording = read(bag(content))
    np.testing.assert_allclose(
        se2.parameters(recording.T_base_sensor), [[0.1, 0.2, 0.3]], atol=1e-9
    )
    angle = np.arctan2(recording.points[:5, 1], recording.points[:5, 0])
    np.testing.assert_allclose(angle, [0.5, 0.25, 0, -0.25, -0.5], atol=1e-6)
    assert recording.source.sensors[0].upside_down


def test_two_lasers_interleave(bag, messages):
    mounts = [
        messages.transform(0, "base_link", "front", (0.3, 0, 0)),
        messages.transform(0, "base_link", "rear", (-0.3, 0, 0), turned(np.pi)),
    ]
    content = [("/tf_static", START, messages.tf(*mounts))]
    for k in range(6):
        front, rear = START + k * SECOND, START + k * SECOND + SECOND // 3
        content.append(("/front", front, messages.scan(front, ranges_at(k), "front")))
        content.append(("/rear", rear, messages.scan(rear, ranges_at(10 + k, 3), "rear")))
    recording = read(bag(content))
    np.testing.assert_array_equal(recording.sensor, [0, 1] * 6)
    np.testing.assert_array_equal(np.diff(recording.offset), [5, 3] * 6)
    length = np.linalg.norm(recording.points, axis=1)
    np.testing.assert_allclose(length[:8], [*ranges_at(0), *ranges_at(10, 3)], rtol=1e-6)
    np.testing.assert_allclose(length[-3:], ranges_at(15, 3), rtol=1e-6)
    alone = read(bag(content, "again"), ReadOptions(topic="/rear"))
    np.testing.assert_array_equal(np.diff(alone.offset), [3] * 6)
    np.testing.assert_allclose(
        np.abs(se2.parameters(alone.T_base_sensor)), [[0.3, 0, np.pi]], atol=1e-9
    )


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        ("laser", "/b: 6 scans, /a shows the same sensor"),
        ("other", "no transform connects 'other'"),
    ],
)
def test_lasers_that_are_left_out(bag, messages, frame, why):
    content = []
    for k in range(6):
        stamp = START + k * SECOND
        content.append(("/a", stamp, messages.scan(stamp, ranges_at(k))))
        content.append(("/b", stamp, messages.scan(stamp, ranges_at(k), frame)))
    recording = read(bag(content))
    assert [s.name for s in recording.source.sensors] == ["/a"]
    assert why in recording.source.duplicates[0]


def test_a_split_bag_is_the_whole_one(bag, messages):
    """Static transforms are in the first part alone."""
    content = drive(messages, 40)
    whole = read(bag(content))
    spans = ((0, 45), (45, 80), (80, None))
    paths = [str(bag(content[slice(*span)], f"part_{k}")) for k, span in enumerate(spans)]
    joined = inputs.read(paths[::-1])
    require_same_arrays(joined, whole)
    assert joined.source.base_frame == "base_link"
    assert sum(one.scans for one in joined.source.parts) == 40
    assert joined.source.warnings == whole.source.warnings


def test_moving_laser(bag, messages):
    content = []
    for k in range(5):
        stamp = START + k * SECOND
        mount = messages.transform(stamp, "base_link", "laser", (0.1, 0, 0), turned(0.1 * k))
        move = messages.transform(stamp, "odom", "base_link", (k, 0, 0))
        content.append(("/tf", stamp, messages.tf(mount, move)))
        content.append(("/scan", stamp, messages.scan(stamp, ranges_at(k))))
    recording = read(bag(content))
    assert recording.source.base_frame == "base_link"
    places = se2.parameters(recording.T_base_sensor)[recording.sensor]
    np.testing.assert_allclose(places[:, 2], 0.1 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(se2.parameters(recording.T_odom_base)[:, 0], np.arange(5))


def test_given_frames(bag, messages):
    content = drive(messages)
    for k in range(-1, 22):
        stamp = START + k * SECOND // 20
        step = messages.transform(stamp, "map", "odom", (0, k, 0))
        content.append(("/tf", stamp, messages.tf(step)))
    path = bag(sorted(content, key=lambda one: one[1]))
    y = se2.parameters(read(path).T_odom_base)[:, 1]
    np.testing.assert_allclose(y, 0.0, atol=1e-9)
    y = se2.parameters(read(path, ReadOptions(odom_frame="map")).T_odom_base)[:, 1]
    np.testing.assert_allclose(y, 2.0 * np.arange(10) + 0.5, atol=1e-9)
    laser = read(path, ReadOptions(base_frame="laser"))
    np.testing.assert_allclose(se2.parameters(laser.T_base_sensor), 0.0, atol=1e-9)
    np.testing.assert_allclose(se2.parameters(laser.T_odom_base)[0], [0.225, 0, 0], atol=1e-9)
    with pytest.raises(
        InputError, match=r"base frame 'robot' is not in the recording \(has: base_link"
    ):
        read(path, ReadOptions(base_frame="robot"))
    with pytest.raises(InputError, match="odometry frame 'world' is not"):
        read(path, ReadOptions(odom_frame="world"))


def test_missing_topics(bag, messages):
    path = bag(drive(messages))
    with pytest.raises(InputError, match=r"topic '/sacn' is not there \(topics with scans: /scan"):
        read(path, ReadOptions(topic="/sacn"))
    with pytest.raises(InputError, match="topic '/tf' has tf2_msgs/msg/TFMessage, no scans"):
        read(path, ReadOptions(topic="/tf"))
    assert read(path, ReadOptions(topic="scan")).n_scans == 10


def test_echoes(bag, messages):
    kind, angles = "sensor_msgs/msg/MultiEchoLaserScan", (-0.5, 0.5, 0.25)
    lists = ([1.0, 3.0], [], [2.0], [np.inf], [4.0, 5.0])
    echoes = [{"echoes": np.array(e, np.float32)} for e in lists]
    limits, content = {"range_min": 0.1, "range_max": 20.0}, []
    for k in range(2):
        header = messages.header(START + k, "laser")
        scan = messages.make(kind, header, *angles, ranges=echoes, **limits)
        content.append(("/echoes", START + k, (kind, scan)))
    recording = read(bag(content))
    length = np.linalg.norm(recording.points[:5], axis=1)
    np.testing.assert_array_equal(recording.hit[:5], [1, 0, 1, 0, 1])
    np.testing.assert_allclose(length[[0, 2, 4]], [1.0, 2.0, 4.0], rtol=1e-6)


def test_damaged_mounts_of_the_first_part_are_passed_over(bag, messages):
    """Those after them count, as they do where the part itself is read."""
    content = drive(messages, 20)
    static, cut = content[0], START + 19 * SECOND // 20
    kind, _ = static[2]
    damaged = ("/tf_static", START - SECOND, (kind, b"\x01\x02\x03"))
    first = [damaged, *(one for one in content if one[1] < cut)]
    second = [one for one in content if one[1] >= cut]
    recording = inputs.read([bag(first, "first"), bag(second, "second")])
    assert recording.n_scans == 20
    np.testing.assert_allclose(se2.parameters(recording.T_base_sensor), [[0.2, 0, 0]], atol=1e-9)
