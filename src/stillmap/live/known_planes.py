"""A known map of planes in place of a local one, as `KnownLocalMap` in 2D."""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core

Float = NDArray[np.float64]

_SPACING = 0.5  # m between the poses that are noted of a route
_STATIC = 0.5  # P(static) of the points that are added: over hours others would fill the cells


class KnownPlanes:
    """A known map that sweeps are registered to.

    Args:
        planes: of the map.
        extends: whether sweeps are added to it.
    """

    def __init__(self, planes: _core.NdtMap3D, extends: bool) -> None:
        self.planes = planes
        self._extends = extends
        # poses of the base when sweeps were added, one in each cube: they grow with the area
        self._route = dict[tuple[int, ...], Float]()

    def add(
        self, points: NDArray[np.float32], weights: NDArray[np.float32], T_map_base: Float
    ) -> None:
        """Add points (N, 3) in the base frame with weights P(static), if the map is extended."""
        if self._extends:
            static = weights >= _STATIC
            self.planes.add(points[static], weights[static], T_map_base)
            cube = np.floor(T_map_base[:3, 3] / _SPACING).astype(np.int64)
            self._route.setdefault(tuple(cube.tolist()), T_map_base)

    @property
    def route(self) -> Float:
        """(K, 4, 4) T_map_base from where it was extended."""
        return np.array(list(self._route.values())).reshape(-1, 4, 4)
