"""Moving objects as ROS messages: markers for RViz, and poses."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from stillmap.live.movers import Mover
from stillmap.live.ros.conversions import fill_header
from stillmap.live.ros.installation import Ros

_MARKERS, _MARKER = "visualization_msgs/msg/MarkerArray", "visualization_msgs/msg/Marker"
_POSES, _POSE = "geometry_msgs/msg/PoseArray", "geometry_msgs/msg/Pose"
_POINT = "geometry_msgs/msg/Point"
_DEPTH = 10  # messages kept for readers that fall behind

# of Marker
_ARROW, _CYLINDER, _TEXT = 0, 3, 9
_ADD, _DELETE = 0, 2
_NAMES = ("mover", "velocity", "number")  # namespaces of the markers of a mover

_HEIGHT = 1.7  # m, of a cylinder: nobody knows better in the plane
_LETTERS = 0.3  # m, height of numbers
_SHAFT, _HEAD = 0.06, 0.14  # m, diameters of arrows
_LIFETIME_S = 1  # markers vanish with a node that dies
_ORANGE, _WHITE = (1.0, 0.5, 0.0, 0.8), (1.0, 1.0, 1.0, 1.0)


def fill_markers(
    message: Any,
    frame: str,
    stamp: int,
    movers: Sequence[Mover],
    gone: Sequence[int],
    make_marker: Callable[[], Any],
    make_point: Callable[[], Any],
) -> None:
    """Set a MarkerArray: a cylinder, an arrow to where it is a second later, and the number.

    Args:
        message: to be set.
        frame: of the map.
        stamp: nanoseconds.
        movers: in the map.
        gone: numbers of which the markers are removed.
        make_marker: makes a Marker.
        make_point: makes a Point.
    """
    message.markers = []

    def add(name: str, number: int, action: int = _ADD) -> Any:
        marker = make_marker()
        fill_header(marker.header, frame, stamp)
        marker.ns, marker.id, marker.action = name, number, action
        marker.lifetime.sec = _LIFETIME_S
        marker.pose.orientation.w = 1.0
        message.markers.append(marker)
        return marker

    for number in gone:
        for name in _NAMES:
            add(name, number, _DELETE)
    for mover in movers:
        x, y, z = _to_space(mover.position, 0.5 * _HEIGHT)
        body, arrow, text = (add(name, mover.number) for name in _NAMES)
        body.type, arrow.type, text.type = _CYLINDER, _ARROW, _TEXT
        for marker, height in ((body, z), (text, z + 0.5 * _HEIGHT + _LETTERS)):
            _fill(marker.pose.position, (x, y, height))
        _fill(body.scale, (2.0 * mover.radius, 2.0 * mover.radius, _HEIGHT))
        _fill(arrow.scale, (_SHAFT, _HEAD, 0.0))
        text.scale.z, text.text = _LETTERS, str(mover.number)
        vx, vy, vz = _to_space(mover.velocity, 0.0)
        arrow.points = [make_point(), make_point()]
        _fill(arrow.points[0], (x, y, z))
        _fill(arrow.points[1], (x + vx, y + vy, z + vz))
        for marker, color in ((body, _ORANGE), (arrow, _WHITE), (text, _WHITE)):
            marker.color.r, marker.color.g, marker.color.b, marker.color.a = color


def fill_mover_poses(
    message: Any, frame: str, stamp: int, movers: Sequence[Mover], make_pose: Callable[[], Any]
) -> None:
    """Set a PoseArray: the movers' positions, headed where they move."""
    fill_header(message.header, frame, stamp)
    message.poses = []
    for mover in movers:
        pose = make_pose()
        _fill(pose.position, _to_space(mover.position, 0.0))
        half = 0.5 * math.atan2(mover.velocity[1], mover.velocity[0])
        q = pose.orientation
        q.x, q.y, q.z, q.w = 0.0, 0.0, math.sin(half), math.cos(half)
        message.poses.append(pose)


def _to_space(vector: Any, height: float) -> tuple[float, float, float]:
    x, y, *rest = (float(value) for value in vector)
    return x, y, rest[0] if rest else height


def _fill(point: Any, values: tuple[float, float, float]) -> None:
    point.x, point.y, point.z = values


class MoverPublisher:
    """Publishes movers as poses, and as markers where visualization_msgs is there.

    Args:
        ros: the user's installation.
        node: of rclpy.
        frame: of the map.
    """

    def __init__(self, ros: Ros, node: Any, frame: str) -> None:
        self._ros, self._frame = ros, frame
        self._markers = ros.create_publisher(node, _MARKERS, "movers", _DEPTH)
        self._poses = ros.create_publisher(node, _POSES, "mover_poses", _DEPTH)
        self._shown = set[int]()  # numbers of the last markers

    def publish(self, movers: Sequence[Mover], stamp: int) -> None:
        """The movers of a scan; markers of others are removed."""
        if self._poses.get_subscription_count():
            poses = self._ros.message(_POSES)()
            fill_mover_poses(poses, self._frame, stamp, movers, self._ros.message(_POSE))
            self._poses.publish(poses)
        if self._markers is None or not self._markers.get_subscription_count():
            return
        numbers = {mover.number for mover in movers}
        gone, self._shown = sorted(self._shown - numbers), numbers
        if not (movers or gone):
            return
        message = self._ros.message(_MARKERS)()
        makers = self._ros.message(_MARKER), self._ros.message(_POINT)
        fill_markers(message, self._frame, stamp, movers, gone, *makers)
        self._markers.publish(message)
