"""Things that are moved, brought and taken away: where each of them is, by the clock."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.simulation.laser import Outlines
from stillmap.simulation.scene import Stay, Thing

Float = NDArray[np.float64]


class Placed(NamedTuple):
    """Where P things are at T scans.

    Attributes:
        poses: (T, P, 3) x, y in metres, yaw in rad; NaN where a thing is nowhere.
        outlines: the faces of those that are not the same at all scans; of no length while a thing
            is nowhere.
        still: (K, 4) the faces of those that are.
    """

    poses: Float
    outlines: Outlines
    still: Float


class Things:
    """P things and all their places."""

    def __init__(self, things: tuple[Thing, ...]) -> None:
        self._things = things

    def everywhere(self) -> Float:
        """(K, 4) the faces of all things at all places where they ever stand."""
        faces = [standing(thing, stay) for thing in self._things for stay in thing.stays]
        return np.concatenate([np.empty((0, 4)), *faces])

    def placed(self, seconds: Float, first: int) -> Placed:
        """Where they are when scans are taken.

        Args:
            seconds: (T,) since the recording began.
            first: the number of the first of them among all movers.
        """
        T, poses, still = len(seconds), [], [np.empty((0, 4))]
        moving, mover = [np.empty((T, 0, 4))], [np.empty(0, np.int32)]
        for number, thing in enumerate(self._things, start=first):
            at, faces = np.full((T, 3), np.nan), np.zeros((T, len(thing.faces), 4))
            for stay in thing.stays:
                there = (seconds >= stay.since) & (seconds < _end(stay))
                at[there], faces[there] = (stay.x, stay.y, stay.yaw), standing(thing, stay)
            poses.append(at)
            if np.array_equal(at, np.broadcast_to(at[0], at.shape)):
                still.append(faces[0])
            else:
                moving.append(faces)
                mover.append(np.full(len(thing.faces), number, np.int32))
        outlines = Outlines(np.concatenate(moving, axis=1), np.concatenate(mover))
        return Placed(np.reshape(poses, (-1, T, 3)).swapaxes(0, 1), outlines, np.concatenate(still))


def standing(thing: Thing, stay: Stay) -> Float:
    """(K, 4) the faces of a thing in the world, as it stands during a stay."""
    T = se2.matrix(stay.x, stay.y, stay.yaw)
    ends = np.reshape(thing.faces, (-1, 2)).astype(float)
    return np.asarray((ends @ T[:2, :2].T + T[:2, 2]).reshape(-1, 4))


def _end(stay: Stay) -> float:
    return np.inf if stay.until is None else stay.until
