"""Clearance grid of free space, and shortest paths through it."""

import copy
from functools import cached_property
from typing import Any

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Int32, Int64
from stillmap.core.errors import InputError

SPACING = 0.1  # m between nodes of the clearance grid
_STRIDE = 2  # the planner uses every second node
_MARGIN = 0.5  # m around the walls
_MAX_CLEARANCE = 1.5  # m
_MAX_SHORTCUT = 80  # nodes
_NEAR_WALL_COST = 0.6  # additional cost of a metre along a wall


def compute_segment_distance(points: Float, segment: Float) -> Float:
    """(...) distances in metres of points (..., 2) from a segment (4,)."""
    start, along = segment[:2], segment[2:] - segment[:2]
    delta = points - start
    s = np.clip(delta @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    rest = delta - s[..., None] * along
    return np.asarray(np.hypot(rest[..., 0], rest[..., 1]))


class FreeSpace:
    """Distance from the nearest wall on a grid of nodes, up to 1.5 m.

    Args:
        walls: (W, 4) segments x0, y0, x1, y1 in metres.
    """

    def __init__(self, walls: Float) -> None:
        ends = walls.reshape(-1, 2)
        self.origin = ends.min(axis=0) - _MARGIN
        size = np.ceil((ends.max(axis=0) + _MARGIN - self.origin) / SPACING).astype(int) + 1
        self.clearance: Float = np.full((size[1], size[0]), _MAX_CLEARANCE)
        self._add_walls(walls)

    def with_walls(self, walls: Float) -> "FreeSpace":
        """The free space between these walls (W, 4), within the same bounds, and its own."""
        more = copy.copy(self)
        more.clearance = self.clearance.copy()
        more._add_walls(walls)
        return more

    def _add_walls(self, walls: Float) -> None:
        for wall in walls:
            ends = wall.reshape(2, 2)
            low = (ends.min(axis=0) - _MAX_CLEARANCE - self.origin) / SPACING
            high = (ends.max(axis=0) + _MAX_CLEARANCE - self.origin) / SPACING
            (x0, y0), (x1, y1) = np.maximum(low, 0).astype(int), high.astype(int) + 2
            window = self.clearance[y0:y1, x0:x1]
            rows, columns = np.indices(window.shape)
            nodes = self.origin + np.stack([columns + x0, rows + y0], axis=-1) * SPACING
            np.minimum(window, compute_segment_distance(nodes, wall), out=window)

    def clearance_at(self, xy: Float) -> tuple[Float, Float]:
        """Clearance (N,) in metres at points (N, 2), bilinear, and its gradient (N, 2)."""
        H, W = self.clearance.shape
        at = (xy - self.origin) / SPACING
        cell = np.clip(at.astype(np.int64), 0, (W - 2, H - 2))
        u, v = (at - cell).T
        column, row = cell.T
        c00, c10 = self.clearance[row, column], self.clearance[row, column + 1]
        c01, c11 = self.clearance[row + 1, column], self.clearance[row + 1, column + 1]
        low, high = c00 + u * (c10 - c00), c01 + u * (c11 - c01)
        dx = (1 - v) * (c10 - c00) + v * (c11 - c01)
        return low + v * (high - low), np.stack([dx, high - low], axis=-1) / SPACING


class Planner:
    """Shortest paths that keep a clearance, within the connected parts of free space of `inside`.

    Args:
        space: the clearance grid.
        inside: (2,) a point of the part, metres, or (K, 2) points of several unconnected parts.
        clearance: m, minimum distance from walls.

    Attributes:
        nodes: of all parts.
        parts: number of parts.

    Raises:
        InputError: there is no room at `inside`.
    """

    def __init__(self, space: FreeSpace, inside: Float, clearance: float) -> None:
        self._space = space
        self._clear = space.clearance >= clearance
        coarse = self._clear[::_STRIDE, ::_STRIDE]
        parts, _ = scipy.ndimage.label(coarse, structure=np.ones((3, 3)))
        self._shape = coarse.shape
        labels = [self._label_at(parts, xy, clearance) for xy in np.atleast_2d(inside)]
        rank = np.full(int(parts.max()) + 1, -1)
        rank[labels] = np.arange(len(labels))
        self._part = rank[parts].ravel()
        self.parts = len(labels)
        self._least = clearance
        self.nodes = np.flatnonzero(self._part >= 0)
        self._trees: dict[int, Int32] = {}

    # built on demand: slow in a large world

    @cached_property
    def _graph(self) -> "scipy.sparse.csr_array":
        part = (self._part >= 0).reshape(self._shape)
        return _graph(part, self._space.clearance[::_STRIDE, ::_STRIDE], self._least)

    @cached_property
    def _nearest(self) -> NDArray[Any]:
        outside = (self._part < 0).reshape(self._shape)
        _, nearest = scipy.ndimage.distance_transform_edt(outside, return_indices=True)
        return np.asarray(nearest[0] * self._shape[1] + nearest[1])

    def _label_at(self, parts: NDArray[Any], xy: Float, clearance: float) -> int:
        part = int(parts.flat[self._grid_node(xy)])
        if not part:
            what = f"no room for a robot or a person at ({xy[0]:g}, {xy[1]:g})"
            hint = f"points of a route lie at least {clearance:g} m from any wall"
            raise InputError(what, hint=hint)
        return part

    def part_of(self, node: int | Int64) -> Int64:
        """Part of the nodes, numbered as the points `inside`."""
        return np.asarray(self._part[node])

    def point(self, node: Int64) -> Float:
        """(..., 2) points in metres of the nodes (...)."""
        grid = np.stack([node % self._shape[1], node // self._shape[1]], axis=-1)
        return np.asarray(self._space.origin + grid * (SPACING * _STRIDE))

    def _grid_node(self, xy: Float) -> int:
        at = np.round((xy - self._space.origin) / (SPACING * _STRIDE)).astype(int)
        column, row = np.clip(at, 0, (self._shape[1] - 1, self._shape[0] - 1))
        return int(row) * int(self._shape[1]) + int(column)

    def contains(self, xy: Float) -> bool:
        """True if the node next to a point (2,) is reachable."""
        return bool(self._part[self._grid_node(xy)] >= 0)

    def node(self, xy: Float) -> int:
        """The reachable node nearest to a point (2,)."""
        here = self._grid_node(xy)
        return here if self._part[here] >= 0 else int(self._nearest.flat[here])

    def path(self, start: Float, goal: int) -> Float:
        """(K, 2) corners of a short path from a point (2,) to a node, without the start."""
        if goal not in self._trees:
            end = int(np.searchsorted(self.nodes, goal))
            _, previous = scipy.sparse.csgraph.dijkstra(
                self._graph, directed=False, indices=[end], return_predecessors=True
            )
            self._trees[goal] = previous[0]
        tree = self._trees[goal]
        chain = [int(np.searchsorted(self.nodes, self.node(start)))]
        while tree[chain[-1]] >= 0:
            chain.append(int(tree[chain[-1]]))
        return self._shorten(start, self.point(self.nodes[chain]))

    def is_visible(self, start: Float, ends: Float) -> Bool:
        """(K,) whether straight lines from a point (2,) to points (K, 2) keep the clearance."""
        delta = ends - start
        steps = int(np.ceil(np.abs(delta).max(initial=0.0) / SPACING)) + 1
        along = start + delta[:, None, :] * np.linspace(0.0, 1.0, steps + 1)[1:, None]
        cell = np.round((along - self._space.origin) / SPACING).astype(np.int64)
        H, W = self._clear.shape
        cell = np.clip(cell, 0, (W - 1, H - 1))
        return np.asarray(np.all(self._clear[cell[..., 1], cell[..., 0]], axis=1))

    def _shorten(self, start: Float, points: Float) -> Float:
        corners, at, here = [], 0, start
        while at < len(points) - 1:
            ahead = points[at + 1 : at + 1 + _MAX_SHORTCUT]
            seen = np.flatnonzero(self.is_visible(here, ahead))
            at += 1 + (int(seen[-1]) if len(seen) else 0)
            here = points[at]
            corners.append(here)
        return np.array(corners or [points[-1]])


def _graph(part: Bool, clearance: Float, least: float) -> "scipy.sparse.csr_array":
    """8-neighbour graph of the nodes of `part`; edges along walls cost more.

    Nodes are numbered in the order of `part`, without those outside.
    """
    H, W = part.shape
    index = np.cumsum(part).reshape(H, W) - 1
    slow = 1.0 + _NEAR_WALL_COST * np.exp(-(clearance - least) / 0.3)
    rows, columns, costs = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = (slice(0, H - dy), slice(max(0, -dx), W - max(0, dx)))
        there = (slice(dy, H), slice(max(0, dx), W - max(0, -dx)))
        both = part[here] & part[there]
        rows.append(index[here][both])
        columns.append(index[there][both])
        length = SPACING * _STRIDE * np.hypot(dx, dy)
        costs.append(length * (slow[here][both] + slow[there][both]) / 2)
    data = (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.csr_array(data, shape=(np.count_nonzero(part),) * 2)
