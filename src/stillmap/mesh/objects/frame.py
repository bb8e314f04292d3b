"""A moving thing's own frame: x ahead, y left, z up, on the ground below its middle."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.mesh.texture.occluders import TrackedBox

Float = NDArray[np.float64]


class ObjectFrame(NamedTuple):
    """Where a thing's own frame is at any time.

    Attributes:
        thing: its box along its track.
        seconds: (S,) times, rising, at which it is known better; S > 0.
        offset: (S, 3) by how much points in the frame of the track have to be moved there: metres
            ahead and to the left, rad to the left.
    """

    box: TrackedBox
    seconds: Float
    offset: Float

    @classmethod
    def from_track(cls, thing: TrackedBox) -> "ObjectFrame":
        """As the track has it."""
        return cls(thing, thing.box.seconds[:1], np.zeros((1, 3)))

    def to_object(self, seconds: Float, points: Float) -> Float:
        """(n, 3) metres in its own frame, of points (n, 3) in the map frame at times (n,)."""
        box = self.box.box
        middle = box.center_at(seconds)
        ahead = box.heading[_at(box.seconds, seconds)]
        off = points[:, :2] - middle
        foot = np.interp(seconds, box.seconds, self.box.bottom)
        at = np.stack(
            [
                (off * ahead).sum(axis=1),
                off[:, 1] * ahead[:, 0] - off[:, 0] * ahead[:, 1],
                points[:, 2] - foot,
            ],
            axis=1,
        )
        dx, dy, turn = (np.interp(seconds, self.seconds, column) for column in self.offset.T)
        c, s = np.cos(turn), np.sin(turn)
        x, y = c * at[:, 0] - s * at[:, 1] + dx, s * at[:, 0] + c * at[:, 1] + dy
        return np.stack([x, y, at[:, 2]], axis=1)

    def T_map_object(self, seconds: float) -> Float:
        """(4, 4) its own frame at a time."""
        # three points and what `local` makes of them say all of it
        corners = np.vstack([np.zeros(3), np.eye(3)])
        at = self.to_object(np.full(4, seconds), corners)
        T_object_map = np.eye(4)
        T_object_map[:3, :3] = (at[1:] - at[0]).T
        T_object_map[:3, 3] = at[0]
        return np.asarray(np.linalg.inv(T_object_map))


def _at(known: Float, seconds: Float) -> NDArray[np.intp]:
    """(n,) the last of the times (L,) that is not later."""
    return np.clip(np.searchsorted(known, seconds, side="right") - 1, 0, None)
