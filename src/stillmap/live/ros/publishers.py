"""Publishers of the node: pose, transform, diagnostics, and those of map, movers and scans."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.io.ros.messages import stamp_ns
from stillmap.live.causal_labels import MapChange
from stillmap.live.ros.conversions import fill_header, fill_pose, fill_status, fill_transform
from stillmap.live.ros.installation import Ros
from stillmap.live.ros.intake import Arrival
from stillmap.live.ros.map_updates import MapPublisher
from stillmap.live.ros.mover_markers import MoverPublisher
from stillmap.live.ros.parameters import Parameters
from stillmap.live.ros.scan_publishers import ScanPublishers
from stillmap.live.update import Update
from stillmap.pipeline.options import MapMode

Float = NDArray[np.float64]

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_DIAGNOSTICS, _STATUS = (
    "diagnostic_msgs/msg/DiagnosticArray",
    "diagnostic_msgs/msg/DiagnosticStatus",
)
_KEY_VALUE = "diagnostic_msgs/msg/KeyValue"

_POSE_DEPTH, _TF_DEPTH = 10, 100  # messages kept for readers that fall behind
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
        self._ros, self._node, self._parameters = ros, node, parameters
        self._map = MapPublisher(ros, node, parameters.map_name, parameters.map_frame, mode)
        self._movers = MoverPublisher(ros, node, parameters.map_frame)
        self._scans = ScanPublishers(ros, node, parameters)
        self._pose = ros.create_publisher(node, _POSE, "pose", _POSE_DEPTH)
        self._tf = ros.create_publisher(node, TF_MESSAGE, "/tf", _TF_DEPTH)
        self._diagnostics = ros.create_publisher(node, _DIAGNOSTICS, "/diagnostics", _POSE_DEPTH)
        self._tf_due_ns = 0

    def publish_answer(self, arrival: Arrival, update: Update) -> None:
        """Pose, transform, movers and labelled scan; the pose first, and nothing in the map where
        the robot is lost."""
        names, stamp = self._parameters, stamp_ns(arrival.message.header)
        is_lost = "lost" in update.doubts
        if not is_lost:
            pose = self._ros.message(_POSE)()
            fill_pose(pose, names.map_frame, stamp, update.pose, update.covariance)
            self._pose.publish(pose)
            self._publish_transform(update, stamp)
        self._movers.publish([] if is_lost else update.movers, stamp)
        self._scans.publish(arrival, update.p_static)

    def publish_map(self, grid: GridMap, stamp: int) -> None:
        """The whole map; who comes later gets the last one."""
        self._map.publish(grid, stamp)

    def publish_map_changes(self, changes: Sequence[MapChange], stamp: int) -> bool:
        """Publish changed tiles; False: the map has become larger, and a whole one is due."""
        return self._map.publish_changes(changes, stamp)

    def begin_anew(self) -> None:
        """Forget when something was published last: the clock was set back."""
        self._tf_due_ns = 0

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
