"""Where beams ended: one element of surface per cell, and how it lies among its neighbours."""

from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.beam_counting import Beam, usable_beams
from reference.ray_traversal import cell_of

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Cell = tuple[int, ...]

WINDOWS = (2, 4, 6)  # cells to each side: the first in which half of the beams lie on surfaces
WIDE = 0.15  # a surface varies along itself by more than this times the window's radius squared
FLAT = 0.25  # and across itself by less than this times that
OFF = 2.0  # standard deviations from the surface around it, from where on a cell is of another
OFF_END = 3.0  # scatters, the same for a single end point
OFF_LEAST = 0.2  # cells; nearer is on it, however smooth it is
EXTENT = 0.5  # how much of the half width that evenly spread end points fill counts as surface


@dataclass(frozen=True, eq=False)
class Patch:
    """The piece of surface around an element, in metres.

    Attributes:
        normal: (D,) unit vector across it.
        centre: (D,) mean of the end points in the window.
        half: how far it extends from there.
        off_plane: of the middle of the element's cell from it, signed along the normal.
        across: standard deviation of the end points across it.
    """

    normal: Float
    centre: Float
    half: float
    off_plane: float
    across: float


@dataclass(frozen=True, eq=False)
class Element:
    """What is known of a cell in which beams ended.

    Attributes:
        cell: its integer coordinates.
        beams: number of beams that ended in it.
        mean: (D,) of their end points, metres.
        prominence: `beams` against those of the richest cell in the window.
        patch: None where the surroundings are no surface.
    """

    cell: Cell
    beams: int
    mean: Float
    prominence: float
    patch: Patch | None


class SurfelMap:
    """The end points of all hits, by cells.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.

    Attributes:
        list: (E,) the elements, after `fit`.
        noise_std: metres, median of `across` over all beams that end on surfaces.
    """

    def __init__(self, resolution: float, dimension: int) -> None:
        if not 0 < resolution < np.inf:
            raise ValueError(f"resolution: expected a positive length, got {resolution}")
        self.resolution = resolution
        self.dimension = dimension
        self.ends: dict[Cell, list[Float]] = {}
        self.looks: dict[Cell, list[int]] = {}
        self.list: list[Element] = []
        self.noise_std = 0.0

    @property
    def size(self) -> int:
        return len(self.ends)

    def add_end_points(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        time_bin: ArrayLike | None = None,
    ) -> None:
        """Notes where the beams that were hit ended, and in which look of their scans (T,)."""
        for beam in usable_beams(self.dimension, points, hit, offset, T_map_sensor):
            if beam.hit:
                cell = self._end_cell(beam)
                self.ends.setdefault(cell, []).append(beam.end)
                if time_bin is not None:
                    self.looks.setdefault(cell, []).append(int(np.asarray(time_bin)[beam.scan]))

    def fit(self) -> None:
        """Means, surfaces and scatter; the window widens until it sees walls for all the noise."""
        for radius in WINDOWS:
            self.list = [
                self._element(cell, [c for c in near(cell, radius) if c in self.ends], radius)
                for cell in self.ends
            ]
            across = [e.patch.across for e in self.list if e.patch for _ in range(e.beams)]
            if 2 * len(across) >= sum(e.beams for e in self.list):
                break
        self.noise_std = float(np.sort(across)[(len(across) - 1) // 2]) if across else 0.0

    def surfels(self) -> tuple[Int, Float, Float, Float, Float, Int]:
        """cells, means, normals (E, D) each, off_plane, prominence, beams (E,) each."""
        D, nowhere = self.dimension, np.zeros(self.dimension)
        return (
            np.array([e.cell for e in self.list], np.int64).reshape(-1, D),
            np.array([e.mean for e in self.list]).reshape(-1, D),
            np.array([e.patch.normal if e.patch else nowhere for e in self.list]).reshape(-1, D),
            np.array([e.patch.off_plane if e.patch else 0.0 for e in self.list]),
            np.array([e.prominence for e in self.list]),
            np.array([e.beams for e in self.list], np.int64),
        )

    @property
    def hit_spans(self) -> NDArray[np.int32]:
        """(E, 2) first and last look at which beams ended in each, if looks were given."""
        spans = [(min(looks), max(looks)) for looks in self.looks.values()]
        return np.array(spans, np.int32).reshape(-1, 2)

    def associate_beams(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        threads: int = 1,  # noqa: ARG002  the core's signature
    ) -> NDArray[np.int32]:
        """(M,) the element in which each beam ended, -1: none."""
        number = self.numbers()
        out = np.full(len(np.asarray(points)), -1, np.int32)
        for beam in usable_beams(self.dimension, points, hit, offset, T_map_sensor):
            if beam.hit:
                out[beam.number] = self._owner(beam, number)
        return out

    def numbers(self) -> dict[Cell, int]:
        """The element of each cell that has one."""
        return {cell: k for k, cell in enumerate(self.ends)}

    def _owner(self, beam: Beam, number: dict[Cell, int]) -> int:
        """That of its cell, or of the nearest one beside that it does not lie off."""
        own = number.get(self._end_cell(beam), -1)
        if self.dimension == 2 or own < 0 or not self._lies_off(own, beam.end):
            return own
        beside = [number[c] for c in near(self._end_cell(beam), 1) if c in number]
        fit = [k for k in beside if not self._lies_off(k, beam.end)]
        return min(fit, key=lambda k: np.sum((self.list[k].mean - beam.end) ** 2), default=own)

    def _lies_off(self, k: int, end: Float) -> bool:
        patch = self.list[k].patch
        least = OFF_LEAST * self.resolution
        return patch is not None and bool(
            abs(patch.normal @ (end - patch.centre)) > OFF_END * self.noise_std + least
        )

    def _end_cell(self, beam: Beam) -> Cell:
        return tuple(cell_of(beam.end, self.resolution).tolist())

    def _element(self, cell: Cell, window: list[Cell], radius: int) -> Element:
        """What the cells with end points in a window around it, itself among them, say of one."""
        ends = self.ends[cell]
        return Element(
            cell=cell,
            beams=len(ends),
            mean=np.mean(ends, axis=0),
            prominence=len(ends) / max(len(self.ends[c]) for c in window),
            patch=self._patch(cell, window, radius),
        )

    def _patch(self, cell: Cell, window: list[Cell], radius: int) -> Patch | None:
        around = np.array([end for c in window for end in self.ends[c]])
        variance, axes = np.linalg.eigh(np.cov(around.T, bias=True))  # rising
        wide = variance[1] > WIDE * (radius * self.resolution) ** 2
        if not wide or variance[0] >= FLAT * variance[1]:
            return None
        normal, centre = axes[:, 0], around.mean(axis=0)
        apart = abs(float(normal @ (np.mean(self.ends[cell], axis=0) - centre)))
        far = apart > OFF_LEAST * self.resolution and apart**2 > OFF**2 * variance[0]
        if self.dimension == 3 and far:
            return None  # feet, and wheels, are not of the ground that they stand on
        middle = (np.array(cell) + 0.5) * self.resolution
        return Patch(
            normal=normal,
            centre=centre,
            half=EXTENT * float(np.sqrt(3.0 * variance[1])),
            off_plane=float(normal @ (middle - centre)),
            across=float(np.sqrt(max(variance[0], 0.0))),
        )


def near(cell: Cell, radius: int) -> list[Cell]:
    """The cells of the cube of that radius around a cell."""
    return list(product(*(range(c - radius, c + radius + 1) for c in cell)))


SurfelMap2D = partial(SurfelMap, dimension=2)
SurfelMap3D = partial(SurfelMap, dimension=3)
