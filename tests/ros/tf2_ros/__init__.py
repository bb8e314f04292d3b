"""The part of tf2_ros that the node uses, for tests: the package index does not have it.

Names and behaviour are those of tf2_ros: an unknown time is an exception, static transforms hold
always, `clear` leaves them, and what is no rigid transform is not taken.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


class TransformException(Exception):
    """The transform is not known."""


class Buffer:
    """Transforms of the last seconds."""

    def __init__(self, cache_time=None):
        self._duration = 10 * 10**9 if cache_time is None else cache_time.nanoseconds
        self._edges = {}  # child: parent, {stamp: (4, 4)} or a static (4, 4)

    def set_transform(self, message, _authority):
        self._set(message, static=False)

    def set_transform_static(self, message, _authority):
        self._set(message, static=True)

    def _set(self, message, static):
        t, q = message.transform.translation, message.transform.rotation
        values = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
        if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > 0.01:
            return
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        parent = message.header.frame_id.lstrip("/")
        child = message.child_frame_id.lstrip("/")
        if static:
            self._edges[child] = parent, T
            return
        known = self._edges.get(child)
        if known is None or known[0] != parent or not isinstance(known[1], dict):
            known = self._edges[child] = parent, {}
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        known[1][stamp] = T
        oldest = max(known[1]) - self._duration
        for stamp in [stamp for stamp in known[1] if stamp < oldest]:
            del known[1][stamp]

    def clear(self):
        """Forget all but the static ones."""
        static = {k: edge for k, edge in self._edges.items() if not isinstance(edge[1], dict)}
        self._edges = static

    def _path(self, frame):
        path = [frame]
        while path[-1] in self._edges:
            path.append(self._edges[path[-1]][0])
        return path

    def _edges_between(self, target, source):
        up, down = self._path(source), self._path(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise TransformException(f"{target} and {source} are not connected")
        return up[: up.index(common)], down[: down.index(common)]

    def get_latest_common_time(self, target, source):
        both = [
            self._edges[child][1] for part in self._edges_between(target, source) for child in part
        ]
        moving = [max(stamps, default=0) for stamps in both if isinstance(stamps, dict)]
        return Time(min(moving, default=0))

    def lookup_transform_core(self, target, source, time):
        up, down = self._edges_between(target, source)
        T = np.linalg.inv(self._chain(down, time.nanoseconds)) @ self._chain(up, time.nanoseconds)
        q, out = Rotation.from_matrix(T[:3, :3]).as_quat(), Fields()
        out.transform.translation.x, out.transform.translation.y = T[0, 3], T[1, 3]
        out.transform.translation.z = T[2, 3]
        rotation = out.transform.rotation
        rotation.x, rotation.y, rotation.z, rotation.w = q
        return out

    def _chain(self, children, stamp):
        T = np.eye(4)
        for child in children:
            T = self._at(self._edges[child][1], stamp) @ T
        return T

    def _at(self, known, stamp):
        if not isinstance(known, dict):
            return known
        stamps = sorted(known)
        if not stamps or not stamps[0] <= stamp <= stamps[-1]:
            raise TransformException("would require extrapolation")
        after = next(one for one in stamps if one >= stamp)
        before = max((one for one in stamps if one < stamp), default=after)
        if after == stamp:
            return known[after]
        share, T = (stamp - before) / (after - before), np.eye(4)
        pair = Rotation.from_matrix([known[before][:3, :3], known[after][:3, :3]])
        T[:3, :3] = Slerp([0.0, 1.0], pair)(share).as_matrix()
        T[:3, 3] = (1.0 - share) * known[before][:3, 3] + share * known[after][:3, 3]
        return T

    def all_frames_as_string(self):
        rows = [
            f"Frame {child} exists with parent {edge[0]}." for child, edge in self._edges.items()
        ]
        return "\n".join(rows)


class Fields:
    """A message whose fields are made as they are asked for."""

    def __init__(self, **fields):
        self.__dict__.update(fields)

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        self.__dict__[name] = Fields()
        return self.__dict__[name]


class Time:
    """As of rclpy."""

    def __init__(self, nanoseconds):
        self.nanoseconds = nanoseconds


class Duration:
    """As of rclpy."""

    def __init__(self, seconds):
        self.nanoseconds = math.floor(1e9 * seconds)


class TransformListener:
    """Puts what arrives into a buffer."""

    def __init__(self, buffer, node):
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from tf2_msgs.msg import TFMessage

        self.buffer = buffer
        static = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf", self.callback, 100)
        node.create_subscription(TFMessage, "/tf_static", self.static_callback, static)

    def callback(self, message):
        for transform in message.transforms:
            self.buffer.set_transform(transform, "default_authority")

    def static_callback(self, message):
        for transform in message.transforms:
            self.buffer.set_transform_static(transform, "default_authority")


class TransformBroadcaster:
    """Publishes transforms."""

    def __init__(self, node):
        from tf2_msgs.msg import TFMessage

        self._kind = TFMessage
        self._publisher = node.create_publisher(TFMessage, "/tf", 100)

    def sendTransform(self, transform):
        self._publisher.publish(self._kind(transforms=[transform]))
