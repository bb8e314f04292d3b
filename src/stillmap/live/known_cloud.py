"""A map in 3D from an earlier run, for localization: what stands, and where it was mapped from."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.arrays import unique_cells
from stillmap.core.errors import InputError
from stillmap.core.square_box import cell_keys
from stillmap.em import CellProbabilities, GroundMap
from stillmap.em.ground import fit_ground
from stillmap.live.known_map import LOG_RATIO, KeptMap, KnownMap
from stillmap.live.sweep_view import STANDS, count_up, is_level
from stillmap.places.evidence import look_up
from stillmap.results.near_result import NearResult
from stillmap.slam import lidar_odometry

_STATIC = 0.5  # P(static) of the points that are added: over hours others would fill the cells

# m from the origin of the local frame: squares and cubes of all cells are numbered in 64 bits
_MAX_EXTENT = 5e4
_SPACING = 0.1  # m between the points that are kept: where sweeps are dense, all would be one ring
# m by which the route is raised for the ground: the robot's base may lie in it
_RAISE = 1.0
_ROUTE_SPACING = 0.5  # m between the poses that are kept of a route
_NEIGHBOUR_WEIGHT = 0.5  # of what was seen of a voxel, for each of those around it
_GROUND_CELL = 0.3  # m, of the level surface that shows the ground


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

    def add(self, points: Float32, weights: Float32, T_map_base: Float) -> None:
        """Add points (N, 3) in the base frame with weights P(static), if the map is extended."""
        if self._extends:
            static = weights >= _STATIC
            self.planes.add(points[static], weights[static], T_map_base)
            cube = np.floor(T_map_base[:3, 3] / _ROUTE_SPACING).astype(np.int64)
            self._route.setdefault(tuple(cube.tolist()), T_map_base)

    @property
    def route(self) -> Float:
        """(K, 4, 4) T_map_base from where it was extended."""
        return np.array(list(self._route.values())).reshape(-1, 4, 4)


class KnownCloud:
    """A map in 3D to localize in.

    Args:
        source: folder of a result or a place of a lidar.
        planar: its planar map.

    Attributes:
        planar: the planar map, in whose frame all is.
        poses: (T, 4, 4) T_map_base from where it was mapped.
        ground: its height.
        points: (N, 3) float32 where surface runs, m, in random order.
        p_static: (N,) float32.

    Raises:
        InputError: it is of a planar laser, or damaged.
    """

    def __init__(self, source: str | os.PathLike[str], planar: KnownMap) -> None:
        folder = Path(source)
        if not (folder / "static.ply").exists():
            hint = "sweeps are localized in the result of a spinning lidar"
            raise InputError("holds no static.ply", where=str(source), hint=hint)
        self.planar, near = planar, NearResult(folder, planar.origin)
        self.poses = near.read_route()
        points, p_static = _read_points(near)
        # cells of planes take in so many points only, which must not all lie on one side
        order = np.random.default_rng(0).permutation(len(points))
        self.points, self.p_static = points[order], p_static[order]
        self.ground = self._find_ground()

    def make_local_map(self) -> _core.NdtMap3D:
        """The map that sweeps are registered to."""
        local = lidar_odometry.make_local_map()
        local.add(self.points, self.p_static, np.eye(4))
        return local

    def find_voxels(self, edge: float, band: tuple[float, float]) -> tuple[Int64, Bool]:
        """(K, 3) voxels with which the labels are initialized, and (K,) whether surface runs there;
        else they are free.

        Args:
            edge: m.
            band: m above the ground in which columns that are free in the planar map are free.
        """
        surface = _cells_of(self.points, edge)
        cells = np.concatenate([surface, self._free_voxels(edge, band)])
        return np.ascontiguousarray(cells), np.arange(len(cells)) < len(surface)

    def keep(
        self, now: CellProbabilities | None, p_unseen: float, edge: float, band: tuple[float, float]
    ) -> KeptMap:
        """The points that are still occupied.

        Args:
            now: P(static and occupied) of the voxels of `find_voxels`, and of others; None: all
                that is known still stands.
            p_unseen: of a voxel with surface, before this run saw it.
            edge: m, of a voxel.
            band: as of `find_voxels`.
        """
        stands, planar = np.ones(len(self.points), np.bool_), self.planar
        if now is not None:
            stands = _find_standing(self.points, now, p_unseen, edge)
        grid, hits = planar.grid, np.array(planar.hits)
        z = self.points[:, 2] - self.ground.height_at(self.points[:, :2].astype(np.float64))
        is_obstacle = (z >= band[0]) & (z <= band[1])
        there, gone = (
            self._columns(self.points[is_obstacle & which]) for which in (stands, ~stands)
        )
        gone &= ~there & grid.occupied
        there &= grid.occupied
        remaining = replace(grid, p_occupied=np.where(gone, np.float32(0.0), grid.p_occupied))
        hits[gone] = 0.0
        points, p_static = self.points[stands].astype(np.float64), self.p_static[stands]
        return KeptMap(remaining, hits, there, points, p_static, thin_route(self.poses))

    def _columns(self, points: Float32) -> Bool:
        """(H, W) cells of the planar map in which points (N, 3) lie."""
        out = np.zeros(self.planar.grid.p_occupied.shape, np.bool_)
        at = self.planar.grid.cells(points[:, :2].astype(np.float64))
        row, column = at[((at >= 0) & (at < out.shape)).all(axis=1)].T
        out[row, column] = True
        return out

    def _free_voxels(self, edge: float, band: tuple[float, float]) -> Int64:
        """(K, 3) voxels that lie in the band of columns which are free."""
        grid = self.planar.grid
        columns = _cells_of(grid.centres(np.argwhere(grid.free)), edge)
        height = self.ground.height_at(np.asarray((columns + 0.5) * edge, np.float64))
        first = np.ceil((height + band[0]) / edge).astype(np.int64)
        last = np.floor((height + band[1]) / edge).astype(np.int64)
        of, up = count_up(np.maximum(last - first, 0))
        return np.column_stack([columns[of], first[of] + up])

    def _find_ground(self) -> GroundMap:
        points = np.column_stack([self.points, np.ones(len(self.points))])
        cells, sums = _sum_up(np.floor(self.points / _GROUND_CELL).astype(np.int64), points)
        floor = (sums[:, :3] / sums[:, 3:])[is_level(cells)]
        return fit_ground(floor, self.poses[:, :3, 3] + [0.0, 0.0, _RAISE])


def thin_route(poses: Float) -> Float:
    """(K, 4, 4) of poses (T, 4, 4), the first in each cube of `_ROUTE_SPACING`."""
    cubes = np.floor(poses[:, :3, 3] / _ROUTE_SPACING).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return poses[np.sort(first)]


def _find_standing(points: Float32, now: CellProbabilities, p_unseen: float, edge: float) -> Bool:
    """(N,) which points (N, 3) lie in voxels that are still occupied."""
    cells, of = unique_cells(np.floor(points / edge).astype(np.int64))
    p_occupied = look_up(now.cells, now.p_occupied, cells, 1.0)  # 1: nothing is known of it
    shared = _share_evidence(cells, p_occupied, p_unseen).astype(np.float32)
    return np.asarray(shared[of] >= STANDS)


def _share_evidence(cells: Int64, p_occupied: Float, p_unseen: float) -> Float:
    """(N,) probabilities of voxels (N, 3) in lexicographic order after what this run saw of those
    around them, too: voxels of one thing leave together, and rings of a sweep miss many of them."""
    from scipy.special import expit, logit  # slow to load

    before, now = (logit(np.clip(p, 1e-6, 1.0 - 1e-6)) for p in (p_unseen, p_occupied))
    evidence = np.clip(now - before, -LOG_RATIO, LOG_RATIO)
    around = _sum_around(cells, evidence) - evidence
    return np.asarray(expit(now + _NEIGHBOUR_WEIGHT * around))


def _sum_around(cells: Int64, values: Float) -> Float:
    """(N,) sums of the values (N,) of cells (N, 3) in lexicographic order over the 3 x 3 x 3 cells
    around each."""
    keys, sums = cell_keys(cells), np.append(0.0, np.cumsum(values))
    out = np.zeros(len(cells))
    for x, y in np.ndindex(3, 3):
        first, last = (cell_keys(cells + np.array([x - 1, y - 1, z])) for z in (-1, 1))
        out += sums[np.searchsorted(keys, last, "right")] - sums[np.searchsorted(keys, first)]
    return out


def _read_points(near: NearResult) -> tuple[Float32, Float32]:
    """(N, 3) the mean of the points in every voxel, and (N,) their mean P(static)."""
    parts = [(np.zeros((0, 3), np.int64), np.zeros((0, 5)))]
    for block in near.iter_points():
        points = block.points
        if not (np.abs(points) < _MAX_EXTENT).all():
            what = f"holds a point more than {_MAX_EXTENT / 1e3:g} km from its planar map"
            raise InputError(what, where=str(near.folder / "static.ply"))
        more = np.column_stack([points, block.p_static, np.ones(len(points))])
        cells = np.floor(points / _SPACING).astype(np.int64)
        parts.append(_sum_up(cells, more))
    keys, sums = _sum_up(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    if not len(keys):
        raise InputError("has an empty map", where=str(near.folder / "static.ply"))
    means = (sums[:, :4] / sums[:, 4:]).astype(np.float32)
    return np.ascontiguousarray(means[:, :3]), np.ascontiguousarray(means[:, 3])


def _sum_up(keys: Int64, values: Float) -> tuple[Int64, Float]:
    """Cells (N, D), each once, and the sums of their values (N, K)."""
    cells, of = unique_cells(keys)
    sums = [np.bincount(of, column, len(cells)) for column in values.T]
    return cells, np.stack(sums, axis=1)


def _cells_of(points: NDArray[np.floating], edge: float) -> Int64:
    """(K, D) the cells of points (N, D), each once."""
    return unique_cells(np.floor(points / edge).astype(np.int64))[0]
