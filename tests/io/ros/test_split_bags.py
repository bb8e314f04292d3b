"""Bags that a recorder split: parts of one run, with static transforms in the first alone."""

import numpy as np
import pytest
from small_bags import FLOAT, cloud_message

from stillmap.io import read
from stillmap.io.input_groups import group_inputs
from stillmap.pipeline import inputs

START, PERIOD, T = 1_600_000_000_000_000_000, 100_000_000, 40  # ns, ns, scans


def pose_at(stamp):
    """Where the robot is: it drives 0.5 m/s along a curve."""
    seconds = (stamp - START) / 1e9
    return (0.5 * seconds, 0.02 * seconds**2, 0.0), 0.08 * seconds


def content_of(messages, seed=1):
    """Scans of a laser and odometry between them, as TF; the laser's place first."""
    rng = np.random.default_rng(seed)
    place = messages.transform(START, "base_link", "laser", *messages.pose((0.3, 0.1, 0.5), 0.2))
    out = [("/tf_static", START - 10**9, messages.tf(place))]
    for k in range(T):
        stamp = START + PERIOD * k
        out.append(("/scan", stamp + 10**6, messages.scan(stamp, rng.uniform(1.0, 9.0, 12))))
        for late in (0, PERIOD // 2):
            pose = messages.pose(*pose_at(stamp + late))
            moved = messages.transform(stamp + late, "odom", "base_link", *pose)
            out.append(("/tf", stamp + late + 2 * 10**6, messages.tf(moved)))
    return out


def between(content, first, last):
    """The messages that a recorder gets between scans `first` and `last`."""
    limits = START + PERIOD * first, START + PERIOD * last
    return [one for one in content if limits[0] <= one[1] < limits[1]]


def require_equal(a, b):
    for name in ("stamp_ns", "offset", "points", "hit", "T_base_sensor", "T_odom_base", "sensor"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_a_split_bag_is_the_whole_one(bag, messages):
    content = content_of(messages)
    whole = read(bag(content))
    spans = ((-20, 15), (15, 26), (26, T))
    paths = [
        str(bag(between(content, *span), f"part_{number}")) for number, span in enumerate(spans)
    ]
    joined = inputs.read(paths[::-1])
    require_equal(joined, whole)
    assert joined.source["base_frame"] == "base_link"
    assert [one["scans"] for one in joined.source["parts"]] == [15, 11, 14]
    assert joined.source["warnings"] == whole.source["warnings"]


def test_messages_of_the_part_before_are_read_once(bag, messages):
    content = content_of(messages)
    whole = read(bag(content))
    paths = [
        str(bag(between(content, *span), f"part_{number}"))
        for number, span in enumerate(((-20, 22), (15, T)))
    ]
    [group] = group_inputs(paths)
    assert "repeats the last 7 scans" in group.why
    joined = inputs.read(paths)
    require_equal(joined, whole)
    assert joined.source["duplicates"] == ["21 messages that earlier parts hold already"]
    assert not joined.source["skipped"]


def test_a_part_that_a_crash_has_cut_is_read_as_far_as_it_goes(bag, messages, kind):
    if kind in ("folder", "db3"):
        pytest.skip("their files have no end that could be missing")
    content = content_of(messages)
    first, second = (
        bag(between(content, *span), f"part_{number}")
        for number, span in enumerate(((-20, 20), (20, T)))
    )
    data = second.read_bytes()
    second.write_bytes(data[: int(0.9 * len(data))])
    joined = inputs.read([second, first])
    assert joined.n_scans > 20
    assert any("cut or damaged" in text for text in joined.source["warnings"])
    np.testing.assert_allclose(joined.T_base_sensor[0, :2, 2], [0.3, 0.1])


def test_robots_at_the_same_time_are_sessions(bag, messages):
    paths = [str(bag(content_of(messages, seed), f"robot_{seed}")) for seed in (1, 2)]
    one, other = group_inputs(paths)
    assert (one.paths, other.paths) == ((paths[0],), (paths[1],))
    assert "is of the same time" in other.why


def test_a_robot_that_starts_anew_begins_a_session(bag, messages):
    content = content_of(messages)
    first = bag(between(content, -20, 30), "first")
    again = [
        (topic, log_ns + 31 * PERIOD, message)
        for topic, log_ns, message in content_of(messages, seed=2)
        if topic == "/tf_static"
    ]
    for k in range(10):
        stamp = START + PERIOD * (31 + k)
        again.append(("/scan", stamp, messages.scan(stamp, np.full(12, 2.0 + 0.1 * k))))
        pose = messages.pose(*pose_at(START + PERIOD * k))
        again.append(
            ("/tf", stamp, messages.tf(messages.transform(stamp, "odom", "base_link", *pose)))
        )
    groups = group_inputs([str(first), str(bag(again, "second"))])
    assert [group.kind for group in groups] == ["recording", "recording"]
    assert "odometry that begins 1.4" in groups[1].why


def test_images_of_both_parts_are_found(bag, messages):
    def image(stamp, value):
        kind = "sensor_msgs/msg/Image"
        pixels = np.full(12, value, np.uint8)
        header = messages.header(stamp, "camera")
        return kind, messages.make(kind, header, 3, 4, "mono8", 0, 4, pixels)

    content = []
    for k in range(10):
        stamp = START + PERIOD * k
        columns = [(axis, FLOAT, 1.0 + k + np.arange(9.0)) for axis in "xyz"]
        content.append(("/points", stamp, cloud_message(messages, stamp, columns)))
        content.append(("/camera/image_raw", stamp + 10, image(stamp + 10, k)))
    half = len(content) // 2
    paths = [bag(content[half:], "second"), bag(content[:half], "first")]
    joined = inputs.read(paths)
    assert joined.n_scans == len(joined.images) == 10
    assert [int(joined.images.read(k)[0, 0]) for k in (0, 4, 5, 9)] == [0, 4, 5, 9]
