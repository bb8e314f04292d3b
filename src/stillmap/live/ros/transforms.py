"""Mounts and odometry from TF, by the user's own tf2_ros, and odometry from Odometry messages."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stillmap.core import se2
from stillmap.io.rigid_transforms import MAX_TRANSLATION
from stillmap.io.ros.messages import frame_name
from stillmap.io.ros.tf import project_to_plane
from stillmap.live.ros.messages import Mount, to_matrix
from stillmap.live.ros.parameters import Parameters

Float = NDArray[np.float64]

_MESSAGES, _ROBOT = "odometry", "robot"  # frames of Odometry messages in a buffer of their own


class Tf2(NamedTuple):
    """What is used of the user's ROS: classes of tf2_ros, geometry_msgs and rclpy."""

    Buffer: Any
    TransformException: Any
    TransformStamped: Any
    Time: Any
    Duration: Any


class Transforms:
    """What TF and Odometry messages have said in the last seconds.

    The source of odometry that is first able to give a pose is kept: two of them may differ by any
    offset.

    Args:
        parameters: names of the frames.
        tf2: classes of the user's ROS.

    Attributes:
        buffer: of tf2_ros, for a listener.
        source: of odometry: "TF", the topic, or None: no pose could be given so far.
    """

    def __init__(self, parameters: Parameters, tf2: Tf2) -> None:
        self._parameters, self._tf2 = parameters, tf2
        duration = tf2.Duration(seconds=parameters.tf_buffer_duration)
        self.buffer, self._messages = tf2.Buffer(duration), tf2.Buffer(duration)
        self._child = ""
        self.source: str | None = None

    @property
    def frames(self) -> str:
        """All frames of TF, in words."""
        return " ".join(self.buffer.all_frames_as_string().split()) or "none"

    def forget(self) -> None:
        """Forget all but the static transforms: time has begun anew."""
        self.buffer.clear()
        self._messages.clear()

    def add_odometry(self, message: Any) -> None:
        """Add an Odometry message."""
        self._child = frame_name(message.child_frame_id)
        transform, pose = self._tf2.TransformStamped(), message.pose.pose
        transform.header.stamp, transform.header.frame_id = message.header.stamp, _MESSAGES
        transform.child_frame_id = _ROBOT
        for axis in "xyz":
            setattr(transform.transform.translation, axis, getattr(pose.position, axis))
        transform.transform.rotation = pose.orientation
        self._messages.set_transform(transform, "stillmap")

    def odometry_at(self, stamp: int) -> Float | None:
        """(D+1, D+1) T_odom_base; None: it is not known (yet)."""
        names = self._parameters
        if not names.odom_frame:
            return None
        if self.source in (None, "TF"):
            T = self._lookup(self.buffer, names.odom_frame, names.base_frame, stamp)
            if T is not None:
                self.source = "TF"
                return self._flatten(T)
        if self.source in (None, names.odom_topic):
            T = self._lookup(self._messages, _MESSAGES, _ROBOT, stamp)
            if T is not None:
                self.source = names.odom_topic
                return self._flatten(T @ self._child_to_base(stamp))
        return None

    @property
    def last_odometry_ns(self) -> int:
        """Stamp of the last odometry; 0: there is none."""
        names = self._parameters
        of_tf = self._last(self.buffer, names.odom_frame, names.base_frame)
        return max(of_tf, self._last(self._messages, _MESSAGES, _ROBOT))

    def find_mount(self, topic: str, frame: str, stamp: int) -> Mount | None:
        """Where a sensor is on the robot: by a parameter, else by TF; None: it is not known."""
        names = self._parameters
        if names.laser_pose:
            return self._given_mount(names.topics.index(topic))
        T = np.eye(4)
        if frame != names.base_frame:
            looked_up = self._lookup(self.buffer, names.base_frame, frame, stamp)
            if looked_up is None:
                return None
            T = looked_up
        if names.dimension == 3:
            return Mount(T)
        flat, is_upside_down, _ = project_to_plane(T[None])
        return Mount(flat[0], is_upside_down)

    def _given_mount(self, k: int) -> Mount:
        values = self._parameters.laser_pose
        if self._parameters.dimension == 2:
            return Mount(se2.matrix(*values[3 * k : 3 * k + 3]))
        T, values = np.eye(4), values[6 * k : 6 * k + 6]
        T[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()  # about fixed axes
        T[:3, 3] = values[:3]
        return Mount(T)

    def _lookup(self, buffer: Any, target: str, source: str, stamp: int) -> Float | None:
        """(4, 4) T_target_source; None: it is not known at this time."""
        try:
            found = buffer.lookup_transform_core(target, source, self._tf2.Time(nanoseconds=stamp))
        except self._tf2.TransformException:
            return None
        T = to_matrix(found.transform.translation, found.transform.rotation)
        return T if (np.abs(T) < MAX_TRANSLATION).all() else None

    def _last(self, buffer: Any, target: str, source: str) -> int:
        try:
            return int(buffer.get_latest_common_time(target, source).nanoseconds)
        except self._tf2.TransformException:
            return 0

    def _flatten(self, T: Float) -> Float:
        if self._parameters.dimension == 3:
            return T
        return se2.matrix(T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0]))

    def _child_to_base(self, stamp: int) -> Float:
        """(4, 4) T_child_base, the base frame in the child frame of the messages; the identity if
        no transform says otherwise."""
        base = self._parameters.base_frame
        T = self._lookup(self.buffer, self._child, base, stamp) if self._child else None
        return np.eye(4) if T is None else T
