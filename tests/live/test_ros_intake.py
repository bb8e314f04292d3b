"""Scans that wait for their mount, for odometry and for other lasers; no ROS."""

import fake_ros
import numpy as np
import pytest
from ros_messages import laser_scan, odometry, point_cloud, transform

from stillmap.core import se2
from stillmap.live.ros import intake
from stillmap.live.ros.inputs import Parameters
from stillmap.live.ros.intake import ScanIntake

Transforms = fake_ros.load("transforms").Transforms

S = 10**9
POSE = {"laser_pose": (0.1, 0.0, 0.5)}
RANGES = [1.0, 2.0]


def make(**values):
    parameters = Parameters(**values)
    return ScanIntake(parameters, Transforms(parameters))


def add_odometry(scans, message):
    scans._transforms.add_odometry(message)


def add_transforms(scans, *transforms, static=False):
    buffer = scans._transforms.buffer
    for one in transforms:
        (buffer.set_transform_static if static else buffer.set_transform)(one, "test")


def take_all(scans, now):
    return list(iter(lambda: scans.take(now), None))


def stamps(arrivals):
    return [one.beams.stamp_ns for one in arrivals]


def feed(scans, *stamps_ns, topic="scan", now=0.0):
    for stamp in stamps_ns:
        scans.add_scan(topic, laser_scan(stamp, RANGES), now)


def test_a_scan_waits_for_the_odometry_around_it():
    scans = make(**POSE)
    add_odometry(scans, odometry(1 * S, x=1.0))
    feed(scans, 1 * S + S // 4)
    assert scans.take(0.0) is None
    add_odometry(scans, odometry(2 * S, x=2.0))
    arrival = scans.take(0.01)
    np.testing.assert_allclose(arrival.T_odom_base, se2.matrix(1.25, 0.0, 0.0))
    np.testing.assert_allclose(arrival.beams.T_base_sensor, se2.matrix(0.1, 0.0, 0.5))
    assert scans._transforms.source == "odom"
    assert scans.take(0.01) is None


def test_odometry_that_stops_is_waited_for_once():
    scans = make(**POSE)
    add_odometry(scans, odometry(1 * S))
    feed(scans, 1 * S)
    assert scans.take(0.0).T_odom_base is not None
    feed(scans, 2 * S, now=1.0)
    assert scans.take(1.1) is None
    assert scans.take(1.21).T_odom_base is None
    feed(scans, 3 * S, now=2.0)
    assert scans.take(2.0).T_odom_base is None
    assert scans.counts == {intake.NO_ODOMETRY: 2}
    add_odometry(scans, odometry(4 * S - 1))
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
    add_odometry(scans, odometry(2 * S))
    assert stamps(take_all(scans, 0.0)) == [2 * S]
    assert scans.counts == {intake.EARLY: 1}
    of_tf = make(**POSE)
    feed(of_tf, 1 * S, 2 * S)
    add_transforms(of_tf, transform("odom", "base_footprint", 2 * S), static=False)
    assert stamps(take_all(of_tf, 0.0)) == [2 * S]


def test_tf_has_mount_and_odometry():
    scans = make()
    add_odometry(scans, odometry(1 * S, x=9.0))
    add_transforms(
        scans,
        transform("base_footprint", "base_link", 0),
        transform("base_link", "laser", 0, x=0.2, yaw=1.0, roll=np.pi),
        static=True,
    )
    add_transforms(scans, transform("odom", "base_footprint", 1 * S, x=3.0), static=False)
    feed(scans, 1 * S)
    arrival = scans.take(0.0)
    np.testing.assert_allclose(arrival.T_odom_base, se2.matrix(3.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(arrival.beams.T_base_sensor, se2.matrix(0.2, 0.0, 1.0), atol=1e-12)
    # upside down: the first beam is on the left
    assert arrival.beams.points[0, 1] > 0.0
    assert scans._transforms.source == "TF"


def test_two_sources_of_odometry_are_not_mixed():
    scans = make(**POSE)
    add_odometry(scans, odometry(1 * S, x=9.0))
    feed(scans, 1 * S)
    assert scans.take(0.0).T_odom_base[0, 2] == 9.0
    add_transforms(scans, transform("odom", "base_footprint", 2 * S, x=3.0), static=False)
    feed(scans, 2 * S, now=1.0)
    assert scans.take(1.0) is None
    add_odometry(scans, odometry(2 * S, x=9.5))
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


def test_one_stamp_far_ahead_is_not_believed_but_a_while_of_them_is_and_a_pause():
    scans = make(odom_frame="", **POSE)
    feed(scans, 1 * S, 3600 * S, 2 * S)
    assert stamps(take_all(scans, 0.0)) == [1 * S, 2 * S]
    assert scans.counts == {intake.AHEAD: 1}
    feed(scans, 62 * S, now=60.0)
    assert stamps(take_all(scans, 60.0)) == [62 * S]
    for k in range(5):
        feed(scans, (7200 + k) * S, now=60.1 + k)
    assert stamps(take_all(scans, 65.0)) == [7203 * S, 7204 * S]


def test_a_clock_that_is_set_back_for_good():
    scans = make(odom_frame="", **POSE)
    feed(scans, 3600 * S)
    assert stamps(take_all(scans, 0.0)) == [3600 * S]
    for k in range(21):
        feed(scans, (1000 + k) * S // 10, now=0.1 * k)
    assert scans.set_back == 0.0  # not yet for 2 s
    feed(scans, 103 * S, now=2.2)
    assert scans.set_back == pytest.approx(3497.0)
    feed(scans, 104 * S, now=2.3)
    assert take_all(scans, 2.3) == []
    assert scans.counts == {intake.SET_BACK: 1, intake.BACKWARDS: 23}
    scans.begin_anew()
    feed(scans, 105 * S, now=2.4)
    assert stamps(take_all(scans, 2.4)) == [105 * S]
    assert scans.set_back == 0.0


def test_a_clock_that_catches_up_was_not_set_back():
    scans = make(odom_frame="", **POSE)
    for now, stamp in ((0.0, 100), (0.1, 50), (3.0, 50), (3.1, 101)):
        feed(scans, stamp * S, now=now)
        scans.take(now)
    assert scans.set_back == 0.0
    feed(scans, 50 * S, now=3.2)  # one laser of two has a wrong clock
    feed(scans, 104 * S, now=6.0)
    feed(scans, 53 * S, now=6.1)
    assert scans.set_back == 0.0


def test_transforms_from_before_the_clock_was_set_back_are_forgotten():
    scans = make()
    add_transforms(scans, transform("base_footprint", "laser", 0, x=0.2), static=True)
    for stamp in (100, 102):
        add_transforms(scans, transform("odom", "base_footprint", stamp * S), static=False)
    feed(scans, 102 * S)
    assert scans.take(0.0) is not None
    scans.begin_anew()
    for stamp, x in ((95, 1.0), (96, 1.0)):  # less ago than transforms are kept
        moved = transform("odom", "base_footprint", stamp * S, x=x)
        add_transforms(scans, moved, static=False)
    feed(scans, 96 * S)
    arrival = scans.take(0.0)
    assert arrival.T_odom_base[0, 2] == 1.0
    assert arrival.beams.T_base_sensor[0, 2] == pytest.approx(0.2)


def test_clouds_have_mount_and_odometry_in_space():
    scans = make(cloud_topic=("points",))
    mount = transform("base_footprint", "lidar", 0, x=0.2, roll=0.3)
    mount.transform.translation.z = 1.5
    add_transforms(scans, mount, static=True)
    odom = transform("odom", "base_footprint", 1 * S, x=3.0, roll=0.1)
    add_transforms(scans, odom, static=False)
    points = [[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [4.0, 0.0, 0.0]]
    scans.add_scan("points", point_cloud(1 * S, points, times=[0.0, 0.05, 0.1]), 0.0)
    arrival = scans.take(0.0)
    beams = arrival.beams
    np.testing.assert_allclose(beams.points[[0, 2]], [points[0], points[2]])
    np.testing.assert_array_equal(beams.hit, [True, False, True])
    np.testing.assert_allclose(beams.beam_time, [0.0, 0.05, 0.1], atol=1e-6)
    assert (beams.sensor, beams.stamp_ns) == ("points", 1 * S)
    assert beams.T_base_sensor[2, 3] == 1.5
    assert beams.T_base_sensor[2, 1] == pytest.approx(np.sin(0.3))
    assert arrival.T_odom_base.shape == (4, 4)
    assert arrival.T_odom_base[2, 1] == pytest.approx(np.sin(0.1))
    add_odometry(scans, odometry(2 * S))
    broken = point_cloud(2 * S, points)
    broken.fields = broken.fields[:2]
    scans.add_scan("points", broken, 0.0)
    assert scans.counts == {"cloud without x, y and z": 1}


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


def test_the_queue_has_an_end_and_scans_may_be_left_out():
    scans = make(scan_queue_size=3, **POSE)
    feed(scans, *range(S, 6 * S, S))
    assert scans.counts == {intake.OVERFLOW: 2}
    assert stamps(take_all(scans, 2.1))[0] == 3 * S
    scans = make(odom_frame="", throttle_scans=3, **POSE)
    feed(scans, *range(S, 8 * S, S))
    assert stamps(take_all(scans, 0.0)) == [1 * S, 4 * S, 7 * S]
    assert not scans.counts


@pytest.mark.parametrize("x", [np.nan, 1e12])
def test_odometry_that_is_none(x):
    scans = make(**POSE)
    add_odometry(scans, odometry(1 * S, x=x))
    feed(scans, 1 * S)
    assert scans.take(1.9) is None
    assert scans.take(2.1).T_odom_base is None
