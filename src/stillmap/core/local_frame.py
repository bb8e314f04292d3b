"""A frame near the robot, for poses in a map projection or another frame that begins far away.

Grids number their cells from the origin, a million along an axis, and 32-bit floats resolve a
millimetre no farther than 10 km from it. What is computed with either therefore happens in a frame
whose axes are those of the map frame and whose origin is close: it is subtracted where poses enter,
and added to what leaves.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr

Float = NDArray[np.float64]

FAR = 1e4  # m, beyond which coordinates are shifted


@dataclass(frozen=True, eq=False)
class LocalFrame(ShortRepr):
    """A frame with the axes of the map frame and an origin of its own.

    Attributes:
        origin: (3,) float64, metres in the map frame; zero: both are one frame.
    """

    origin: Float = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def near(cls, poses: Float) -> "LocalFrame":
        """The map frame itself, unless poses (T, D+1, D+1) are far from its origin.

        Then its origin is the first pose that is near most of the others, so that the same robot
        elsewhere sees the same cells: a receiver may state zeros until it knows where it is.
        """
        dimension = poses.shape[-1] - 1
        origin, positions = np.zeros(3), poses[:, :dimension, dimension]
        positions = positions[np.isfinite(positions).all(axis=1)]
        if len(positions):
            middle = np.median(positions, axis=0)
            if np.abs(middle).max() > FAR:
                apart = np.abs(positions - middle).max(axis=1)
                first = np.argmax(apart <= max(FAR, float(np.median(apart))))
                origin[:dimension] = positions[first]
        return cls(origin)

    @property
    def is_shifted(self) -> bool:
        """True if it differs from the map frame."""
        return bool(self.origin.any())

    def to_local(self, poses: Float) -> Float:
        """Poses (..., D+1, D+1) of the map frame in this frame; itself if it is the map frame."""
        return self._move(poses, -self.origin)

    def to_map(self, poses: Float) -> Float:
        """Poses (..., D+1, D+1) of this frame in the map frame; itself if it is the map frame."""
        return self._move(poses, self.origin)

    def points_to_local(self, points: NDArray[np.floating]) -> Float:
        """Points (..., D) of the map frame in this frame; float64."""
        return self._shift(points, -self.origin)

    def points_to_map(self, points: NDArray[np.floating]) -> Float:
        """Points (..., D) of this frame in the map frame; float64."""
        return self._shift(points, self.origin)

    def corner_to_map(self, corner: tuple[float, float, float]) -> tuple[float, float, float]:
        """The x, y and yaw of a map's corner in the map frame."""
        return self._move_corner(corner, self.origin)

    def corner_to_local(self, corner: tuple[float, float, float]) -> tuple[float, float, float]:
        """The x, y and yaw of a map's corner in this frame."""
        return self._move_corner(corner, -self.origin)

    def _move(self, poses: Float, by: Float) -> Float:
        if not self.is_shifted:
            return poses
        moved, dimension = np.array(poses), poses.shape[-1] - 1
        moved[..., :dimension, dimension] += by[:dimension]
        return moved

    def _shift(self, points: NDArray[np.floating], by: Float) -> Float:
        exact = np.asarray(points, np.float64)
        return exact + by[: exact.shape[-1]] if self.is_shifted else exact

    @staticmethod
    def _move_corner(corner: tuple[float, float, float], by: Float) -> tuple[float, float, float]:
        x, y, yaw = corner
        return x + float(by[0]), y + float(by[1]), yaw
