"""The hand-worked cases run against both implementations, and the little world they share."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pytest

# Sensor poses whose x axis looks along an axis of the map, exactly and from whole cells
ALONG_X = [[1, 0, 2], [0, 1, 3], [0, 0, 1]]
ALONG_MINUS_Y = [[0, 1, 2], [-1, 0, 1], [0, 0, 1]]
ALONG_X_3D = [[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, -4], [0, 0, 0, 1]]
ALONG_Z = [[0, -1, 0, 2], [0, 0, -1, 3], [1, 0, 0, -4], [0, 0, 0, 1]]


@dataclass(frozen=True)
class Lane:
    """Beams along the sensor's x axis through a lane of cells, numbered from the sensor's on."""

    impl: ModuleType
    T_map_sensor: Any  # (D+1, D+1)
    resolution: float

    @property
    def dimension(self) -> int:
        return len(self.T_map_sensor) - 1

    def grid(self) -> Any:
        make = self.impl.OccupancyGrid2D if self.dimension == 2 else self.impl.OccupancyGrid3D
        return make(self.resolution)

    def points(self, ranges: Any) -> Any:
        """(M, D) end points at `ranges` in cells, in the middle of the lane."""
        points = np.full((len(ranges), self.dimension), 0.0, np.float32)
        points[:, 0] = np.multiply(ranges, self.resolution)
        return points

    def beams(self, ranges: Any, hit: Any, scans: int = 1) -> tuple[Any, ...]:
        """points, hit, offset, T_map_sensor with the beams dealt evenly to the scans."""
        offset = np.linspace(0, len(ranges), scans + 1).astype(np.int64)
        return self.points(ranges), np.array(hit, bool), offset, np.array([self.pose] * scans)

    @property
    def pose(self) -> Any:
        """T_map_sensor with its sensor in the middle of the sides of the first cell."""
        T = np.array(self.T_map_sensor, float)
        forward = T[:-1, 0]
        T[:-1, -1] += 0.5 * (1 - np.abs(forward)) + (forward < 0)
        T[:-1, -1] *= self.resolution
        return T

    def add(self, grid: Any, ranges: Any, hit: Any, e: Any, start: float = 0) -> None:
        """Count beams whose sensor has gone `start` cells ahead."""
        points, struck, offset, T = self.beams(ranges, hit)
        T[:, :-1, -1] += start * self.resolution * T[:, :-1, 0]
        self.impl.add_beams(grid, points, struck, np.array(e, np.float32), offset, T)

    def cells(self, numbers: Any) -> Any:
        """(K, D) cells of the lane in the map."""
        T = np.array(self.T_map_sensor, np.int64)
        return T[:-1, -1] + np.outer(numbers, T[:-1, 0])

    def alpha_beta(self, grid: Any, numbers: Any) -> Any:
        return grid.alpha_beta(self.cells(numbers))

    def known_map(self) -> Any:
        """A grid with occupancies known by hand; cell 4 and beyond are unknown.

        | cell  | 0 | 1   | 2 | 3   |
        |-------|---|-----|---|-----|
        | alpha | 0 | 1   | 0 | 3   |    three beams end in cell 3, one in cell 1, and
        | beta  | 5 | 4   | 4 | 1   |    one of maximum range passes cells 0 to 3
        | m     | 0 | 1/5 | 0 | 3/4 |
        """
        grid = self.grid()
        self.add(grid, [3.5, 3.5, 3.5, 1.5, 4.5], [1, 1, 1, 1, 0], [1, 1, 1, 1, 0.5])
        return grid


def _module(name: str) -> ModuleType:
    # imported here and without a guard: a core that is missing fails its tests
    if name == "core":
        from stillmap import _core

        return _core
    import reference

    return reference


@pytest.fixture(params=["reference", "core"])
def impl(request: pytest.FixtureRequest) -> ModuleType:
    return _module(request.param)


@pytest.fixture(
    params=[(ALONG_X, 1.0), (ALONG_MINUS_Y, 0.5), (ALONG_X_3D, 0.25), (ALONG_Z, 1.0)],
    ids=["2D-x", "2D-minus-y", "3D-x", "3D-z"],
)
def lane(request: pytest.FixtureRequest, impl: ModuleType) -> Lane:
    T, resolution = request.param
    return Lane(impl, T, resolution)
