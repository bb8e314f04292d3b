"""Publishers of the node: pose, transform, movers, labelled scans, diagnostics and the map."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.io.ros.messages import stamp_ns
from stillmap.live.causal_labels import MapChange
from stillmap.live.movers import Mover
from stillmap.live.ros import messages
from stillmap.live.ros.intake import Arrival
from stillmap.live.ros.parameters import Parameters
from stillmap.live.update import Update
from stillmap.pipeline.options import MapMode

if TYPE_CHECKING:
    from stillmap.live.ros.run import Ros

OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"  # levels of DiagnosticStatus

_DEPTH, _SCAN_DEPTH = 10, 5  # messages kept for readers that fall behind
_PERIOD_NS = 10**9  # between two updates of the map

# of Marker
_ARROW, _CYLINDER, _TEXT = 0, 3, 9
_ADD, _DELETE = 0, 2
_NAMES = ("mover", "velocity", "number")  # namespaces of the markers of a mover
_HEIGHT = 1.7  # m, of a cylinder: nobody knows better in the plane
_LETTERS = 0.3  # m, height of numbers
_ORANGE, _WHITE = (1.0, 0.5, 0.0, 0.8), (1.0, 1.0, 1.0, 1.0)


class Publishers:
    """Publishers of answers and of diagnostics.

    Args:
        ros: the user's installation.
        node: of rclpy.
        parameters: see Parameters.
    """

    def __init__(self, ros: "Ros", node: Any, parameters: Parameters) -> None:
        self._ros, self._node, self._parameters = ros, node, parameters
        publish = node.create_publisher
        self._pose = publish(ros.geometry("PoseWithCovarianceStamped"), "pose", _DEPTH)
        self._tf = ros.tf2_ros.TransformBroadcaster(node)
        self._mover_poses = publish(ros.geometry("PoseArray"), "mover_poses", _DEPTH)
        markers = ros.message("visualization_msgs/msg/MarkerArray")
        self._markers = publish(markers, "movers", _DEPTH)
        status = ros.message("diagnostic_msgs/msg/DiagnosticArray")
        self._diagnostics = publish(status, "/diagnostics", _DEPTH)
        cloud = ros.message("sensor_msgs/msg/PointCloud2")
        scan = ros.message("sensor_msgs/msg/LaserScan") if parameters.dimension == 2 else cloud
        self._scans = {
            topic: [
                publish(kind, f"{topic}_{name}", _SCAN_DEPTH)
                for name, kind in (("static", scan), ("dynamic", scan), ("points", cloud))
            ]
            for topic in parameters.topics
        }
        self._shown = set[int]()  # numbers of the movers with markers
        self._tf_due_ns = 0

    def begin_anew(self) -> None:
        """Forget when something was published last: the clock was set back."""
        self._tf_due_ns = 0

    def publish_answer(self, arrival: Arrival, update: Update) -> None:
        """Pose, transform, movers and labelled scan; the pose first, and nothing in the map where
        the robot is lost."""
        names, stamp = self._parameters, stamp_ns(arrival.message.header)
        is_lost = "lost" in update.doubts
        if not is_lost:
            pose = self._ros.geometry("PoseWithCovarianceStamped")()
            messages.fill_header(pose.header, names.map_frame, stamp)
            messages.fill_point(pose.pose.pose.position, update.pose[:-1, -1])
            messages.fill_rotation(pose.pose.pose.orientation, update.pose)
            pose.pose.covariance = messages.spread_covariance(update.covariance)
            self._pose.publish(pose)
            self._publish_transform(update, stamp)
        self._publish_movers([] if is_lost else update.movers, stamp)
        self._publish_scan(arrival, update.p_static)

    def _publish_transform(self, update: Update, stamp: int) -> None:
        """From the map to the odometry; to the robot itself where there is no odometry.

        It holds a little longer than the scan is old: others look transforms up at their own times.
        It is not repeated between scans, and ends when the laser does.
        """
        names = self._parameters
        T = update.T_map_odom if names.odom_frame else update.pose
        # T is None: this scan had no odometry, and the last transform stays
        if not names.transform_publish_period or stamp < self._tf_due_ns or T is None:
            return
        self._tf_due_ns = stamp + round(1e9 * names.transform_publish_period)
        message = self._ros.geometry("TransformStamped")()
        until = stamp + round(1e9 * names.transform_timeout)
        messages.fill_header(message.header, names.map_frame, until)
        message.child_frame_id = names.odom_frame or names.base_frame
        messages.fill_point(message.transform.translation, T[:-1, -1])
        messages.fill_rotation(message.transform.rotation, T)
        self._tf.sendTransform(message)

    def _publish_movers(self, movers: Sequence[Mover], stamp: int) -> None:
        """The movers of a scan; markers of others are removed."""
        if self._mover_poses.get_subscription_count():
            message = self._ros.geometry("PoseArray")()
            messages.fill_header(message.header, self._parameters.map_frame, stamp)
            message.poses = []
            for mover in movers:
                pose = self._ros.geometry("Pose")()
                messages.fill_point(pose.position, mover.position)
                messages.fill_heading(pose.orientation, mover.velocity)
                message.poses.append(pose)
            self._mover_poses.publish(message)
        if not self._markers.get_subscription_count():
            return
        numbers = {mover.number for mover in movers}
        gone, self._shown = sorted(self._shown - numbers), numbers
        if movers or gone:
            message = self._ros.message("visualization_msgs/msg/MarkerArray")()
            message.markers = [
                self._marker(name, number, stamp, _DELETE) for number in gone for name in _NAMES
            ]
            for mover in movers:
                message.markers += self._markers_of(mover, stamp)
            self._markers.publish(message)

    def _marker(self, name: str, number: int, stamp: int, action: int = _ADD) -> Any:
        marker = self._ros.message("visualization_msgs/msg/Marker")()
        messages.fill_header(marker.header, self._parameters.map_frame, stamp)
        marker.ns, marker.id, marker.action = name, number, action
        marker.lifetime.sec = 1  # s: markers vanish with a node that dies
        marker.pose.orientation.w = 1.0
        return marker

    def _markers_of(self, mover: Mover, stamp: int) -> list[Any]:
        """A cylinder, an arrow to where it is a second later, and the number."""
        x, y, z = (*mover.position.tolist(), 0.5 * _HEIGHT)[:3]
        every = body, arrow, text = [self._marker(name, mover.number, stamp) for name in _NAMES]
        body.type, arrow.type, text.type = _CYLINDER, _ARROW, _TEXT
        messages.fill_point(body.pose.position, (x, y, z))
        messages.fill_point(text.pose.position, (x, y, z + 0.5 * _HEIGHT + _LETTERS))
        messages.fill_point(body.scale, (2.0 * mover.radius, 2.0 * mover.radius, _HEIGHT))
        messages.fill_point(arrow.scale, (0.06, 0.14, 0.0))  # m, diameters of shaft and head
        text.scale.z, text.text = _LETTERS, str(mover.number)
        vx, vy, vz = (*mover.velocity.tolist(), 0.0)[:3]
        arrow.points = [self._ros.geometry("Point")() for _ in range(2)]
        messages.fill_point(arrow.points[0], (x, y, z))
        messages.fill_point(arrow.points[1], (x + vx, y + vy, z + vz))
        for marker, color in zip(every, (_ORANGE, _WHITE, _WHITE), strict=True):
            marker.color.r, marker.color.g, marker.color.b, marker.color.a = color
        return every

    def _publish_scan(self, arrival: Arrival, p_static: NDArray[np.float32]) -> None:
        """TOPIC_static, TOPIC_dynamic and TOPIC_points of a scan with P(static) (N,), for those who
        listen."""
        *parts, points = self._scans[arrival.topic]
        is_end = arrival.beams.hit & np.isfinite(p_static)
        if points.get_subscription_count():
            self._publish_cloud(points, arrival, p_static, is_end)
        if not any(publisher.get_subscription_count() for publisher in parts):
            return
        if arrival.beams.dimension == 3:
            for publisher, chosen in zip(parts, (p_static >= 0.5, p_static < 0.5), strict=True):
                self._publish_cloud(publisher, arrival, p_static, is_end & chosen)
            return
        ranges = np.asarray(arrival.message.ranges, np.float32)
        split = messages.split_ranges(ranges, arrival.beams.hit, p_static)
        for publisher, of_label in zip(parts, split, strict=True):
            message = self._ros.message("sensor_msgs/msg/LaserScan")()
            messages.copy_scan(message, arrival.message, of_label)
            publisher.publish(message)

    def _publish_cloud(
        self,
        publisher: Any,
        arrival: Arrival,
        p_static: NDArray[np.float32],
        chosen: NDArray[np.bool_],
    ) -> None:
        """The chosen (N,) end points of a scan."""
        message = self._ros.message("sensor_msgs/msg/PointCloud2")()
        points = messages.end_points(arrival.message, arrival.beams, chosen)
        field = self._ros.message("sensor_msgs/msg/PointField")
        messages.fill_cloud(message, arrival.message, points, p_static[chosen], field)
        publisher.publish(message)

    def publish_status(self, level: bytes, text: str, values: dict[str, str]) -> None:
        """One line of diagnostics."""
        ros = self._ros
        message = ros.message("diagnostic_msgs/msg/DiagnosticArray")()
        status = ros.message("diagnostic_msgs/msg/DiagnosticStatus")()
        messages.fill_header(message.header, "", self._node.get_clock().now().nanoseconds)
        status.name, status.level = f"{self._node.get_name()}: mapping", level
        status.message, status.hardware_id = text, ""
        entries = []
        for key, value in values.items():
            entry = ros.message("diagnostic_msgs/msg/KeyValue")()
            entry.key, entry.value = key, value
            entries.append(entry)
        status.values, message.status = entries, [status]
        self._diagnostics.publish(message)


class MapPublisher:
    """Publishes the map, and what changes in it where map_msgs is there.

    Args:
        ros: the user's installation.
        node: of rclpy.
        parameters: topic and frame; updates are on TOPIC_updates, as RViz and nav2 expect.
        mode: how it is written.
    """

    def __init__(self, ros: "Ros", node: Any, parameters: Parameters, mode: MapMode) -> None:
        self._ros, self._frame, self._mode = ros, parameters.map_frame, mode
        topic, qos = parameters.map_name, ros.module("qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._map = node.create_publisher(ros.message("nav_msgs/msg/OccupancyGrid"), topic, latched)
        self._update = ros.message("map_msgs/msg/OccupancyGridUpdate")
        self._updates = None
        if self._update is None:
            node.get_logger().warning("map_msgs is missing: the map is published without updates")
        else:
            self._updates = node.create_publisher(self._update, f"{topic}_updates", _DEPTH)
        # the map as it was published, with all updates; column and row of its lowest cell
        self._cells, self._first = np.zeros((0, 0), np.int8), np.zeros(2, np.int64)
        self._waiting = dict[tuple[int, ...], MapChange]()
        self._published_ns = -_PERIOD_NS

    def publish(self, grid: GridMap, stamp: int) -> None:
        """The whole map; who comes later gets the last one."""
        self._cells = messages.to_cells(grid.p_occupied, self._mode)
        self._first = np.rint(np.array(grid.origin[:2]) / grid.resolution).astype(np.int64)
        self._waiting.clear()
        message = self._ros.message("nav_msgs/msg/OccupancyGrid")()
        messages.fill_header(message.header, self._frame, stamp)
        message.info.map_load_time.sec = message.header.stamp.sec
        message.info.map_load_time.nanosec = message.header.stamp.nanosec
        message.info.resolution = float(grid.resolution)
        message.info.height, message.info.width = self._cells.shape
        messages.fill_point(message.info.origin.position, grid.origin[:2])
        messages.fill_rotation(message.info.origin.orientation, se2.matrix(*grid.origin))
        message.data = messages.to_data(self._cells, "b")
        self._map.publish(message)

    def publish_changes(self, changes: Sequence[MapChange], stamp: int) -> bool:
        """Publish the tiles that changed, once a second; False: the map has become larger, and a
        whole one is due."""
        if self._updates is None:
            return True
        for change in changes:
            if change.p_occupied.ndim == 2:
                self._waiting[tuple(change.first_cell.tolist())] = change
        if not self._waiting or 0 <= stamp - self._published_ns < _PERIOD_NS:
            return True
        box = self._take_over(list(self._waiting.values()))
        self._waiting.clear()
        self._published_ns = stamp
        is_heard = self._updates.get_subscription_count() > 0
        if box is not None and is_heard:
            message, (rows, columns) = self._update(), box
            messages.fill_header(message.header, self._frame, stamp)
            message.x, message.y = columns.start, rows.start
            message.height, message.width = self._cells[box].shape
            message.data = messages.to_data(self._cells[box], "b")
            self._updates.publish(message)
        return box is not None or not is_heard

    def _take_over(self, changes: Sequence[MapChange]) -> tuple[slice, slice] | None:
        """Rows and columns of the rectangle around changed tiles, which are taken over; None: they
        are not all inside the map."""
        low = np.array([change.first_cell for change in changes]) - self._first
        high = low + np.array([change.p_occupied.shape[::-1] for change in changes])
        if (low < 0).any() or (high > self._cells.shape[::-1]).any():
            return None
        for (left, bottom), (right, top), change in zip(
            low.tolist(), high.tolist(), changes, strict=True
        ):
            self._cells[bottom:top, left:right] = messages.to_cells(change.p_occupied, self._mode)
        (left, bottom), (right, top) = low.min(axis=0).tolist(), high.max(axis=0).tolist()
        return slice(bottom, top), slice(left, right)
