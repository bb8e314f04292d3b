"""Surfel map: one surfel per cell with returns, and the plane through its neighbourhood."""

# ruff: noqa: ARG002  (threads: as the kernels have it)

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from reference.beam_counting import usable_beams
from reference.ray_traversal import cell_of

Float = NDArray[np.float64]
Cell = tuple[int, ...]

WINDOWS = (2, 4, 6)  # radii in cells; the first with half of the returns on planes is used
MIN_EXTENT = 0.15  # of a plane: variance along it / (window radius)^2
MAX_FLATNESS = 0.25  # of a plane: variance across it / variance along it
OFF = 2.0  # standard deviations from the plane beyond which a cell is not part of it
OFF_END = 3.0  # the same for a single end point, in noise_std
MIN_OFF = 0.2  # cells, tolerance for smooth planes
FACE = 1.0  # cells between the plane of one face of a thin wall and the cells that belong to it
STRAY = 0.1  # share of the end points that are of neither face
LASTING = 0.5  # mean hit span of a cell of a face over that of the face
EXTENT = 0.5  # of the half width of uniformly spread end points that counts as plane


@dataclass(frozen=True, eq=False)
class Plane:
    """Plane through the neighbourhood of a surfel, in metres.

    Attributes:
        normal: (D,) unit normal.
        centre: (D,) mean of the end points in the window.
        half: half width.
        off_plane: signed distance of the centre of the surfel's cell along the normal.
        across: standard deviation of the end points along the normal.
    """

    normal: Float
    centre: Float
    half: float
    off_plane: float
    across: float


@dataclass(frozen=True, eq=False)
class Surfel:
    """Surfel of a cell with returns.

    Attributes:
        cell: integer coordinates.
        beams: number of returns.
        mean: (D,) of the end points, metres.
        prominence: `beams` / the largest number of returns of a cell in the window.
        plane: None where the neighbourhood is not planar.
    """

    cell: Cell
    beams: int
    mean: Float
    prominence: float
    plane: Plane | None


class SurfelMap:
    """Surfels of all returns.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.

    Attributes:
        fitted: (E,) the surfels, after `fit`.
        noise_std: metres, median of `across` over all returns on planes.
    """

    def __init__(self, resolution, dimension):
        if not 0 < resolution < np.inf:
            raise ValueError(f"resolution: expected a positive length, got {resolution}")
        self.resolution = resolution
        self.dimension = dimension
        self.ends: dict[Cell, list[Float]] = {}
        self.ways: dict[Cell, list[Float]] = {}  # of the beams that ended there
        self.time_bins: dict[Cell, list[int]] = {}
        self.fitted: list[Surfel] = []
        self.noise_std = 0.0

    @property
    def size(self):
        return len(self.ends)

    def add_end_points(self, points, hit, offset, T_map_sensor, time_bin=None):
        """Add end points of returns; time_bin (T,) of their scans."""
        for beam in usable_beams(self.dimension, points, hit, offset, T_map_sensor):
            if beam.hit:
                cell = self._end_cell(beam)
                self.ends.setdefault(cell, []).append(beam.end)
                self.ways.setdefault(cell, []).append(beam.end - beam.start)
                if time_bin is not None:
                    self.time_bins.setdefault(cell, []).append(int(np.asarray(time_bin)[beam.scan]))

    def fit(self):
        """Fit means, planes and noise_std; noisy data needs wider windows."""
        for radius in WINDOWS:
            self.fitted = [self._fit_surfel(cell, radius) for cell in self.ends]
            across = [e.plane.across for e in self.fitted if e.plane for _ in range(e.beams)]
            if 2 * len(across) >= sum(e.beams for e in self.fitted):
                break
        self.noise_std = float(np.sort(across)[(len(across) - 1) // 2]) if across else 0.0
        are_planar = 2 * len(across) >= sum(e.beams for e in self.fitted)
        if self.dimension == 2 and are_planar and 2.0 * self.noise_std <= FACE * self.resolution:
            self.fitted = [e if e.plane else self._fit_face(e, radius) for e in self.fitted]

    def surfels(self):
        """cells, means, normals (E, D) each, off_plane, prominence, beams (E,) each."""
        D, nowhere = self.dimension, np.zeros(self.dimension)
        return (
            np.array([e.cell for e in self.fitted], np.int64).reshape(-1, D),
            np.array([e.mean for e in self.fitted]).reshape(-1, D),
            np.array([e.plane.normal if e.plane else nowhere for e in self.fitted]).reshape(-1, D),
            np.array([e.plane.off_plane if e.plane else 0.0 for e in self.fitted]),
            np.array([e.prominence for e in self.fitted]),
            np.array([e.beams for e in self.fitted], np.int64),
        )

    @property
    def hit_spans(self):
        """(E, 2) first and last time bin with a return, if bins were given."""
        spans = [(min(bins), max(bins)) for bins in self.time_bins.values()]
        return np.array(spans, np.int32).reshape(-1, 2)

    def associate_beams(self, points, hit, offset, T_map_sensor, threads=1):
        """(M,) index of the surfel that each beam ended on, -1: none."""
        number = self.index_of_cell()
        out = np.full(len(np.asarray(points)), -1, np.int32)
        for beam in usable_beams(self.dimension, points, hit, offset, T_map_sensor):
            if beam.hit:
                out[beam.number] = self._associate(beam, number)
        return out

    def index_of_cell(self):
        """Index of the surfel of each cell."""
        return {cell: k for k, cell in enumerate(self.ends)}

    def _associate(self, beam, number):
        """Surfel of the end cell, or the nearest adjacent one whose plane the end point is on."""
        own = number.get(self._end_cell(beam), -1)
        if self.dimension == 2 or own < 0 or not self._is_off_plane(own, beam.end):
            return own
        adjacent = [number[c] for c in window_cells(self._end_cell(beam), 1) if c in number]
        fit = [k for k in adjacent if not self._is_off_plane(k, beam.end)]
        return min(fit, key=lambda k: np.sum((self.fitted[k].mean - beam.end) ** 2), default=own)

    def _is_off_plane(self, k, end):
        plane = self.fitted[k].plane
        least = MIN_OFF * self.resolution
        return plane is not None and bool(
            abs(plane.normal @ (end - plane.centre)) > OFF_END * self.noise_std + least
        )

    def _end_cell(self, beam):
        return tuple(cell_of(beam.end, self.resolution).tolist())

    def _fit_surfel(self, cell, radius):
        """Surfel of a cell from the end points in a window around it."""
        window = [c for c in window_cells(cell, radius) if c in self.ends]
        ends = self.ends[cell]
        return Surfel(
            cell=cell,
            beams=len(ends),
            mean=np.mean(ends, axis=0),
            prominence=len(ends) / max(len(self.ends[c]) for c in window),
            plane=self._fit_plane(cell, window, radius),
        )

    def _fit_plane(self, cell, window, radius):
        around = np.array([end for c in window for end in self.ends[c]])
        variance, axes = np.linalg.eigh(np.cov(around.T, bias=True))  # ascending
        if not self._is_flat(variance, radius):
            return None
        normal, centre = axes[:, 0], around.mean(axis=0)
        apart = abs(float(normal @ (np.mean(self.ends[cell], axis=0) - centre)))
        far = apart > MIN_OFF * self.resolution and apart**2 > OFF**2 * variance[0]
        if self.dimension == 3 and far:
            return None  # feet and wheels are not part of the ground below them
        middle = (np.array(cell) + 0.5) * self.resolution
        return Plane(
            normal=normal,
            centre=centre,
            half=EXTENT * float(np.sqrt(3.0 * variance[1])),
            off_plane=float(normal @ (middle - centre)),
            across=float(np.sqrt(max(variance[0], 0.0))),
        )

    def _is_extended(self, variance, radius):
        return bool(variance[1] > MIN_EXTENT * (radius * self.resolution) ** 2)

    def _is_flat(self, variance, radius):
        flat = bool(variance[0] < MAX_FLATNESS * variance[1])
        return flat and self._is_extended(variance, radius)

    def _fit_face(self, surfel, radius):
        """With the plane of the face that it is on, where a wall has another one in the window."""
        window = [c for c in window_cells(surfel.cell, radius) if c in self.ends]
        ends = np.array([end for c in window for end in self.ends[c]])
        variance, axes = np.linalg.eigh(np.cov(ends.T, bias=True))
        if not self._is_extended(variance, radius):
            return surfel
        normal = axes[:, 0]
        offset = np.array([normal @ (np.mean(self.ends[c], axis=0) - surfel.mean) for c in window])
        beams = np.array([len(self.ends[c]) for c in window])
        near = np.abs(offset) <= FACE * self.resolution
        strays, other = ~near & (offset < 0.0), ~near & (offset > 0.0)
        if beams[strays].sum() > beams[other].sum():
            strays, other = other, strays
        if beams[strays].sum() > STRAY * beams.sum() or not other.any():
            return surfel
        far = np.array(
            [end for c, of in zip(window, other, strict=True) if of for end in self.ends[c]]
        )
        if not self._is_flat(np.linalg.eigvalsh(np.cov(far.T, bias=True)), radius):
            return surfel
        own = [c for c, of in zip(window, near, strict=True) if of]
        plane = self._fit_plane(surfel.cell, own, radius)
        if plane is None:
            return surfel
        beyond = [c for c, of in zip(window, other, strict=True) if of]
        views = [self._view(cells) @ plane.normal for cells in (own, beyond)]
        lasts = min(self._span_share(cells) for cells in (own, beyond)) >= LASTING
        is_face = views[0] * views[1] < 0.0 or lasts
        return replace(surfel, plane=plane) if is_face else surfel

    def _view(self, cells):
        """Sum of the unit vectors of the beams that ended in some cells."""
        ways = np.array([way for c in cells for way in self.ways[c]])
        return np.asarray((ways / np.linalg.norm(ways, axis=1, keepdims=True)).sum(axis=0))

    def _span_share(self, cells):
        """Mean hit span of some cells over that of all of them; 0 without time bins."""
        bins = [self.time_bins[c] for c in cells if c in self.time_bins]
        if not bins:
            return 0.0
        spans = [max(one) - min(one) + 1 for one in bins]
        return float(np.mean(spans)) / (max(map(max, bins)) - min(map(min, bins)) + 1)


def window_cells(cell, radius):
    """Cells of the cube of some radius around a cell."""
    return list(product(*(range(c - radius, c + radius + 1) for c in cell)))


SurfelMap2D = partial(SurfelMap, dimension=2)
SurfelMap3D = partial(SurfelMap, dimension=3)
