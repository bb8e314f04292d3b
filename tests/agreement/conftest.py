"""Random beams and rooms on which kernels and twins must agree."""

import resource
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from surfel_maps import fit_surfels


@dataclass(frozen=True)
class Beams:
    points: Any
    hit: Any
    offset: Any
    T_map_sensor: Any
    e: Any
    resolution: float

    @property
    def dimension(self):
        return self.points.shape[1]

    def grid(self, kernels, threads=1):
        """The grid of all beams."""
        grid = self.empty_grid(kernels)
        kernels.add_beams(grid, *self.weighted, threads)
        return grid

    def empty_grid(self, kernels):
        return getattr(kernels, f"OccupancyGrid{self.dimension}D")(self.resolution)

    @property
    def arguments(self):
        return self.points, self.hit, self.offset, self.T_map_sensor

    @property
    def weighted(self):
        return self.points, self.hit, self.e, self.offset, self.T_map_sensor

    def with_(self, **changes):
        return replace(self, **changes)


def random_rotation(rng, dimension):
    q, r = np.linalg.qr(rng.normal(size=(dimension, dimension)))
    q *= np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    return q


def random_beams(seed, dimension, scans=12, beams=240):
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


def ranges(origins, directions, walls, mover, radius):
    """Ranges of rays in a convex room (normals, distances) to its walls or a ball."""
    normals, distances = walls
    with np.errstate(divide="ignore"):
        to_walls = (distances - origins @ normals.T) / (directions @ normals.T)
    found = np.where(to_walls > 0, to_walls, np.inf).min(axis=1)
    off = mover - origins
    along = np.einsum("nd,nd->n", off, directions)
    depth = radius**2 - np.einsum("nd,nd->n", off, off) + along**2
    near = along - np.sqrt(np.maximum(depth, 0))
    return np.where((depth > 0) & (near > 0), np.minimum(near, found), found)


@dataclass(frozen=True)
class Room:
    """Beams of some scans and the time bins of these."""

    beams: Beams
    time_bin: Any
    lengths: dict[str, float]

    def surface(self, kernels):
        kind = f"SurfelMap{self.beams.dimension}D"
        return fit_surfels(kernels, kind, self.beams.resolution, *self.beams.arguments)

    def hmm(self, kernels, surface, rho, tau, view_angle=None, p_detection=0.8, **changes):
        model = {"rho": rho, "tau": tau, "view_angle": view_angle or [], "bin_seconds": 1.0}
        kind = getattr(kernels, f"OccupancyHmm{self.beams.dimension}D")
        return kind(surface, p_detection=p_detection, **{**model, **self.lengths, **changes})

    def scans(self, first, last):
        b = self.beams
        part = slice(b.offset[first], b.offset[last])
        offset = b.offset[first : last + 1] - b.offset[first]
        return b.points[part], b.hit[part], offset, b.T_map_sensor[first:last]


def make_room(seed, dimension, resolution, scans, beams, noise=0.01):
    """A slanted box of walls around the origin with a moving ball."""
    rng = np.random.default_rng(seed)
    R = random_rotation(rng, dimension)
    walls = np.concatenate([R, -R]), rng.uniform(1.2, 2.2, 2 * dimension)
    mover, speed = np.zeros(dimension), rng.normal(scale=0.15, size=dimension)
    T = np.tile(np.eye(dimension + 1), (scans, 1, 1))
    points, hit = [], []
    for t in range(scans):
        T[t, :dimension, :dimension] = random_rotation(rng, dimension)
        T[t, :dimension, dimension] = rng.uniform(-0.5, 0.5, dimension)
        mover = mover + speed
        u = rng.normal(size=(beams, dimension))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        origins = np.tile(T[t, :dimension, dimension], (beams, 1))
        r = ranges(origins, u @ T[t, :dimension, :dimension].T, walls, mover, 0.3)
        struck = r < 2.2
        r = np.where(struck, r + rng.normal(scale=noise, size=beams), 2.2)
        points.append(u * r[:, None])
        hit.append(struck)
    points = np.concatenate(points).astype(np.float32)
    points[rng.random(len(points)) < 0.05, rng.integers(dimension)] = np.nan
    step = rng.choice([0, 0, 1, 1, 2, 70, 5000], scans)
    return Room(
        Beams(
            points=points,
            hit=np.concatenate(hit) & np.isfinite(points).all(axis=1),
            offset=np.arange(scans + 1) * beams,
            T_map_sensor=T,
            e=np.ones(len(points), np.float32),
            resolution=resolution,
        ),
        time_bin=np.cumsum(step),
        lengths={
            "lateral_std": 0.4 * resolution,
            "margin": 1.2 * resolution,
            "hit_radius": 0.9 * resolution,
            "end_margin": 0.35,
        },
    )


@pytest.fixture(scope="session")
def a_room():
    """Makes rooms."""
    return make_room


@pytest.fixture(scope="session")
def some_beams():
    """Makes random beams of a seed and a dimension."""
    return random_beams


@pytest.fixture(params=[(2, 1), (2, 2), (3, 3), (3, 4)], ids=lambda p: f"{p[0]}D-{p[1]}")
def beams(request):
    dimension, seed = request.param
    return random_beams(seed, dimension)


@pytest.fixture
def bounded_memory():
    """An endless traversal raises MemoryError before it exhausts the machine."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    # in addition to mapped memory: address sanitizers reserve terabytes
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (6 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
