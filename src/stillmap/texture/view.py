"""One picture, and where it was taken."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.images import Camera

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """A picture that can be used: of a known lens, from a known place.

    Attributes:
        image: its number in the recording's images.
        stamp_ns: when it was taken, by the clock of the scans.
        camera: that took it; `K` and `T_base_camera` are known.
        T_camera_map: (4, 4) from the map frame to the camera's: x right, y down, z ahead.
    """

    image: int
    stamp_ns: int
    camera: Camera
    T_camera_map: Float

    @property
    def place(self) -> Float:
        """(3,) metres, where the camera was in the map frame."""
        R, t = self.T_camera_map[:3, :3], self.T_camera_map[:3, 3]
        return np.asarray(-R.T @ t)

    def in_camera(self, points: Float) -> Float:
        """(n, 3) metres in the camera's frame, of points (n, 3) in the map frame."""
        return np.asarray(points @ self.T_camera_map[:3, :3].T + self.T_camera_map[:3, 3])
