"""What the node says, without ROS: publishers are lists, messages objects that take any field."""

import math
from types import SimpleNamespace

import fake_ros
import numpy as np
import pytest
from fake_ros import Node
from ros_messages import laser_scan, point_cloud

from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.live.causal_labels import MapChange
from stillmap.live.movers import Mover
from stillmap.live.ros.inputs import Mount, Parameters, to_scan_beams
from stillmap.live.update import Update

module = fake_ros.load("publishers")
module.TransformBroadcaster = fake_ros.Broadcaster

NAN = math.nan


def publishers(node, **parameters):
    return module.Publishers(node, Parameters(**parameters))


@pytest.fixture
def node():
    return Node()


@pytest.fixture
def map_publisher(node):
    return module.MapPublisher(node, Parameters(), "trinary")


def heading(q):
    return 2.0 * math.atan2(q.z, q.w)


def make_mover(number, position=(1.0, 2.0), velocity=(0.0, 1.0)):
    n = 2 * len(position)
    return Mover(number, np.array(position), np.array(velocity), np.eye(n), 0.3, 2.0)


class TestMovers:
    def test_each_has_a_body_and_an_arrow_in_place_of_earlier_ones(self, node):
        publishers(node)._publish_movers([make_mover(7)], 3_000_000_005)
        (message,) = node.sent["movers"]
        remove, body, arrow = message.markers
        assert remove.action == 3
        assert (body.id, arrow.id) == (7, 7)
        assert body.ns != arrow.ns
        assert (body.header.frame_id, body.header.stamp.sec) == ("map", 3)
        assert (body.type, arrow.type) == (3, 0)
        assert (body.pose.position.x, body.pose.position.y) == (1.0, 2.0)
        assert (body.scale.x, body.scale.y) == (0.6, 0.6)
        begin, end = arrow.points
        assert (end.x - begin.x, end.y - begin.y, end.z - begin.z) == (0.0, 1.0, 0.0)
        assert all(m.lifetime.sec > 0 and m.pose.orientation.w == 1.0 for m in (body, arrow))

    def test_poses_are_headed_where_they_move_and_tell_that_there_is_nobody(self, node):
        publisher = publishers(node)
        publisher._publish_movers([make_mover(1)], 1)
        publisher._publish_movers([], 2)
        node.listeners = 0
        publisher._publish_movers([make_mover(1)], 3)
        first, second = node.sent["mover_poses"]
        assert heading(first.poses[0].orientation) == pytest.approx(math.pi / 2)
        assert second.poses == []

    def test_in_space_they_have_their_own_height(self, node):
        mover = make_mover(1, (1.0, 2.0, 3.0), (0.0, 0.0, 0.5))
        publishers(node)._publish_movers([mover], 1)
        _, body, arrow = node.sent["movers"][0].markers
        assert body.pose.position.z == 3.0
        assert arrow.points[1].z == 3.5


class TestMap:
    def grid(self, rows=4, columns=6):
        return GridMap(np.zeros((rows, columns), np.float32), (-0.5, 1.0, 0.0), 0.1)

    def change(self, x, y, value, n=2):
        return MapChange(np.array([x, y]), np.full((n, n), value, np.float32))

    def test_what_changed_is_one_rectangle_of_the_last_whole_map(self, map_publisher, node):
        map_publisher.publish(self.grid(), 1)
        changes = [self.change(-5, 10, 1.0), self.change(-2, 12, NAN)]
        assert map_publisher.publish_changes(changes, 2_000_000_000)
        (update,) = node.sent["map_updates"]
        assert (update.x, update.y, update.width, update.height) == (0, 0, 5, 4)
        cells = np.array(update.data).reshape(4, 5)
        expected = np.zeros((4, 5))
        expected[:2, :2], expected[2:, 3:] = 100, -1
        np.testing.assert_array_equal(cells, expected)
        assert update.header.stamp.sec == 2
        # what was sent before stays
        assert map_publisher.publish_changes([self.change(-4, 11, 0.0)], 2_900_000_000)
        assert len(node.sent["map_updates"]) == 1  # once a second
        assert map_publisher.publish_changes([], 3_000_000_000)
        update = node.sent["map_updates"][1]
        assert (update.x, update.y) == (1, 1)
        np.testing.assert_array_equal(np.array(update.data), [0, 0, 0, 0])
        clock_set_back = 5
        assert map_publisher.publish_changes([self.change(-5, 10, 0.5, n=3)], clock_set_back)
        np.testing.assert_array_equal(np.array(node.sent["map_updates"][2].data), [-1] * 9)

    @pytest.mark.parametrize("at", [(-6, 10), (0, 12), (-5, 9), (-5, 13)])
    def test_a_whole_map_is_due_where_it_has_grown(self, at, map_publisher, node):
        assert not map_publisher.publish_changes([self.change(0, 0, 1.0)], 1)  # there is none yet
        map_publisher.publish(self.grid(), 1)
        assert not map_publisher.publish_changes([self.change(*at, 1.0)], 2_000_000_000)
        assert not node.sent["map_updates"]
        node.listeners = 0  # to updates: the whole map comes when it is due
        assert map_publisher.publish_changes([self.change(*at, 1.0)], 4_000_000_000)

    def test_the_whole_map(self, map_publisher, node):
        grid = GridMap(np.array([[0.0, 1.0, NAN]], np.float32), (-2.0, 3.0, 0.0), 0.05)
        map_publisher.publish(grid, 7_000_000_009)
        (out,) = node.sent["map"]
        assert (out.info.width, out.info.height, out.info.resolution) == (3, 1, 0.05)
        assert (out.info.origin.position.x, out.info.origin.position.y) == (-2.0, 3.0)
        assert out.info.origin.orientation.w == 1.0
        assert out.data.typecode == "b"
        assert list(out.data) == [0, 100, -1]
        assert (out.header.frame_id, out.header.stamp.sec) == ("map", 7)

    def test_without_map_msgs(self, monkeypatch, node):
        monkeypatch.setattr(module, "OccupancyGridUpdate", None)
        publisher = module.MapPublisher(node, Parameters(), "trinary")
        publisher.publish(self.grid(), 1)
        assert publisher.publish_changes([self.change(50, 50, 1.0)], 2)
        assert list(node.sent) == ["map"]


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
    def test_points_of_a_laser_are_in_its_own_frame(self, node):
        """Upside down too: the frame is, not the message."""
        message = laser_scan(5_000_000_001, [1.0, math.inf, 2.0, 3.0], angle_min=0.0)
        beams = to_scan_beams(message, "scan", Mount(np.eye(3), is_upside_down=True), Parameters())
        arrival = SimpleNamespace(topic="scan", message=message, beams=beams)
        p_static = np.array([0.9, 0.5, 0.2, NAN], np.float32)
        publishers(node)._publish_scan(arrival, p_static)
        (cloud,) = node.sent["scan_points"]
        assert (cloud.header.frame_id, cloud.header.stamp.sec) == ("laser", 5)
        expected = [[1.0, 0.0, 0.0, 0.9], [2 * np.cos(0.2), 2 * np.sin(0.2), 0.0, 0.2]]
        np.testing.assert_allclose(read_cloud(cloud), expected, rtol=1e-6)
        assert list(node.sent["scan_static"][0].ranges)[2] == math.inf
        assert list(node.sent["scan_dynamic"][0].ranges)[2] == 2.0

    def test_clouds_are_split_as_clouds(self, node):
        points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [NAN, 0.0, 0.0], [0.0, 90.0, 0.0]]
        message = point_cloud(5, points)
        given = {"cloud_topic": ("points",), "max_laser_range": 50.0}
        beams = to_scan_beams(message, "points", Mount(np.eye(4)), Parameters(**given))
        np.testing.assert_array_equal(beams.hit, [True, True, False, False])
        np.testing.assert_allclose(beams.points[3], [0.0, 50.0, 0.0])
        arrival = SimpleNamespace(topic="points", message=message, beams=beams)
        p_static = np.array([0.9, 0.1, NAN, 0.5], np.float32)
        publishers(node, **given)._publish_scan(arrival, p_static)
        static, dynamic, every = (
            read_cloud(node.sent[f"points_{name}"][0]) for name in ("static", "dynamic", "points")
        )
        np.testing.assert_allclose(static, [[1.0, 2.0, 3.0, 0.9]], rtol=1e-6)
        np.testing.assert_allclose(dynamic, [[4.0, 5.0, 6.0, 0.1]], rtol=1e-6)
        np.testing.assert_allclose(every, np.concatenate([static, dynamic]))


class TestPoses:
    def publish(self, node, T, covariance, T_map_odom, doubts=()):
        message = laser_scan(5_000_000_001, [1.0])
        beams = to_scan_beams(message, "scan", Mount(np.eye(3)), Parameters())
        update = Update(T, covariance, np.ones(1, np.float32), T_map_odom, doubts)
        arrival = SimpleNamespace(topic="scan", message=message, beams=beams)
        publishers(node).publish_answer(arrival, update)

    def test_in_the_plane(self, node):
        T = se2.matrix(1.0, -2.0, -3.0)
        self.publish(node, T, np.arange(9.0).reshape(3, 3), se2.matrix(3.0, 4.0, 0.5))
        (pose,), (transform,) = node.sent["pose"], node.sent["/tf"]
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

    def test_in_space(self, node):
        T = np.eye(4)
        T[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
        T[:3, 3] = 1.0, 2.0, 3.0
        self.publish(node, T, np.arange(36.0).reshape(6, 6), None)
        (pose,) = node.sent["pose"]
        q = pose.pose.pose.orientation
        assert pose.pose.pose.position.z == 3.0
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0.5**0.5, 0.0, 0.0, 0.5**0.5])
        np.testing.assert_array_equal(pose.pose.covariance, np.arange(36.0))
        assert node.sent["/tf"] == []  # this scan had no odometry

    def test_nothing_in_the_map_while_the_robot_is_lost(self, node):
        self.publish(node, np.eye(3), np.eye(3), np.eye(3), ("lost",))
        assert node.sent["pose"] == node.sent["/tf"] == []
