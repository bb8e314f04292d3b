"""Publishers of the node: pose, transform, movers, labelled scans, diagnostics and the map."""

import array
import copy
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs import msg as geometry
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from tf2_ros import TransformBroadcaster
from visualization_msgs.msg import Marker, MarkerArray

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.grid_map import GridMap
from stillmap.io.ros.messages import stamp_ns
from stillmap.io.trajectory import embed_in_3d, quaternion_from_pose
from stillmap.live.causal_labels import MapChange
from stillmap.live.movers import Mover
from stillmap.live.ros import inputs
from stillmap.live.ros.inputs import Parameters
from stillmap.live.ros.intake import Arrival
from stillmap.live.update import Update
from stillmap.pipeline.options import MapMode

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:
    OccupancyGridUpdate = None


_DEPTH, _SCAN_DEPTH = 10, 5  # messages kept for readers that fall behind
_PERIOD_NS = 10**9  # between two updates of the map
_HEIGHT = 1.7  # m, of a cylinder: nobody knows better in the plane
_ORANGE = {"r": 1.0, "g": 0.5, "b": 0.0, "a": 0.8}
_WHITE = {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}


class Publishers:
    """Publishers of answers and of diagnostics.

    Args:
        node: of rclpy.
        parameters: see Parameters.
    """

    def __init__(self, node: Any, parameters: Parameters) -> None:
        self._node, self._parameters = node, parameters
        publish = node.create_publisher
        self._pose = publish(geometry.PoseWithCovarianceStamped, "pose", _DEPTH)
        self._tf = TransformBroadcaster(node)
        self._mover_poses = publish(geometry.PoseArray, "mover_poses", _DEPTH)
        self._markers = publish(MarkerArray, "movers", _DEPTH)
        self._diagnostics = publish(DiagnosticArray, "/diagnostics", _DEPTH)
        scan = LaserScan if parameters.dimension == 2 else PointCloud2
        self._scans = {
            topic: [
                publish(kind, f"{topic}_{name}", _SCAN_DEPTH)
                for name, kind in (("static", scan), ("dynamic", scan), ("points", PointCloud2))
            ]
            for topic in parameters.topics
        }
        self._tf_ns = 0  # of the last transform

    def publish_answer(self, arrival: Arrival, update: Update) -> None:
        """Pose, transform, movers and labelled scan; the pose first, and nothing in the map where
        the robot is lost."""
        names, stamp = self._parameters, stamp_ns(arrival.message.header)
        is_lost = "lost" in update.doubts
        if not is_lost:
            covariance = inputs.spread_covariance(update.covariance)
            pose = geometry.PoseWithCovariance(pose=_to_pose(update.pose), covariance=covariance)
            header = _to_header(names.map_frame, stamp)
            self._pose.publish(geometry.PoseWithCovarianceStamped(header=header, pose=pose))
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
        since_ns, period_ns = stamp - self._tf_ns, round(1e9 * names.transform_publish_period)
        if not period_ns or 0 <= since_ns < period_ns or T is None:
            return
        self._tf_ns = stamp
        until = stamp + round(1e9 * names.transform_timeout)
        translation, rotation = _to_vector(T[:-1, -1], geometry.Vector3), _to_rotation(T)
        message = geometry.TransformStamped(
            header=_to_header(names.map_frame, until),
            child_frame_id=names.odom_frame or names.base_frame,
            transform=geometry.Transform(translation=translation, rotation=rotation),
        )
        self._tf.sendTransform(message)

    def _publish_movers(self, movers: Sequence[Mover], stamp: int) -> None:
        """The movers of a scan; markers of earlier ones are removed."""
        header = _to_header(self._parameters.map_frame, stamp)
        if self._mover_poses.get_subscription_count():
            headings = [math.atan2(mover.velocity[1], mover.velocity[0]) for mover in movers]
            poses = [
                geometry.Pose(
                    position=_to_vector(mover.position),
                    orientation=_to_rotation(se2.matrix(0.0, 0.0, heading)),
                )
                for mover, heading in zip(movers, headings, strict=True)
            ]
            self._mover_poses.publish(geometry.PoseArray(header=header, poses=poses))
        if self._markers.get_subscription_count():
            markers = [Marker(header=header, action=Marker.DELETEALL)]
            markers += [marker for mover in movers for marker in _to_markers(mover, header)]
            self._markers.publish(MarkerArray(markers=markers))

    def _publish_scan(self, arrival: Arrival, p_static: Float32) -> None:
        """TOPIC_static, TOPIC_dynamic and TOPIC_points of a scan with P(static) (N,), for those who
        listen."""
        *parts, points = self._scans[arrival.topic]
        is_end = arrival.beams.hit & np.isfinite(p_static)
        if points.get_subscription_count():
            points.publish(_to_cloud(arrival, p_static, is_end))
        if not any(publisher.get_subscription_count() for publisher in parts):
            return
        if arrival.beams.dimension == 3:
            for publisher, chosen in zip(parts, (p_static >= 0.5, p_static < 0.5), strict=True):
                publisher.publish(_to_cloud(arrival, p_static, is_end & chosen))
            return
        ranges = np.asarray(arrival.message.ranges, np.float32)
        split = inputs.split_ranges(ranges, arrival.beams.hit, p_static)
        for publisher, of_label in zip(parts, split, strict=True):
            message = copy.copy(arrival.message)
            message.ranges = _to_data(of_label.astype(np.float32), "f")
            publisher.publish(message)

    def publish_status(self, level: bytes, text: str, values: dict[str, str]) -> None:
        """One line of diagnostics."""
        status = DiagnosticStatus(
            name=f"{self._node.get_name()}: mapping",
            level=level,
            message=text,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        header = _to_header("", self._node.get_clock().now().nanoseconds)
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))


class MapPublisher:
    """Publishes the map, and what changes in it where map_msgs is there.

    Args:
        node: of rclpy.
        parameters: topic and frame; updates are on TOPIC_updates, as RViz and nav2 expect.
        mode: how it is written.
    """

    def __init__(self, node: Any, parameters: Parameters, mode: MapMode) -> None:
        self._frame, self._mode = parameters.map_frame, mode
        topic = parameters.map_name
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._map = node.create_publisher(OccupancyGrid, topic, latched)
        self._updates = None
        if OccupancyGridUpdate is None:
            node.get_logger().warning("map_msgs is missing: the map is published without updates")
        elif parameters.dimension == 2:
            self._updates = node.create_publisher(OccupancyGridUpdate, f"{topic}_updates", _DEPTH)
        # the map as it was published, with all updates; column and row of its lowest cell
        self._cells, self._first = np.zeros((0, 0), np.int8), np.zeros(2, np.int64)
        # rows and columns of the rectangle that changed since: the first, and after the last
        self._low, self._high = np.zeros((2, 2), np.int64)
        self._published_ns = -_PERIOD_NS

    def publish(self, grid: GridMap, stamp: int) -> None:
        """The whole map; who comes later gets the last one."""
        self._cells = inputs.to_cells(grid.p_occupied, self._mode)
        self._first = np.rint(np.array(grid.origin[:2]) / grid.resolution).astype(np.int64)
        self._low, self._high = np.array(self._cells.shape), np.zeros(2, np.int64)
        header, (height, width) = _to_header(self._frame, stamp), self._cells.shape
        info = MapMetaData(
            map_load_time=header.stamp,
            resolution=float(grid.resolution),
            width=width,
            height=height,
            origin=_to_pose(se2.matrix(*grid.origin)),
        )
        data = _to_data(self._cells, "b")
        self._map.publish(OccupancyGrid(header=header, info=info, data=data))

    def publish_changes(self, changes: Sequence[MapChange], stamp: int) -> bool:
        """Publish the tiles that changed, once a second; False: the map has become larger, and a
        whole one is due."""
        if self._updates is None or not self._updates.get_subscription_count():
            return True
        for change in changes:
            self._take_over(change)
        if (self._low >= self._high).any() or 0 <= stamp - self._published_ns < _PERIOD_NS:
            return True
        self._published_ns = stamp
        if not self._holds(self._low, self._high):
            return False
        (row, column), (end, right) = self._low.tolist(), self._high.tolist()
        update = OccupancyGridUpdate(
            header=_to_header(self._frame, stamp),
            x=column,
            y=row,
            width=right - column,
            height=end - row,
            data=_to_data(self._cells[row:end, column:right], "b"),
        )
        self._updates.publish(update)
        self._low, self._high = np.array(self._cells.shape), np.zeros(2, np.int64)
        return True

    def _take_over(self, change: MapChange) -> None:
        """Enter a tile into the map, if it is inside."""
        low = (change.first_cell - self._first)[::-1]
        high = low + change.p_occupied.shape
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        if self._holds(low, high):
            (row, column), (end, right) = low.tolist(), high.tolist()
            self._cells[row:end, column:right] = inputs.to_cells(change.p_occupied, self._mode)

    def _holds(self, low: Int64, high: Int64) -> bool:
        return bool((low >= 0).all() and (high <= self._cells.shape).all())


def _to_markers(mover: Mover, header: Any) -> list[Any]:
    """A cylinder, and an arrow to where it is a second later."""
    upright, width = geometry.Quaternion(w=1.0), 2.0 * mover.radius

    def make(kind: int, name: str, color: dict[str, float], scale: Sequence[float], at: Any) -> Any:
        return Marker(
            header=header,
            type=kind,
            ns=name,
            id=mover.number,
            color=ColorRGBA(**color),
            scale=_to_vector(scale, geometry.Vector3),
            pose=geometry.Pose(position=at, orientation=upright),
            lifetime=Duration(sec=1),  # markers vanish with a node that dies
        )

    position = np.array((*mover.position, 0.5 * _HEIGHT)[:3])
    at, end = _to_vector(position), _to_vector(position + (*mover.velocity, 0.0)[:3])
    body = make(Marker.CYLINDER, "mover", _ORANGE, (width, width, _HEIGHT), at)
    diameters = (0.06, 0.14, 0.0)  # m, of shaft and head
    arrow = make(Marker.ARROW, "velocity", _WHITE, diameters, geometry.Point())
    arrow.points = [at, end]
    return [body, arrow]


def _to_cloud(arrival: Arrival, p_static: Float32, chosen: Bool) -> Any:
    """A PointCloud2 of the chosen (N,) end points of a scan with their P(static)."""
    points = inputs.end_points(arrival.message, arrival.beams, chosen)
    rows, header = np.column_stack([points, p_static[chosen]]), arrival.message.header
    return PointCloud2(
        header=_to_header(header.frame_id, stamp_ns(header)),
        height=1,
        width=len(points),
        fields=[
            PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
            for k, name in enumerate(("x", "y", "z", "p_static"))
        ],
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(points),
        is_dense=True,
        data=_to_data(rows.astype("<f4"), "B"),
    )


def _to_header(frame: str, stamp: int) -> Any:
    sec, nanosec = divmod(stamp, 10**9)
    return Header(frame_id=frame, stamp=Time(sec=sec, nanosec=nanosec))


def _to_pose(T: Float) -> Any:
    return geometry.Pose(position=_to_vector(T[:-1, -1]), orientation=_to_rotation(T))


def _to_vector(values: Sequence[float] | Float, kind: Any = geometry.Point) -> Any:
    """A point, or a vector; in the plane z is 0."""
    x, y, z = (*map(float, values), 0.0)[:3]
    return kind(x=x, y=y, z=z)


def _to_rotation(T: Float) -> Any:
    """The rotation of a pose (D+1, D+1)."""
    w, x, y, z = quaternion_from_pose(embed_in_3d(T)).tolist()
    return geometry.Quaternion(x=x, y=y, z=z, w=w)


def _to_data(values: NDArray[Any], code: str) -> "array.array[Any]":
    """An array of the kind that rclpy takes without a check of each element."""
    return array.array(code, values.tobytes())
