"""The memory that a map takes at least, known before it is made: that of the cells seen in 2D."""

import math

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.arrays import iter_blocks
from stillmap.core.chunks import iter_beams
from stillmap.core.memory import allowed_memory, require_memory
from stillmap.core.recording import Recording
from stillmap.em.occupancy_grid import BLOCK_CELLS

Float = NDArray[np.float64]

# bytes of a block of a grid: two sums of 8 bytes per cell, and of the same block of a second grid
# beside it; measured on scans with beams of kilometres
_PER_BLOCK = 2 * 16 * BLOCK_CELLS**2
_MAX_SQUARES = 2048  # along either axis, of the squares in which seen area is counted
# blocks in a square of n x n blocks that a beam crosses are at least n, or half where it cuts off
# a corner
_LEAST_SHARE = 0.5


def require_map_memory(recording: Recording, poses: Float | None, resolution: float) -> None:
    """Refuse a planar recording whose grids do not fit into the memory that may be used.

    Args:
        recording: 2D; nothing is known of 3D ones, whose grids hold what beams ended on.
        poses: (T, 3, 3) T_map_base; None: those of odometry, or the robot stands still.
        resolution: m, edge of a cell.

    Raises:
        InputError: says how much it takes, and what would take less.
    """
    if recording.dimension != 2:
        return
    if poses is None:
        poses = recording.T_odom_base
    if poses is None:
        poses = np.tile(np.eye(3), (recording.n_scans, 1, 1))
    reach = _reach(recording)
    xy = recording.T_map_sensor(poses)[:, :2, 2]
    extent = np.ptp(xy, axis=0) + 2.0 * reach
    block = BLOCK_CELLS * resolution
    if float((extent / block + 1.0).prod()) * _PER_BLOCK < allowed_memory():
        return  # even if everything was seen
    edge = block * max(1, math.ceil(float(extent.max()) / block / _MAX_SQUARES))
    squares = _count_squares(recording, poses, edge)
    per_square = 1.0 if edge == block else _LEAST_SHARE * edge / block
    require_memory(
        squares * per_square * _PER_BLOCK,
        f"a map with cells of {resolution:g} m and beams of up to {reach:.4g} m",
        "a shorter read.max_range or coarser slam.resolution takes less",
    )


def _reach(recording: Recording) -> float:
    """Length of the longest beam, m."""
    longest = 0.0
    for block in iter_blocks(recording.points):
        squared = np.square(recording.points[block], dtype=np.float64).sum(axis=1)
        longest = float(np.fmax.reduce(squared, initial=longest))
    return math.sqrt(longest)


def _count_squares(recording: Recording, poses: Float, edge: float) -> int:
    """Number of squares of `edge` m that beams cross."""
    grid = _core.OccupancyGrid2D(edge, moments=False)
    for _, _, (points, hit, offset, T) in iter_beams(recording, poses):
        _core.add_beams(grid, points, hit, np.ones(len(hit), np.float32), offset, T)
    count = 0
    for one in grid.block_cells.tolist():
        _, alpha, beta = grid.dense(one, (BLOCK_CELLS, BLOCK_CELLS))
        count += int(np.count_nonzero(alpha + beta > 0.0))
    return count
