"""Publishers of the node: map, transform, pose, static and dynamic scans, diagnostics."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.io.ros.messages import stamp_ns
from stillmap.live.ros.conversions import (
    copy_scan,
    fill_grid,
    fill_header,
    fill_pose,
    fill_status,
    fill_transform,
    split_ranges,
)
from stillmap.live.ros.installation import Ros
from stillmap.live.ros.intake import Arrival
from stillmap.live.ros.parameters import Parameters
from stillmap.live.update import Update
from stillmap.pipeline.options import MapMode

Float = NDArray[np.float64]

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_GRID, _SCAN = "nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/LaserScan"
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_DIAGNOSTICS, _STATUS = (
    "diagnostic_msgs/msg/DiagnosticArray",
    "diagnostic_msgs/msg/DiagnosticStatus",
)
_KEY_VALUE = "diagnostic_msgs/msg/KeyValue"

_POSE_DEPTH, _SCAN_DEPTH, _TF_DEPTH = 10, 5, 100  # messages kept for readers that fall behind
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"  # levels of DiagnosticStatus


class Publishers:
    """Publishers of a node.

    Args:
        ros: the user's installation.
        node: of rclpy.
        parameters: see Parameters.
        mode: how the map is written.
    """

    def __init__(self, ros: Ros, node: Any, parameters: Parameters, mode: MapMode) -> None:
        self._ros, self._node, self._parameters, self._mode = ros, node, parameters, mode
        qos = ros.module("qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._map = self._create(_GRID, parameters.map_name, latched)
        self._pose = self._create(_POSE, "pose", _POSE_DEPTH)
        self._tf = self._create(TF_MESSAGE, "/tf", _TF_DEPTH)
        self._diagnostics = self._create(_DIAGNOSTICS, "/diagnostics", _POSE_DEPTH)
        self._scans = {
            topic: tuple(
                self._create(_SCAN, f"{topic}_{label}", _SCAN_DEPTH)
                for label in ("static", "dynamic")
            )
            for topic in parameters.scan_topic
        }
        self._tf_due_ns = 0

    @property
    def has_tf(self) -> bool:
        """False where tf2_msgs is missing."""
        return self._tf is not None

    def publish_answer(self, arrival: Arrival, update: Update) -> None:
        """Pose, transform and labelled scan; the pose first, and none where the robot is lost."""
        names, stamp = self._parameters, stamp_ns(arrival.message.header)
        if "lost" not in update.doubts:
            pose = self._ros.message(_POSE)()
            fill_pose(pose, names.map_frame, stamp, update.pose, update.covariance)
            self._pose.publish(pose)
            self._publish_transform(update, stamp)
        self._publish_scans(arrival, update)

    def publish_map(self, grid: GridMap, stamp: int) -> None:
        """The whole map; who comes later gets the last one."""
        message = self._ros.message(_GRID)()
        fill_grid(message, self._parameters.map_frame, stamp, grid, self._mode)
        self._map.publish(message)

    def publish_status(self, level: bytes, text: str, values: dict[str, str]) -> None:
        """One line of diagnostics."""
        if self._diagnostics is None:
            return
        message, status = self._ros.message(_DIAGNOSTICS)(), self._ros.message(_STATUS)()
        fill_header(message.header, "", self._node.get_clock().now().nanoseconds)
        name = f"{self._node.get_name()}: mapping"
        fill_status(status, name, level, text, values, self._ros.message(_KEY_VALUE))
        message.status = [status]
        self._diagnostics.publish(message)

    def _create(self, kind: str, topic: str, qos: Any) -> Any:
        message = self._ros.message(kind)
        return None if message is None else self._node.create_publisher(message, topic, qos)

    def _publish_transform(self, update: Update, stamp: int) -> None:
        """From the map to the odometry; to the robot itself where there is no odometry.

        It holds a little longer than the scan is old: others look transforms up at their own times.
        It is not repeated between scans, and ends when the laser does.
        """
        names = self._parameters
        if self._tf is None or not names.transform_publish_period or stamp < self._tf_due_ns:
            return
        T = update.T_map_odom if names.odom_frame else update.pose
        if T is None:  # this scan had no odometry: the last transform stays
            return
        self._tf_due_ns = stamp + round(1e9 * names.transform_publish_period)
        transform, message = self._ros.message(_TRANSFORM)(), self._ros.message(TF_MESSAGE)()
        until = stamp + round(1e9 * names.transform_timeout)
        child = names.odom_frame or names.base_frame
        fill_transform(transform, names.map_frame, child, until, T)
        message.transforms = [transform]
        self._tf.publish(message)

    def _publish_scans(self, arrival: Arrival, update: Update) -> None:
        publishers = self._scans[arrival.topic]
        if not any(publisher.get_subscription_count() for publisher in publishers):
            return
        ranges = np.asarray(arrival.message.ranges, np.float32)
        for publisher, of_label in zip(
            publishers, split_ranges(ranges, arrival.beams.hit, update.p_static), strict=True
        ):
            message = self._ros.message(_SCAN)()
            copy_scan(message, arrival.message, of_label)
            publisher.publish(message)
