"""How far patches go, and what later ones do not come to any more."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.recording.model import Recording
from stillmap.surface.patches import Order

Float = NDArray[np.float64]

_BESIDE = 2.9  # tiles from the middle of one to the farthest corner of those around, and a bit


class Reach(NamedTuple):
    """How far the patches of a recording go, in their order.

    Attributes:
        place: (n, 3) metres.
        range: (n,) metres from there, in which all of a patch lies.
    """

    place: Float
    range: Float

    def settled(self, tiles: NDArray[np.int64], edge: float, done: int) -> NDArray[np.bool_]:
        """(N,) which tiles, metres along an edge, and none beside them, later patches come to."""
        if done >= len(self.place):
            return np.ones(len(tiles), np.bool_)
        middle = (tiles + 0.5) * edge
        away = np.asarray(cKDTree(self.place[done:]).query(middle)[0], np.float64)
        return np.asarray(away > self.range[done:].max() + _BESIDE * edge)


def reach_of(seen: Recording, poses: Float, order: Order) -> Reach:
    """How far the patches that come of these scans go.

    Args:
        seen: 3D.
        poses: (T, 4, 4) T_map_base.
        order: of the patches.
    """
    places, ranges = [], []
    sensor = seen.T_map_sensor(poses)[:, :3, 3]
    for scans in order.groups:
        place, far = sensor[scans].mean(axis=0), 0.0
        for t in scans:
            of = seen.beams_of(int(t))
            length = np.linalg.norm(seen.points[of][seen.hit[of]], axis=1)
            longest = float(np.max(length, initial=0.0, where=np.isfinite(length)))
            far = max(far, longest + float(np.linalg.norm(sensor[t] - place)))
        places.append(place)
        ranges.append(far)
    return Reach(np.array(places).reshape(-1, 3), np.array(ranges))
