"""Cells of a map whose centres lie inside polygons."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]
Window = tuple[slice, slice]  # rows and columns of a map

_BLOCK = 1 << 18  # crossings of edges with rows of cells in memory


def cells_inside(polygon: Sequence[Float], grid: GridMap) -> tuple[Window, Mask]:
    """The cells of a map whose centres lie inside a polygon.

    Args:
        polygon: rings (n, 2) in m in the map frame, closed: the outline, then holes.
        grid: not turned: its yaw is 0.

    Returns:
        The part of the map around the polygon, and whether each of its cells lies inside.
    """
    height, width = grid.p_occupied.shape
    corner = np.array(grid.origin[:2])
    # in cells: the centre of cell (row, column) is (column + 0.5, row + 0.5)
    rings = [(ring - corner) / grid.resolution for ring in polygon]
    low = np.floor(rings[0].min(axis=0)).clip(0, (width, height)).astype(int)
    high = np.ceil(rings[0].max(axis=0)).clip(low, (width, height)).astype(int)
    shape = (int(high[1] - low[1]), int(high[0] - low[0]))
    inside, *holes = (_inside_ring(ring - low, shape) for ring in rings)
    for hole in holes:
        inside &= ~hole
    return (slice(low[1], high[1]), slice(low[0], high[0])), inside


def is_within(polygon: Sequence[Float], grid: GridMap) -> bool:
    """True if no part of a polygon lies outside the map."""
    height, width = grid.p_occupied.shape
    outline = (polygon[0] - np.array(grid.origin[:2])) / grid.resolution
    tolerance = 1e-6  # cells
    return bool(
        (outline >= -tolerance).all() and (outline <= np.array([width, height]) + tolerance).all()
    )


def _inside_ring(ring: Float, shape: tuple[int, int]) -> Mask:
    """Cells (h, w) whose centres lie inside a ring in cells, by the even-odd rule.

    Along a row, each edge that crosses the line through the centres changes inside to outside or
    back from the first centre to the right of it.
    """
    h, w = shape
    changes = np.zeros((h, w + 1), np.uint8)
    for row, x in _row_crossings(ring, h):
        column = np.ceil(x - 0.5).clip(0, w).astype(np.int64)
        np.add.at(changes, (row, column), np.uint8(1))  # modulo 256, which keeps the parity
    np.add.accumulate(changes, axis=1, dtype=np.uint8, out=changes)
    return (changes[:, :w] & 1).astype(bool)


def _row_crossings(ring: Float, h: int) -> Iterator[tuple[NDArray[np.int64], Float]]:
    """Rows (m,) of cells and the x (m,) in cells where edges cross their centre lines."""
    begin, end = ring[:-1], ring[1:]
    # an edge holds its lower end, not its upper one: corners count once
    lowest = np.ceil(np.minimum(begin[:, 1], end[:, 1]) - 0.5).clip(0, h).astype(np.int64)
    beyond = np.ceil(np.maximum(begin[:, 1], end[:, 1]) - 0.5).clip(0, h).astype(np.int64)
    count = beyond - lowest
    edges = np.flatnonzero(count)
    cuts = np.flatnonzero(np.diff(np.cumsum(count[edges]) // _BLOCK)) + 1
    for part in np.split(edges, cuts):
        n = count[part]
        edge = np.repeat(part, n)
        row = lowest[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(n) - n, n)
        (x0, y0), (x1, y1) = begin[edge].T, end[edge].T
        yield row, x0 + (row + 0.5 - y0) * (x1 - x0) / (y1 - y0)
