"""Things are larger than a voxel: what is beside an element tells of it. See `docs/space.md`."""

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em.looks import Surface


class BesideOptions(TypedDict):
    """How elements are asked about each other.

    Attributes:
        radius: cells between the cells of two that are asked about each other.
        coplanar: cells, standard deviation of the mean of one from the plane of the other.
        for_static, for_dynamic: nats that neighbours are worth if all of them are of one kind.
        least, most: nats that an element's own looks are worth.
        moved: change of a probability that the neighbours are told of.
        rounds: at most.
    """

    radius: float
    coplanar: float
    for_static: float
    for_dynamic: float
    least: float
    most: float
    moved: float
    rounds: int


BESIDE: BesideOptions = {
    "radius": 2.5,
    "coplanar": 0.2,
    "for_static": 5.0,
    "for_dynamic": 10.0,
    "least": -4.0,
    "most": 3.0,  # what was hit for ten seconds in a row is a wall, or has stopped
    "moved": 0.1,
    "rounds": 10,
}

_CERTAIN = 1e-6


def with_those_beside(
    p_static: NDArray[np.float32], surface: Surface, threads: int = 1
) -> NDArray[np.float32]:
    """(E,) P(static) by the looks at each element alone (E,) and by the elements beside it.

    The surface is one in space that knows the looks of its end points.
    """
    if not isinstance(surface, _core.Surface3D):
        raise TypeError("surface: expected one in space")
    p = np.clip(p_static, _CERTAIN, 1.0 - _CERTAIN)
    log_odds = np.log(p / (1.0 - p)).astype(np.float32)
    return _core.settled(surface, log_odds, **BESIDE, threads=threads)
