"""Refinement of an alignment of two maps, by what both show: surfaces and free space."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.places.map_search import middle_of
from stillmap.places.surface_map import CONFLICT_WEIGHT, SurfaceMap

Float = NDArray[np.float64]

_STEPS = (2.0, 1.0, 0.5)  # squares, by which an alignment is moved and turned
_MAX_MOVES = 12  # of each length
_BLUR = 1.0  # squares, std: so that a surface that lies nearer counts more
_MAX_POINTS = 1500  # of each map, evenly spread


class _Layer(NamedTuple):
    """A map: its blurred field, its lowest square, some of its surfaces, and how many each counts
    for."""

    field: NDArray[np.float32]
    low: NDArray[np.int64]
    points: Float
    weight: float


class MapRefiner:
    """Climbs to the alignment under which two maps agree most, nearby."""

    def __init__(self, place: SurfaceMap, session: SurfaceMap) -> None:
        self._place, self._session = _make_layer(place), _make_layer(session)
        self._edge, self._middle = place.edge, middle_of(session)
        offset = session.surface - self._middle
        self._spread = max(float(np.sqrt(np.square(offset).sum(axis=1).mean())), place.edge)

    def refine(self, T: Float) -> Float:
        """T_place_session (3, 3) of the optimum that steps of falling length reach."""
        x = np.array([*(T[:2, :2] @ self._middle + T[:2, 2]), np.arctan2(T[1, 0], T[0, 0])])
        best = self._score(x)
        for length in _STEPS:
            step = length * self._edge
            moves = np.diag([step, step, step / self._spread])
            for _ in range(_MAX_MOVES):
                tried = np.concatenate([x + moves, x - moves])
                scores = [self._score(one) for one in tried]
                k = int(np.argmax(scores))
                if scores[k] <= best:
                    break
                x, best = tried[k], scores[k]
        return self._to_alignment(x)

    def _to_alignment(self, x: Float) -> Float:
        back = se2.matrix(-self._middle[0], -self._middle[1], 0.0)
        out: Float = se2.matrix(float(x[0]), float(x[1]), float(x[2])) @ back
        return out

    def _score(self, x: Float) -> float:
        """Evidence of both maps with the session's middle at x, y and its heading."""
        T = self._to_alignment(x)
        return self._look_up(self._place, self._session, T) + self._look_up(
            self._session, self._place, se2.inverse(T)
        )

    def _look_up(self, known: _Layer, other: _Layer, T: Float) -> float:
        points = other.points @ T[:2, :2].T + T[:2, 2]
        at = np.floor(points / self._edge).astype(np.int64) - known.low
        inside = ((at >= 0) & (at < known.field.shape)).all(axis=1)
        x, y = at[inside].T
        return other.weight * float(known.field[x, y].sum())


def _make_layer(known: SurfaceMap) -> _Layer:
    from scipy import ndimage  # slow to load

    field = known.near.astype(np.float32) - np.float32(CONFLICT_WEIGHT) * known.free
    step = max(len(known.surface) // _MAX_POINTS, 1)
    return _Layer(
        ndimage.gaussian_filter(field.astype(np.float32), _BLUR),
        known.low,
        known.surface[::step].astype(np.float64),
        float(step),
    )
