"""Scans as they are published again: what stands, what moves, and P(static) of every point."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.live.ros.clouds import end_points, fill_cloud
from stillmap.live.ros.conversions import copy_scan, split_ranges
from stillmap.live.ros.installation import Ros
from stillmap.live.ros.intake import Arrival
from stillmap.live.ros.parameters import Parameters

_SCAN, _CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
_FIELD = "sensor_msgs/msg/PointField"
_DEPTH = 5  # messages kept for readers that fall behind


class ScanPublishers:
    """Publishes labelled scans: TOPIC_static, TOPIC_dynamic and TOPIC_points of each topic.

    Args:
        ros: the user's installation.
        node: of rclpy.
        parameters: see Parameters.
    """

    def __init__(self, ros: Ros, node: Any, parameters: Parameters) -> None:
        self._ros, self._is_planar = ros, parameters.dimension == 2
        kind = _SCAN if self._is_planar else _CLOUD
        self._publishers = {
            topic: [
                ros.create_publisher(node, of, f"{topic}_{name}", _DEPTH)
                for name, of in (("static", kind), ("dynamic", kind), ("points", _CLOUD))
            ]
            for topic in parameters.topics
        }

    def publish(self, arrival: Arrival, p_static: NDArray[np.float32]) -> None:
        """A scan with P(static) (N,) of its beams, for those who listen."""
        *parts, every = self._publishers[arrival.topic]
        is_end = arrival.beams.hit & np.isfinite(p_static)
        if every.get_subscription_count():
            self._publish_cloud(every, arrival, p_static, is_end)
        if not any(publisher.get_subscription_count() for publisher in parts):
            return
        if not self._is_planar:
            for publisher, chosen in zip(parts, (p_static >= 0.5, p_static < 0.5), strict=True):
                self._publish_cloud(publisher, arrival, p_static, is_end & chosen)
            return
        ranges = np.asarray(arrival.message.ranges, np.float32)
        split = split_ranges(ranges, arrival.beams.hit, p_static)
        for publisher, of_label in zip(parts, split, strict=True):
            message = self._ros.message(_SCAN)()
            copy_scan(message, arrival.message, of_label)
            publisher.publish(message)

    def _publish_cloud(
        self,
        publisher: Any,
        arrival: Arrival,
        p_static: NDArray[np.float32],
        chosen: NDArray[np.bool_],
    ) -> None:
        """The chosen (N,) end points of a scan."""
        message = self._ros.message(_CLOUD)()
        points = end_points(arrival.message, arrival.beams, chosen)
        field = self._ros.message(_FIELD)
        fill_cloud(message, arrival.message, points, p_static[chosen], field)
        publisher.publish(message)
