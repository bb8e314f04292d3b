"""Mounts and odometry from TF, by the user's own tf2_ros, and odometry from Odometry messages."""

from contextlib import suppress
from typing import Any

import numpy as np
from geometry_msgs.msg import Transform, TransformStamped, Vector3
from rclpy.duration import Duration
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tf2_ros import Buffer, TransformException

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.io.ros.messages import frame_name
from stillmap.io.ros.tf import project_to_plane
from stillmap.io.trajectory import MAX_TRANSLATION, poses_from_rows
from stillmap.live.ros.inputs import Mount, Parameters

_MESSAGES, _ROBOT = "stillmap_odometry", "stillmap_robot"  # frames of Odometry messages


class Transforms:
    """Transforms of TF and Odometry messages of the last seconds.

    The source of odometry that is first able to give a pose is kept: two of them may differ by any
    offset.

    Args:
        parameters: names of the frames.

    Attributes:
        buffer: of tf2_ros, for a listener.
        source: of odometry: "TF", the topic, or None: no pose could be given so far.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.buffer = Buffer(Duration(seconds=parameters.tf_buffer_duration))
        self._child = ""
        self.source: str | None = None

    @property
    def frames(self) -> str:
        """All frames of TF, in words."""
        return " ".join(self.buffer.all_frames_as_string().split()) or "none"

    def forget(self) -> None:
        """Forget all but the static transforms: time has begun anew."""
        self.buffer.clear()

    def add_odometry(self, message: Any) -> None:
        """Add an Odometry message."""
        self._child = frame_name(message.child_frame_id)
        pose = message.pose.pose
        at = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
        transform = TransformStamped(
            header=Header(stamp=message.header.stamp, frame_id=_MESSAGES),
            child_frame_id=_ROBOT,
            transform=Transform(translation=at, rotation=pose.orientation),
        )
        self.buffer.set_transform(transform, "stillmap")

    def odometry_at(self, stamp: int) -> Float | None:
        """(D+1, D+1) T_odom_base; None: it is not known (yet)."""
        names = self._parameters
        if not names.odom_frame:
            return None
        T = None
        if self.source in (None, "TF"):
            T, source = self._look_up(names.odom_frame, names.base_frame, stamp), "TF"
        if T is None and self.source in (None, names.odom_topic):
            T, source = self._look_up(_MESSAGES, _ROBOT, stamp), names.odom_topic
            T = None if T is None else T @ self._child_to_base(stamp)
        if T is None:
            return None
        self.source = source
        return T if names.dimension == 3 else se2.project_to_plane(T[None])[0]

    @property
    def last_odometry_ns(self) -> int:
        """Stamp of the last odometry; 0: there is none."""
        names = self._parameters
        stamps = [0]
        for frames in ((names.odom_frame, names.base_frame), (_MESSAGES, _ROBOT)):
            with suppress(TransformException):
                stamps.append(self.buffer.get_latest_common_time(*frames).nanoseconds)
        return max(stamps)

    def find_mount(self, topic: str, frame: str, stamp: int) -> Mount | None:
        """Pose of a sensor on the robot: by a parameter, else by TF; None: it is not known."""
        names = self._parameters
        if names.laser_pose:
            return self._given_mount(names.topics.index(topic))
        T: Float | None = np.eye(4)
        if frame != names.base_frame:
            T = self._look_up(names.base_frame, frame, stamp)
        if T is None or names.dimension == 3:
            return None if T is None else Mount(T)
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

    def _child_to_base(self, stamp: int) -> Float:
        """(4, 4) T_child_base, the base frame in the child frame of the messages; the identity if
        no transform says otherwise."""
        base = self._parameters.base_frame
        T = self._look_up(self._child, base, stamp) if self._child else None
        return np.eye(4) if T is None else T

    def _look_up(self, target: str, source: str, stamp: int) -> Float | None:
        """(4, 4) T_target_source; None: it is not known at this time."""
        try:
            message = self.buffer.lookup_transform_core(target, source, Time(nanoseconds=stamp))
        except TransformException:
            return None
        t, q = message.transform.translation, message.transform.rotation
        T = poses_from_rows(np.array([[t.x, t.y, t.z, q.x, q.y, q.z, q.w]]))[0]
        return T if (np.abs(T) < MAX_TRANSLATION).all() else None
