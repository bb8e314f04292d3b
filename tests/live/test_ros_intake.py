"""Scans that wait for their mount, for odometry and for other lasers; no ROS."""

import numpy as np
import pytest
from ros_messages import laser_scan, odometry, tf, transform

from stillmap.core import se2
from stillmap.live.ros import intake
from stillmap.live.ros.intake import ScanIntake
from stillmap.live.ros.parameters import Parameters
from stillmap.live.ros.transforms import TransformBuffer, to_plane

S = 10**9
POSE = {"laser_pose": (0.1, 0.0, 0.5)}
RANGES = [1.0, 2.0]


def make(**values):
    return ScanIntake(Parameters(**values))


def take_all(scans, now):
    return list(iter(lambda: scans.take(now), None))


def stamps(arrivals):
    return [one.beams.stamp_ns for one in arrivals]


def feed(scans, *stamps_ns, topic="scan", now=0.0):
    for stamp in stamps_ns:
        scans.add_scan(topic, laser_scan(stamp, RANGES), now)


def test_a_scan_waits_for_the_odometry_around_it():
    scans = make(**POSE)
    scans.add_odometry(odometry(1 * S, x=1.0))
    feed(scans, 1 * S + S // 4)
    assert scans.take(0.0) is None
    scans.add_odometry(odometry(2 * S, x=2.0))
    arrival = scans.take(0.01)
    np.testing.assert_allclose(arrival.T_odom_base, se2.matrix(1.25, 0.0, 0.0))
    np.testing.assert_allclose(arrival.beams.T_base_sensor, se2.matrix(0.1, 0.0, 0.5))
    assert scans.odometry.source == "odom"
    assert scans.take(0.01) is None


def test_odometry_that_stops_is_waited_for_once():
    scans = make(**POSE)
    scans.add_odometry(odometry(1 * S))
    feed(scans, 1 * S)
    assert scans.take(0.0).T_odom_base is not None
    feed(scans, 2 * S, now=1.0)
    assert scans.take(1.1) is None
    assert scans.take(1.21).T_odom_base is None
    feed(scans, 3 * S, now=2.0)
    assert scans.take(2.0).T_odom_base is None
    assert scans.counts == {intake.NO_ODOMETRY: 2}
    scans.add_odometry(odometry(4 * S - 1))
    feed(scans, 4 * S, now=3.0)  # it has come again
    assert scans.take(3.0) is None


def test_the_first_scans_wait_longer_for_odometry():
    scans = make(**POSE)
    feed(scans, 1 * S)
    assert scans.take(1.9) is None
    assert scans.take(2.1).T_odom_base is None


def test_mapping_begins_with_odometry():
    scans = make(**POSE)
    feed(scans, 1 * S, 2 * S)
    scans.add_odometry(odometry(2 * S))
    assert stamps(take_all(scans, 0.0)) == [2 * S]
    assert scans.counts == {intake.EARLY: 1}
    of_tf = make(**POSE)
    feed(of_tf, 1 * S, 2 * S)
    of_tf.add_transforms(tf(transform("odom", "base_footprint", 2 * S)), static=False)
    assert stamps(take_all(of_tf, 0.0)) == [2 * S]


def test_a_robot_without_odometry():
    scans = make(odom_frame="", **POSE)
    feed(scans, 1 * S)
    assert scans.take(0.0).T_odom_base is None
    assert not scans.counts


def test_tf_has_mount_and_odometry():
    scans = make()
    scans.add_odometry(odometry(1 * S, x=9.0))
    scans.add_transforms(
        tf(
            transform("base_footprint", "base_link", 0),
            transform("base_link", "laser", 0, x=0.2, yaw=1.0, roll=np.pi),
        ),
        static=True,
    )
    scans.add_transforms(tf(transform("odom", "base_footprint", 1 * S, x=3.0)), static=False)
    feed(scans, 1 * S)
    arrival = scans.take(0.0)
    np.testing.assert_allclose(arrival.T_odom_base, se2.matrix(3.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(arrival.beams.T_base_sensor, se2.matrix(0.2, 0.0, 1.0), atol=1e-12)
    # upside down: the first beam is on the left
    assert arrival.beams.points[0, 1] > 0.0
    assert scans.odometry.source == "TF"


def test_two_sources_of_odometry_are_not_mixed():
    scans = make(**POSE)
    scans.add_odometry(odometry(1 * S, x=9.0))
    feed(scans, 1 * S)
    assert scans.take(0.0).T_odom_base[0, 2] == 9.0
    scans.add_transforms(tf(transform("odom", "base_footprint", 2 * S, x=3.0)), static=False)
    feed(scans, 2 * S, now=1.0)
    assert scans.take(1.0) is None
    scans.add_odometry(odometry(2 * S, x=9.5))
    assert scans.take(1.0).T_odom_base[0, 2] == 9.5


def test_a_laser_that_nobody_has_placed_is_left_out():
    scans = make(odom_frame="")
    feed(scans, 1 * S)
    assert scans.take(0.1) is None
    assert scans.take(0.3) is None
    assert scans.counts == {intake.NO_MOUNT: 1}
    scans.add_scan("scan", laser_scan(2 * S, RANGES, frame="base_footprint"), 1.0)
    np.testing.assert_array_equal(scans.take(1.0).beams.T_base_sensor, np.eye(3))


def test_stamps_that_run_backwards_or_repeat():
    scans = make(odom_frame="", **POSE)
    for stamp in (2 * S, 3 * S, 3 * S, 1 * S, 4 * S):
        feed(scans, stamp)
        scans.take(0.0)
    assert scans.counts == {intake.REPEATED: 1, intake.BACKWARDS: 1}
    feed(scans, 0)
    assert scans.counts[intake.NO_STAMP] == 1


def test_one_stamp_far_ahead_is_not_believed_but_two_are():
    scans = make(odom_frame="", **POSE)
    feed(scans, 1 * S, 3600 * S, 2 * S)
    assert stamps(take_all(scans, 0.0)) == [1 * S, 2 * S]
    assert scans.counts == {intake.AHEAD: 1}
    feed(scans, 7200 * S, 7201 * S, 7202 * S)
    assert stamps(take_all(scans, 0.0)) == [7201 * S, 7202 * S]


def test_a_pause_of_the_robot_is_no_leap():
    scans = make(odom_frame="", **POSE)
    feed(scans, 1 * S)
    feed(scans, 61 * S, now=60.0)
    assert stamps(take_all(scans, 60.0)) == [1 * S, 61 * S]


def test_two_lasers_are_put_in_order():
    scans = make(scan_topic=("a", "b"), odom_frame="", laser_pose=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    feed(scans, 100 * S, topic="a")
    feed(scans, 101 * S, topic="b")
    assert stamps(take_all(scans, 0.0)) == [100 * S]
    feed(scans, 102 * S, topic="b")
    assert take_all(scans, 0.0) == []  # `a` may still tell of an earlier time
    feed(scans, 101 * S, topic="a")
    found = take_all(scans, 0.0)
    assert stamps(found) == [101 * S, 101 * S]
    assert {one.topic for one in found} == {"a", "b"}
    assert {one.beams.T_base_sensor[0, 2] for one in found} == {0.0, 1.0}


def test_a_laser_that_died_is_not_waited_for():
    scans = make(scan_topic=("a", "b"), odom_frame="", laser_pose=(0.0,) * 6)
    feed(scans, 100 * S, topic="a")
    feed(scans, 102 * S, topic="b", now=2.0)
    assert stamps(take_all(scans, 2.0)) == [100 * S, 102 * S]


def test_the_queue_has_an_end():
    scans = make(scan_queue_size=3, **POSE)
    feed(scans, *range(S, 6 * S, S))
    assert scans.counts == {intake.OVERFLOW: 2}
    assert stamps(take_all(scans, 2.1))[0] == 3 * S


def test_every_third_scan():
    scans = make(odom_frame="", throttle_scans=3, **POSE)
    feed(scans, *range(S, 8 * S, S))
    assert stamps(take_all(scans, 0.0)) == [1 * S, 4 * S, 7 * S]


def test_what_we_say_ourselves_is_not_taken_for_odometry():
    scans = make(map_frame="world")
    scans.add_transforms(tf(transform("world", "odom", 1, x=5.0)), static=False)
    assert scans.transforms.frames == set()


class TestTransforms:
    def add(self, buffer, parent, child, stamp, x, yaw=0.0, static=False):
        values = (x, 0.0, 0.0, 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
        assert buffer.add(parent, child, stamp, values, static=static)

    def test_between_two_stamps_on_the_shorter_arc(self):
        buffer = TransformBuffer(30 * S)
        self.add(buffer, "odom", "base", 0, 0.0, yaw=3.0)
        self.add(buffer, "odom", "base", S, 1.0, yaw=-3.0)
        x, _, yaw = se2.parameters(to_plane(buffer.lookup("odom", "base", S // 2)))
        assert x == pytest.approx(0.5)
        assert abs(yaw) == pytest.approx(np.pi)

    def test_not_outside_what_is_known(self):
        buffer = TransformBuffer(30 * S)
        self.add(buffer, "odom", "base", S, 0.0)
        self.add(buffer, "odom", "base", 2 * S, 1.0)
        assert buffer.lookup("odom", "base", S - 1) is None
        assert buffer.lookup("odom", "base", 2 * S + 1) is None
        assert buffer.lookup("map", "base", S) is None
        self.add(buffer, "odom", "base", 40 * S, 1.0)
        assert buffer.lookup("odom", "base", 2 * S) is None  # forgotten

    def test_through_a_common_parent(self):
        buffer = TransformBuffer(30 * S)
        self.add(buffer, "base", "left", 0, 1.0, static=True)
        self.add(buffer, "base", "right", 0, -1.0, static=True)
        assert buffer.lookup("left", "right", 5)[0, 3] == -2.0

    def test_out_of_order_and_time_that_begins_anew(self):
        buffer = TransformBuffer(30 * S)
        for stamp in (100, 102, 101):
            self.add(buffer, "odom", "base", stamp * S, float(stamp))
        assert buffer.lookup("odom", "base", 101 * S)[0, 3] == 101.0
        self.add(buffer, "odom", "base", 1 * S, 1.0)
        assert buffer.lookup("odom", "base", 101 * S) is None
        assert buffer.lookup("odom", "base", 1 * S)[0, 3] == 1.0

    @pytest.mark.parametrize(
        "values",
        [
            (0.0,) * 7,
            (np.nan, 0, 0, 0, 0, 0, 1),
            (0, 0, 0, np.nan, 0, 0, 1),
            (1e12, 0, 0, 0, 0, 0, 1),
        ],
    )
    def test_what_is_no_transform(self, values):
        assert not TransformBuffer(S).add("odom", "base", 0, values, static=False)
