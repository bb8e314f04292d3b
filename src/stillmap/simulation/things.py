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
        moved: (P,) which are not the same at all scans.
    """

    poses: Float
    outlines: Outlines
    still: Float
    moved: NDArray[np.bool_]


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
        moved: list[bool] = []
        for number, thing in enumerate(self._things, start=first):
            at = np.full((T, 3), np.nan)
            for stay in thing.stays:
                end = np.inf if stay.until is None else stay.until
                at[(seconds >= stay.since) & (seconds < end)] = (stay.x, stay.y, stay.yaw)
            faces = faces_at(thing, at)
            poses.append(at)
            moved.append(not np.array_equal(at, np.broadcast_to(at[0], at.shape)))
            if not moved[-1]:
                still.append(faces[0])
            else:
                moving.append(faces)
                mover.append(np.full(len(thing.faces), number, np.int32))
        outlines = Outlines(np.concatenate(moving, axis=1), np.concatenate(mover))
        by_scan = np.reshape(poses, (-1, T, 3)).swapaxes(0, 1)
        return Placed(by_scan, outlines, np.concatenate(still), np.array(moved, bool))


def standing(thing: Thing, stay: Stay) -> Float:
    """(K, 4) the faces of a thing in the world, as it stands during a stay."""
    return np.asarray(faces_at(thing, np.array([[stay.x, stay.y, stay.yaw]]))[0])


def faces_at(thing: Thing, poses: Float) -> Float:
    """(T, K, 4) the faces of a thing at poses (T, 3); of no length where these are NaN."""
    T = se2.matrix(*poses.T)[:, None]
    ends = np.reshape(thing.faces, (-1, 2)).astype(float)
    moved = np.einsum("tkij,nj->tni", T[..., :2, :2], ends) + T[..., :2, 2]
    return np.asarray(np.nan_to_num(moved.reshape(len(poses), -1, 4)), np.float64)
