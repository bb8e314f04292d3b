"""Odometry of the robot at the stamps of scans: from TF, else from Odometry messages."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.io.ros.messages import frame_name, stamp_ns
from stillmap.live.ros.conversions import pose_values
from stillmap.live.ros.parameters import Parameters
from stillmap.live.ros.transforms import TransformBuffer, to_plane

Float = NDArray[np.float64]


class Odometry:
    """T_odom_base over the last seconds; planar where the scans are.

    The source that is first able to tell a pose is kept: two of them may differ by any offset.

    Args:
        parameters: names of the frames.
        transforms: what arrived on /tf and /tf_static.

    Attributes:
        source: "TF", the topic, or None: no pose could be told so far.
    """

    def __init__(self, parameters: Parameters, transforms: TransformBuffer) -> None:
        self._parameters, self._transforms = parameters, transforms
        self._messages = TransformBuffer(round(1e9 * parameters.tf_buffer_duration))
        self._child = ""
        self.source: str | None = None

    @property
    def is_expected(self) -> bool:
        """False where the robot has none."""
        return bool(self._parameters.odom_frame)

    def add_message(self, message: Any) -> bool:
        """Add an Odometry message; False: its pose is none."""
        self._child = frame_name(message.child_frame_id)
        values, stamp = pose_values(message.pose.pose), stamp_ns(message.header)
        return self._messages.add("odometry", "robot", stamp, values, static=False)

    def pose_at(self, stamp: int) -> Float | None:
        """(D+1, D+1) T_odom_base; None: it is not known (yet)."""
        names, topic = self._parameters, self._parameters.odom_topic
        if not self.is_expected:
            return None
        if self.source in (None, "TF"):
            T = self._transforms.lookup(names.odom_frame, names.base_frame, stamp)
            if T is not None:
                self.source = "TF"
                return self._flatten(T)
        if self.source in (None, topic):
            T = self._messages.lookup("odometry", "robot", stamp)
            if T is not None:
                self.source = topic
                return self._flatten(T @ self._child_to_base(stamp))
        return None

    def forget(self) -> None:
        """Forget all that was told so far: time has begun anew."""
        self._messages.forget()

    def begins_after(self, stamp: int) -> bool:
        """True if it is known for later times alone."""
        names = self._parameters
        return self.is_expected and (
            self._transforms.begins_after(names.odom_frame, names.base_frame, stamp)
            or self._messages.begins_after("odometry", "robot", stamp)
        )

    def _flatten(self, T: Float) -> Float:
        return to_plane(T) if self._parameters.dimension == 2 else T

    def _child_to_base(self, stamp: int) -> Float:
        """(4, 4) of the robot's frame in that of the messages; the same where nobody tells."""
        base = self._parameters.base_frame
        T = self._transforms.lookup(self._child, base, stamp) if self._child else None
        return np.eye(4) if T is None else T
