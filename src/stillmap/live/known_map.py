"""A known map for localization, and what an extended one keeps of it."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.arrays import write_npy
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import cell_keys
from stillmap.em import OccupancyMap
from stillmap.live.causal_labels import OccupancyFilter
from stillmap.live.local_map import Labeller, LocalMap, MappedScan, add_scan, relabel_scan
from stillmap.pipeline.options import MapMode
from stillmap.places.surface_map import SurfaceMap, find_sides
from stillmap.results import reader
from stillmap.results.map_server import write_map_npz, write_map_server
from stillmap.results.near_result import ROUTE, NearResult
from stillmap.results.point_cloud import Block, append_vertices, cloud_from_folder
from stillmap.results.reader import Grid
from stillmap.slam import scan_hits

Layer = NDArray[np.floating]

_SQUARE = 2  # cells along the edge of a square of the surface map
LOG_RATIO = 8.0  # nats by which the map speaks for static surface


def write_extended_cloud(folder: Path, kept: "KeptMap", edge: float) -> None:
    """Append to `static.ply` of a result what stands where this run saw no surface, and write the
    route.

    Args:
        folder: the result.
        kept: of the known map.
        edge: m, of the voxels that one of the two fills.
    """
    seen = cloud_from_folder(folder, "static")
    first = np.floor(seen.origin / edge).astype(np.int64)

    def keys(points: Float) -> Int64:
        return cell_keys(np.floor(points / edge).astype(np.int64) - first)

    own = np.zeros(0, np.int64)
    for block in seen.iter_blocks():
        own = np.union1d(own, keys(block.points))
    only = ~np.isin(keys(kept.points), own)
    more = Block(kept.points[only], kept.p_static[only], None)
    append_vertices(folder / "static.ply", more)
    write_npy(folder / ROUTE, kept.route)


@dataclass(frozen=True, eq=False)
class KeptMap(ShortRepr):
    """The part of a known map that an extended one keeps.

    Attributes:
        grid: the planar map.
        hits: (H, W) its sums of hits.
        stands: of a map in 3D, (H, W) cells in which obstacles are among the points.
        points: (N, 3) float64, m, of such a map those that are still occupied.
        p_static: (N,) float32.
        route: (K, 4, 4) T_map_base from where it was made.
    """

    grid: GridMap
    hits: NDArray[np.floating]
    stands: Bool | None = None
    points: Float = field(default_factory=lambda: np.zeros((0, 3)))
    p_static: Float32 = field(default_factory=lambda: np.zeros(0, np.float32))
    route: Float = field(default_factory=lambda: np.zeros((0, 4, 4)))


def _make_room(
    below: GridMap, above: GridMap
) -> tuple[tuple[float, float, float], Callable[[Layer, float], Layer], Callable[..., Layer]]:
    """The corner of the box around two maps with the same axes and cells, one of which lies on the
    other, and what spreads layers of each over the box, with a value elsewhere."""
    edge = above.resolution
    corners = np.array([grid.origin[1::-1] for grid in (below, above)])
    corners = np.round(corners / edge).astype(int)
    ends = corners + [grid.p_occupied.shape for grid in (below, above)]
    low, high = corners.min(axis=0), ends.max(axis=0)

    def spread(margins: Int64, layer: Layer, fill: float) -> Layer:
        return np.pad(np.asarray(layer, np.float32), margins, constant_values=fill)

    y, x = (low * edge).tolist()
    lower, upper = (partial(spread, m) for m in np.stack([corners - low, high - ends], axis=2))
    return (x, y, 0.0), lower, upper


def overlay(below: GridMap, above: GridMap) -> GridMap:
    """A map on which another one lies, where that one is known."""
    origin, lower, upper = _make_room(below, above)
    seen, known = upper(above.p_occupied, np.nan), lower(below.p_occupied, np.nan)
    return GridMap(np.where(np.isnan(seen), known, seen), origin, above.resolution)


def extend_map(kept: KeptMap, seen: OccupancyMap) -> OccupancyMap:
    """The known map, where this run saw cells replaced by what it saw. Of a map in 3D, cells stay
    occupied where the known one shows what this run did not see through: it may have looked over
    it.

    Args:
        kept: a map whose axes are those of `seen`.
        seen: the map of this run.
    """
    (origin, lower, upper), known = _make_room(kept.grid, seen), kept.grid.p_occupied
    p = upper(seen.p_occupied, np.nan)
    use = ~np.isnan(p)
    if kept.stands is not None:
        use &= ~(lower(np.where(kept.stands, known, np.nan), np.nan) > p)
    return OccupancyMap(
        np.where(use, p, lower(known, np.nan)),
        origin,
        seen.resolution,
        np.where(use, upper(seen.alpha, 0.0), lower(kept.hits, 0.0)),
        np.where(use, upper(seen.beta, 0.0), np.float32(0.0)),
    )


def write_extended(folder: Path, kept: KeptMap, seen: OccupancyMap, mode: MapMode) -> None:
    """Replace `map.npz`, `map.yaml` and the picture of a result by those of the extended map, and
    in 3D its cloud."""
    extended = extend_map(kept, seen)
    write_map_server(folder, extended, mode)
    write_map_npz(folder / "map.npz", extended)
    if kept.stands is not None:
        write_extended_cloud(folder, kept, seen.resolution)


class KnownMap:
    """A map to localize in.

    Args:
        source: folder of a result or a place, or a map.

    Attributes:
        origin: (3,) m, in the map frame, of the frame that all here is in; zero: that one.
        grid: the map.
        hits: (H, W) sums of hits of its cells.
        resolution: m, edge of a cell.
        surfaces: (N, 2) where the surface runs through each occupied cell, m.

    Raises:
        InputError: it has no map, or an empty one.
    """

    def __init__(self, source: str | os.PathLike[str] | GridMap) -> None:
        self.origin = np.zeros(3)
        if isinstance(source, GridMap):
            self.grid = Grid(source.p_occupied, source.origin, source.resolution)
            self.hits = self.grid.p_occupied
        else:
            near, self.grid = NearResult.open_map(Path(source))
            self.hits = reader.read_hit_sums(near.folder, self.grid.p_occupied.shape)
            self.origin = near.origin
        if not self.grid.occupied.any():
            where = "map" if isinstance(source, GridMap) else str(source)
            raise InputError("has an empty map", where=where)
        self.resolution = self.grid.resolution
        self._centres = self.grid.centres(np.argwhere(self.grid.occupied))
        self.surfaces = _find_surfaces(self.grid, self.hits)

    def make_grid(self) -> _core.OccupancyGrid2D:
        """The map for registration: an end point for every occupied cell, and free space."""
        grid = _core.OccupancyGrid2D(self.resolution, scan_hits.FREE_SPACE_MARGIN)
        ends = self.surfaces.astype(np.float32)
        n, here = len(ends), np.eye(3)[None]
        offset = np.array([0, n])
        _core.add_end_points(grid, ends, np.ones(n, bool), np.ones(n, np.float32), offset, here)
        poses, lengths = _free_runs(self.grid)
        along = np.stack([lengths, np.zeros(len(lengths))], axis=1).astype(np.float32)
        every = np.arange(len(lengths) + 1)
        passed = np.zeros(len(lengths), bool)
        _core.add_beams(grid, along, passed, np.ones(len(lengths), np.float32), every, poses)
        return grid

    def prime(self, labels: OccupancyFilter) -> None:
        """Tell the filters of cells what the map knows."""
        free = self.grid.centres(np.argwhere(self.grid.free))
        centres = np.concatenate([self._centres, free])
        cells = np.floor(centres / labels.resolution).astype(np.int64)
        occupied = np.arange(len(cells)) < len(self._centres)
        labels.prime(np.ascontiguousarray(cells), occupied, LOG_RATIO)


class KnownLocalMap(LocalMap):
    """A known map in place of a local one: nothing leaves it.

    Args:
        known: the map.
        extends: whether scans are added to it.
    """

    def __init__(self, known: KnownMap, extends: bool) -> None:
        super().__init__(known.resolution)
        self.grid, self._extends = known.make_grid(), extends

    def _insert(self, scan: MappedScan) -> None:
        self._last[scan.beams.sensor] = scan
        if self._extends:
            add_scan(self.grid, scan)

    def _relabel(self, scan: MappedScan, label: Labeller) -> None:
        if self._extends:
            relabel_scan(self.grid, scan, label)

    def remove_since(self, stamp_ns: int) -> None:
        """Nothing leaves a known map."""

    def has_sensor(self, _sensor: str | int, /) -> bool:
        """True: a known map holds what every sensor sees."""
        return True


def to_surface_map(grid: GridMap) -> SurfaceMap:
    """Surfaces and free space of an occupancy map, on squares of two cells."""
    from scipy import ndimage  # slow to load

    at = Grid(grid.p_occupied, grid.origin, grid.resolution)
    edge = _SQUARE * grid.resolution
    squares = [
        np.floor(at.centres(np.argwhere(mask)) / edge).astype(np.int64)
        for mask in (at.occupied, at.free)
    ]
    both = np.concatenate(squares)
    low = both.min(axis=0) - 1
    shape = both.max(axis=0) + 2 - low
    flat = [np.ravel_multi_index(tuple((cells - low).T), tuple(shape)) for cells in squares]
    surface, passes = (np.bincount(at, minlength=shape.prod()).reshape(shape) for at in flat)
    passed = (passes >= _SQUARE**2 // 2) & (surface == 0)
    around = np.ones((3, 3), np.bool_)
    near = ndimage.binary_dilation(surface > 0, around)
    free = ndimage.binary_erosion(passed, around) & ~near
    points = (np.argwhere(surface > 0) + low + 0.5) * edge
    return SurfaceMap(points.astype(np.float32), low, near, free, find_sides(passed), edge)


def _find_surfaces(grid: Grid, hits: NDArray[np.floating]) -> Float:
    """(N, 2) where the surface runs through each occupied cell: the mean of the cells around it,
    weighted by their hits. Of a wall between two rows of cells it is nearer to the one hit more."""
    from scipy import ndimage  # slow to load

    weights = np.nan_to_num(hits.astype(np.float64), nan=0.0)
    steps = np.arange(-1.0, 2.0)
    total, across, along = (
        ndimage.correlate(weights, kernel, mode="constant")
        for kernel in (np.ones((3, 3)), np.outer(steps, np.ones(3)), np.outer(np.ones(3), steps))
    )
    rows, columns = at = np.nonzero(grid.occupied)
    shifts = np.stack([across[at], along[at]], axis=1) / np.maximum(total[at], 1e-9)[:, None]
    return grid.centres(np.stack([rows, columns], axis=1) + shifts)


def _free_runs(grid: Grid) -> tuple[Float, Float]:
    """Runs of free cells along the rows: (R, 3, 3) poses of their begins, whose x axis is the row,
    and (R,) m."""
    padded = np.pad(grid.free, [(0, 0), (1, 1)]).astype(np.int8)
    row, first = np.nonzero(np.diff(padded, axis=1) == 1)
    _, last = np.nonzero(np.diff(padded, axis=1) == -1)
    begins = grid.centres(np.stack([row, first], axis=1))
    poses = np.tile(np.eye(3), (len(row), 1, 1))
    c, s = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    poses[:, :2, :2] = [[c, -s], [s, c]]
    poses[:, :2, 2] = begins
    return poses, np.asarray((last - first - 1) * grid.resolution, np.float64)
