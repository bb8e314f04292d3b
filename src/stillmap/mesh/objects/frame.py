"""The frame of a moving object: x ahead, y left, z up, on the ground below its center."""

from typing import NamedTuple

import numpy as np

from stillmap.mesh.texture.occluders import TrackedBox
from stillmap.mesh.types import Float


class ObjectFrame(NamedTuple):
    """Pose of an object's frame over time: that of its track, with corrections.

    Attributes:
        box: box along the track.
        seconds: (S,) times of the corrections, rising; S > 0.
        offset: (S, 3) corrections of points in the frame of the track: metres ahead and to the
            left, rad to the left.
    """

    box: TrackedBox
    seconds: Float
    offset: Float

    @classmethod
    def from_track(cls, box: TrackedBox) -> "ObjectFrame":
        """The frame of the track, uncorrected."""
        return cls(box, box.box.seconds[:1], np.zeros((1, 3)))

    def to_object(self, seconds: Float, points: Float) -> Float:
        """(n, 3) metres in the object's frame, of map points (n, 3) at times (n,)."""
        box = self.box.box
        center = box.center_at(seconds)
        heading = box.heading[np.clip(np.searchsorted(box.seconds, seconds, "right") - 1, 0, None)]
        off = points[:, :2] - center
        bottom = np.interp(seconds, box.seconds, self.box.bottom)
        at = np.stack(
            [
                (off * heading).sum(axis=1),
                off[:, 1] * heading[:, 0] - off[:, 0] * heading[:, 1],
                points[:, 2] - bottom,
            ],
            axis=1,
        )
        dx, dy, turn = (np.interp(seconds, self.seconds, column) for column in self.offset.T)
        c, s = np.cos(turn), np.sin(turn)
        x, y = c * at[:, 0] - s * at[:, 1] + dx, s * at[:, 0] + c * at[:, 1] + dy
        return np.stack([x, y, at[:, 2]], axis=1)

    def T_map_object(self, seconds: float) -> Float:
        """(4, 4) pose of the object's frame at a time."""
        corners = np.vstack([np.zeros(3), np.eye(3)])
        at = self.to_object(np.full(4, seconds), corners)
        T_object_map = np.eye(4)
        T_object_map[:3, :3] = (at[1:] - at[0]).T
        T_object_map[:3, 3] = at[0]
        return np.asarray(np.linalg.inv(T_object_map))
