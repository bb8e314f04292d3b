"""What the node says, without ROS: publishers are lists, messages objects that take any field."""

import math
from types import SimpleNamespace as Fields
from unittest.mock import MagicMock

import numpy as np
import pytest
from ros_messages import laser_scan, point_cloud

from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.live.causal_labels import MapChange
from stillmap.live.movers import Mover
from stillmap.live.ros.messages import Mount, to_cloud_beams, to_scan_beams
from stillmap.live.ros.parameters import Parameters
from stillmap.live.ros.publishers import MapPublisher, Publishers
from stillmap.live.update import Update

NAN = math.nan


class FakeRos:
    """Publishers that keep what is published, by topic; `missing` packages are not there."""

    def __init__(self, *missing):
        self.missing, self.sent, self.listeners = missing, {}, 1
        self.tf2_ros = Fields(TransformBroadcaster=self.make_broadcaster)

    def message(self, name):
        return None if name.split("/")[0] in self.missing else MagicMock

    def geometry(self, _):
        return MagicMock

    def module(self, _):
        return MagicMock()

    def create_publisher(self, _, topic, __):
        self.sent[topic] = []
        return Fields(
            publish=self.sent[topic].append, get_subscription_count=lambda: self.listeners
        )

    def make_broadcaster(self, _):
        return Fields(sendTransform=self.sent.setdefault("/tf", []).append)

    def get_logger(self):
        return MagicMock()


def publishers(ros, **parameters):
    return Publishers(ros, ros, Parameters(**parameters))


def map_publisher(ros):
    return MapPublisher(ros, ros, Parameters(), "trinary")


def heading(q):
    return 2.0 * math.atan2(q.z, q.w)


def make_mover(number, position=(1.0, 2.0), velocity=(0.0, 1.0)):
    n = 2 * len(position)
    return Mover(number, np.array(position), np.array(velocity), np.eye(n), 0.3, 2.0)


class TestMovers:
    def test_each_has_a_body_an_arrow_and_its_number(self):
        ros = FakeRos()
        publishers(ros)._publish_movers([make_mover(7)], 3_000_000_005)
        (message,) = ros.sent["movers"]
        body, arrow, text = message.markers
        assert {m.id for m in message.markers} == {7}
        assert len({m.ns for m in message.markers}) == 3
        assert (body.header.frame_id, body.header.stamp.sec) == ("map", 3)
        assert (body.type, arrow.type, text.type) == (3, 0, 9)
        assert (body.pose.position.x, body.pose.position.y) == (1.0, 2.0)
        assert (body.scale.x, body.scale.y) == (0.6, 0.6)
        begin, end = arrow.points
        assert (end.x - begin.x, end.y - begin.y, end.z - begin.z) == (0.0, 1.0, 0.0)
        assert text.text == "7"
        assert text.pose.position.z > body.pose.position.z
        assert all(m.lifetime.sec > 0 and m.pose.orientation.w == 1.0 for m in message.markers)

    def test_markers_of_those_that_are_gone_are_removed_once(self):
        ros = FakeRos()
        publisher = publishers(ros)
        for movers in ([make_mover(1), make_mover(2)], [make_mover(2)], [], []):
            publisher._publish_movers(movers, 1)
        deleted = [[m.id for m in one.markers if m.action == 2] for one in ros.sent["movers"]]
        assert deleted == [[], [1, 1, 1], [2, 2, 2]]

    def test_poses_are_headed_where_they_move_and_tell_that_there_is_nobody(self):
        ros = FakeRos()
        publisher = publishers(ros)
        publisher._publish_movers([make_mover(1)], 1)
        publisher._publish_movers([], 2)
        first, second = ros.sent["mover_poses"]
        (pose,) = first.poses
        q = pose.orientation
        assert 2.0 * math.atan2(q.z, q.w) == pytest.approx(math.pi / 2)
        assert second.poses == []

    def test_in_space_they_have_their_own_height(self):
        ros = FakeRos()
        mover = make_mover(1, (1.0, 2.0, 3.0), (0.0, 0.0, 0.5))
        publishers(ros)._publish_movers([mover], 1)
        body, arrow, _ = ros.sent["movers"][0].markers
        assert body.pose.position.z == 3.0
        assert arrow.points[1].z == 3.5

    def test_nothing_is_sent_where_nobody_listens(self):
        ros = FakeRos()
        ros.listeners = 0
        publishers(ros)._publish_movers([make_mover(1)], 1)
        assert not any(ros.sent.values())


class TestMap:
    def grid(self, rows=4, columns=6):
        return GridMap(np.zeros((rows, columns), np.float32), (-0.5, 1.0, 0.0), 0.1)

    def change(self, x, y, value, n=2):
        return MapChange(np.array([x, y]), np.full((n, n), value, np.float32))

    def test_what_changed_is_one_rectangle_of_the_last_whole_map(self):
        ros = FakeRos()
        publisher = map_publisher(ros)
        publisher.publish(self.grid(), 1)
        changes = [self.change(-5, 10, 1.0), self.change(-2, 12, NAN)]
        assert publisher.publish_changes(changes, 2_000_000_000)
        (update,) = ros.sent["map_updates"]
        assert (update.x, update.y, update.width, update.height) == (0, 0, 5, 4)
        cells = np.array(update.data).reshape(4, 5)
        expected = np.zeros((4, 5))
        expected[:2, :2], expected[2:, 3:] = 100, -1
        np.testing.assert_array_equal(cells, expected)
        assert update.header.stamp.sec == 2
        # what was sent before stays
        assert publisher.publish_changes([self.change(-4, 11, 0.0)], 2_900_000_000)
        assert len(ros.sent["map_updates"]) == 1  # once a second
        assert publisher.publish_changes([], 3_000_000_000)
        update = ros.sent["map_updates"][1]
        assert (update.x, update.y) == (1, 1)
        np.testing.assert_array_equal(np.array(update.data), [0, 0, 0, 0])
        clock_set_back = 5
        assert publisher.publish_changes([self.change(-5, 10, 0.5, n=3)], clock_set_back)
        np.testing.assert_array_equal(np.array(ros.sent["map_updates"][2].data), [-1] * 9)

    @pytest.mark.parametrize("at", [(-6, 10), (0, 12), (-5, 9), (-5, 13)])
    def test_a_whole_map_is_due_where_it_has_grown(self, at):
        ros = FakeRos()
        publisher = map_publisher(ros)
        assert not publisher.publish_changes([self.change(0, 0, 1.0)], 1)  # there is none yet
        publisher.publish(self.grid(), 1)
        assert not publisher.publish_changes([self.change(*at, 1.0)], 2_000_000_000)
        assert not ros.sent["map_updates"]
        ros.listeners = 0  # to updates: the whole map comes when it is due
        assert publisher.publish_changes([self.change(*at, 1.0)], 4_000_000_000)

    def test_the_whole_map(self):
        ros = FakeRos()
        grid = GridMap(np.array([[0.0, 1.0, NAN]], np.float32), (-2.0, 3.0, 0.0), 0.05)
        map_publisher(ros).publish(grid, 7_000_000_009)
        (out,) = ros.sent["map"]
        assert (out.info.width, out.info.height, out.info.resolution) == (3, 1, 0.05)
        assert (out.info.origin.position.x, out.info.origin.position.y) == (-2.0, 3.0)
        assert out.info.origin.orientation.w == 1.0
        assert out.data.typecode == "b"
        assert list(out.data) == [0, 100, -1]
        assert (out.header.frame_id, out.header.stamp.sec) == ("map", 7)

    def test_without_map_msgs(self):
        ros = FakeRos("map_msgs")
        publisher = map_publisher(ros)
        publisher.publish(self.grid(), 1)
        assert publisher.publish_changes([self.change(50, 50, 1.0)], 2)
        assert list(ros.sent) == ["map"]


def read_cloud(message):
    """(n, 4) the values of a PointCloud2 with four fields."""
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        (name, 4 * k, 7, 1) for k, name in enumerate(("x", "y", "z", "p_static"))
    ]
    assert message.data.typecode == "B"
    values = np.frombuffer(message.data.tobytes(), "<f4").reshape(-1, 4)
    assert (message.height, message.width) == (1, len(values))
    assert (message.point_step, message.row_step) == (16, 16 * len(values))
    return values


class TestScans:
    def test_points_of_a_laser_are_in_its_own_frame(self):
        """Upside down too: the frame is, not the message."""
        ros = FakeRos()
        message = laser_scan(5_000_000_001, [1.0, math.inf, 2.0, 3.0], angle_min=0.0)
        beams = to_scan_beams(message, "scan", Mount(np.eye(3), is_upside_down=True))
        arrival = Fields(topic="scan", message=message, beams=beams)
        p_static = np.array([0.9, 0.5, 0.2, NAN], np.float32)
        publishers(ros)._publish_scan(arrival, p_static)
        (cloud,) = ros.sent["scan_points"]
        assert (cloud.header.frame_id, cloud.header.stamp.sec) == ("laser", 5)
        expected = [[1.0, 0.0, 0.0, 0.9], [2 * np.cos(0.2), 2 * np.sin(0.2), 0.0, 0.2]]
        np.testing.assert_allclose(read_cloud(cloud), expected, rtol=1e-6)
        assert list(ros.sent["scan_static"][0].ranges)[2] == math.inf
        assert list(ros.sent["scan_dynamic"][0].ranges)[2] == 2.0

    def test_clouds_are_split_as_clouds(self):
        ros = FakeRos()
        points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [NAN, 0.0, 0.0], [0.0, 90.0, 0.0]]
        message = point_cloud(5, points)
        beams = to_cloud_beams(message, "points", Mount(np.eye(4)), max_range=50.0)
        np.testing.assert_array_equal(beams.hit, [True, True, False, False])
        np.testing.assert_allclose(beams.points[3], [0.0, 50.0, 0.0])
        arrival = Fields(topic="points", message=message, beams=beams)
        p_static = np.array([0.9, 0.1, NAN, 0.5], np.float32)
        publishers(ros, cloud_topic="points")._publish_scan(arrival, p_static)
        static, dynamic, every = (
            read_cloud(ros.sent[f"points_{name}"][0]) for name in ("static", "dynamic", "points")
        )
        np.testing.assert_allclose(static, [[1.0, 2.0, 3.0, 0.9]], rtol=1e-6)
        np.testing.assert_allclose(dynamic, [[4.0, 5.0, 6.0, 0.1]], rtol=1e-6)
        np.testing.assert_allclose(every, np.concatenate([static, dynamic]))


class TestPoses:
    def publish(self, ros, T, covariance, T_map_odom, doubts=()):
        message = laser_scan(5_000_000_001, [1.0])
        beams = to_scan_beams(message, "scan", Mount(np.eye(3)))
        update = Update(T, covariance, np.ones(1, np.float32), T_map_odom, doubts)
        arrival = Fields(topic="scan", message=message, beams=beams)
        publishers(ros).publish_answer(arrival, update)

    def test_in_the_plane(self):
        ros, T = FakeRos(), se2.matrix(1.0, -2.0, -3.0)
        self.publish(ros, T, np.arange(9.0).reshape(3, 3), se2.matrix(3.0, 4.0, 0.5))
        (pose,), (transform,) = ros.sent["pose"], ros.sent["/tf"]
        assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (1.0, -2.0)
        assert pose.pose.pose.position.z == 0.0
        assert heading(pose.pose.pose.orientation) == pytest.approx(-3.0)
        covariance = np.reshape(pose.pose.covariance, (6, 6))
        rows = np.ix_([0, 1, 5], [0, 1, 5])
        np.testing.assert_array_equal(covariance[rows].ravel(), np.arange(9.0))
        assert np.count_nonzero(covariance) == 8
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
        assert transform.header.stamp.nanosec == 200_000_001  # it holds a little longer
        assert (transform.transform.translation.x, transform.transform.translation.y) == (3.0, 4.0)
        assert heading(transform.transform.rotation) == pytest.approx(0.5)

    def test_in_space(self):
        ros, T = FakeRos(), np.eye(4)
        T[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
        T[:3, 3] = 1.0, 2.0, 3.0
        self.publish(ros, T, np.arange(36.0).reshape(6, 6), None)
        (pose,) = ros.sent["pose"]
        q = pose.pose.pose.orientation
        assert pose.pose.pose.position.z == 3.0
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0.5**0.5, 0.0, 0.0, 0.5**0.5])
        np.testing.assert_array_equal(pose.pose.covariance, np.arange(36.0))
        assert ros.sent["/tf"] == []  # this scan had no odometry

    def test_nothing_in_the_map_while_the_robot_is_lost(self):
        ros = FakeRos()
        self.publish(ros, np.eye(3), np.eye(3), np.eye(3), ("lost",))
        assert ros.sent["pose"] == ros.sent["/tf"] == []
