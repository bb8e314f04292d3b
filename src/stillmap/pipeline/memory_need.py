"""The memory that a map takes at least, known before it is made: of the cells that beams cross; of
those that are hit, where beams are not counted in 3D."""

import math

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.arrays import iter_blocks, sample_indices, squared_lengths
from stillmap.core.chunks import iter_beams
from stillmap.core.memory import allowed_memory, require_memory
from stillmap.core.recording import Recording
from stillmap.em.occupancy_grid import BLOCK_CELLS

Float = NDArray[np.float64]

# by dimension: cells along a side of a block of a grid, and bytes of one: two sums of 8 bytes per
# cell, in 2D also of the same block of a second grid beside it, which was measured on scans with
# beams of kilometres
_EDGE = {2: BLOCK_CELLS, 3: 8}
_PER_BLOCK = {2: 2 * 16 * BLOCK_CELLS**2, 3: 16 * 8**3}
_MAX_SQUARES = {2: 2048, 3: 256}  # along each axis, of the squares or cubes that are counted
# blocks in a square of n x n blocks that a beam crosses are at least n, or half where it cuts off
# a corner
_LEAST_SHARE = 0.5

# bytes in 3D of a block of surfels, and of the surfel and the filters of a cell on which beams
# ended; measured on returns far from each other
_PER_SURFEL_BLOCK, _PER_SURFEL = 700, 700
_MAX_BEAMS = 1 << 22  # of a recording in 3D that are looked at
_KEY_BITS = 21  # of a coordinate: what lies farther apart counts once, as little as it is


def require_map_memory(
    recording: Recording, poses: Float | None, resolution: float, *, counts_beams: bool = False
) -> None:
    """Refuse a recording whose grids do not fit into the memory that may be used.

    Args:
        recording: T scans.
        poses: (T, D+1, D+1) T_map_base; None: those of odometry, or the robot stands still.
        resolution: m, edge of a cell.
        counts_beams: whether beams are counted in all cells that they cross in 3D, too.

    Raises:
        InputError: says how much it takes, and what would take less.
    """
    D = recording.dimension
    if poses is None:
        poses = recording.T_odom_base
    if poses is None:
        poses = np.tile(np.eye(D + 1), (recording.n_scans, 1, 1))
    if D == 2 or counts_beams:
        _require_memory_of_rays(recording, poses, resolution)
    elif min(recording.n_beams, _MAX_BEAMS) * (_PER_SURFEL_BLOCK + _PER_SURFEL) > allowed_memory():
        require_memory(
            _measure_surfels(recording, poses, resolution),
            f"a map with voxels of {resolution:g} m",
            "coarser slam.voxel_size or a shorter read.max_range takes less",
        )


def _measure_surfels(recording: Recording, poses: Float, resolution: float) -> int:
    """Bytes, at least, of the cells in 3D on which beams ended."""
    cells = np.zeros(0, np.int64)
    beams = sample_indices(recording.n_beams, _MAX_BEAMS)
    for some in iter_blocks(beams):
        ended = beams[some][recording.hit[beams[some]]]
        cell = np.floor(recording.end_points(ended, poses) / resolution).astype(np.int64)
        cells = _distinct(np.append(cells, _keys(cell)))
    within_block = _keys(np.full((1, 3), _EDGE[3] - 1))
    blocks = _distinct(cells & ~within_block)
    return len(blocks) * _PER_SURFEL_BLOCK + len(cells) * _PER_SURFEL


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) a number for each of cells (N, 3)."""
    x, y, z = (cells & ((1 << _KEY_BITS) - 1)).T
    return np.asarray((x << 2 * _KEY_BITS) | (y << _KEY_BITS) | z, np.int64)


def _distinct(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different ones, rising; newer NumPy's `np.unique` hashes, which takes far longer."""
    keys.sort()
    return keys[np.append(True, keys[1:] != keys[:-1])] if len(keys) else keys


def _require_memory_of_rays(recording: Recording, poses: Float, resolution: float) -> None:
    """Refuse by the cells that beams cross; arguments as of `require_map_memory`."""
    D, reach = recording.dimension, _reach(recording)
    positions = recording.T_map_sensor(poses)[:, :D, D]
    extent = np.ptp(positions, axis=0) + 2.0 * reach
    block = _EDGE[D] * resolution
    if float((extent / block + 1.0).prod()) * _PER_BLOCK[D] < allowed_memory():
        return  # even if everything was seen
    edge = block * max(1, math.ceil(float(extent.max()) / block / _MAX_SQUARES[D]))
    squares = _count_squares(recording, poses, edge)
    per_square = 1.0 if edge == block else _LEAST_SHARE * edge / block
    option = "slam.resolution" if D == 2 else "slam.voxel_size"
    require_memory(
        squares * per_square * _PER_BLOCK[D],
        f"a map with cells of {resolution:g} m and beams of up to {reach:.4g} m",
        f"a shorter read.max_range or coarser {option} takes less",
    )


def _reach(recording: Recording) -> float:
    """Length of the longest beam, m."""
    longest = 0.0
    for block in iter_blocks(recording.points):
        squared = squared_lengths(recording.points[block])
        longest = float(np.fmax.reduce(squared, initial=longest))
    return math.sqrt(longest)


def _count_squares(recording: Recording, poses: Float, edge: float) -> int:
    """Number of squares, in 3D of cubes, of `edge` m that beams cross."""
    D = recording.dimension
    grid = (_core.OccupancyGrid2D if D == 2 else _core.OccupancyGrid3D)(edge, moments=False)
    for _, _, (points, hit, offset, T) in iter_beams(recording, poses):
        _core.add_beams(grid, points, hit, np.ones(len(hit), np.float32), offset, T)
    count, shape = 0, (_EDGE[D],) * D
    for one in grid.block_cells.tolist():
        _, alpha, beta = grid.dense(one, shape)
        count += int(np.count_nonzero(alpha + beta > 0.0))
    return count
