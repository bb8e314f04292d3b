"""Random beams on which the core and its plain twin must agree."""

import resource
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest


@dataclass(frozen=True)
class Beams:
    points: Any
    hit: Any
    offset: Any
    T_map_sensor: Any
    e: Any
    resolution: float

    @property
    def dimension(self) -> int:
        return self.points.shape[1]

    def grid(self, kernels: ModuleType, threads: int = 1) -> Any:
        """The grid of all beams."""
        grid = self.empty_grid(kernels)
        kernels.add_beams(
            grid, self.points, self.hit, self.e, self.offset, self.T_map_sensor, threads
        )
        return grid

    def empty_grid(self, kernels: ModuleType) -> Any:
        return (kernels.Grid2D if self.dimension == 2 else kernels.Grid3D)(self.resolution)

    @property
    def arguments(self) -> tuple[Any, ...]:
        return self.points, self.hit, self.offset, self.T_map_sensor

    def with_(self, **changes: Any) -> "Beams":
        return replace(self, **changes)


def random_rotation(rng: np.random.Generator, dimension: int) -> Any:
    q, r = np.linalg.qr(rng.normal(size=(dimension, dimension)))
    q *= np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    return q


def random_beams(seed: int, dimension: int, scans: int = 12, beams: int = 240) -> Beams:
    """Ragged scans, some of them empty, on both sides of the origin; NaN, maximum range, any e."""
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.integers(0, beams + 1, scans - 1))
    cuts[: min(2, scans - 1)] = 0  # the first scans are empty
    T = np.tile(np.eye(dimension + 1), (scans, 1, 1))
    T[:, :dimension, :dimension] = [random_rotation(rng, dimension) for _ in range(scans)]
    T[:, :dimension, dimension] = rng.normal(scale=0.7, size=(scans, dimension))
    points = rng.normal(scale=1.2, size=(beams, dimension)).astype(np.float32)
    points[rng.random(beams) < 0.1, rng.integers(dimension)] = np.nan
    return Beams(
        points=points,
        hit=rng.random(beams) < 0.75,
        offset=np.array([0, *cuts, beams], np.int64),
        T_map_sensor=T,
        e=rng.uniform(0.01, 0.99, beams).astype(np.float32),
        resolution=float(rng.uniform(0.15, 0.4)),
    )


@pytest.fixture(params=[(2, 1), (2, 2), (3, 3), (3, 4)], ids=lambda p: f"{p[0]}D-{p[1]}")
def beams(request: pytest.FixtureRequest) -> Beams:
    dimension, seed = request.param
    return random_beams(seed, dimension)


@pytest.fixture
def bounded_memory() -> Iterator[None]:
    """A walk that never ends runs into MemoryError before it brings the machine down."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    # on top of what is mapped: address sanitizers reserve terabytes
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (6 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
