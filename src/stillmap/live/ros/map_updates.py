"""The map as it is published: whole, and between two whole ones its changed part."""

import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.live.causal_labels import MapChange
from stillmap.live.ros.conversions import fill_grid, fill_header, to_cells
from stillmap.live.ros.installation import Ros
from stillmap.pipeline.options import MapMode

_GRID, _UPDATE = "nav_msgs/msg/OccupancyGrid", "map_msgs/msg/OccupancyGridUpdate"
_DEPTH = 10  # updates kept for readers that fall behind
_PERIOD_NS = 10**9  # between two updates


class MapUpdate(NamedTuple):
    """A rectangle of a map.

    Attributes:
        column, row: of its lowest cell in the map.
        cells: (H, W) int8, rows from the lowest y on.
    """

    column: int
    row: int
    cells: NDArray[np.int8]


class MapMirror:
    """A copy of the map as it was published, with all updates.

    Args:
        mode: how it is written.
    """

    def __init__(self, mode: MapMode) -> None:
        self._mode = mode
        self._first = np.zeros(2, np.int64)  # column and row of its lowest cell
        self._cells = np.zeros((0, 0), np.int8)

    def set_whole(self, grid: GridMap) -> None:
        """Take over the whole map."""
        self._first = np.rint(np.array(grid.origin[:2]) / grid.resolution).astype(np.int64)
        self._cells = to_cells(grid.p_occupied, self._mode)

    def take(self, changes: Sequence[MapChange]) -> MapUpdate | None:
        """Take over changed parts; the rectangle around them, or None: they are not all inside."""
        low = np.array([change.first_cell for change in changes]) - self._first
        high = low + np.array([change.p_occupied.shape[::-1] for change in changes])
        width, height = self._cells.shape[1], self._cells.shape[0]
        if (low < 0).any() or (high > [width, height]).any():
            return None
        for (column, row), change in zip(low.tolist(), changes, strict=True):
            cells = to_cells(change.p_occupied, self._mode)
            n_rows, n_columns = cells.shape
            self._cells[row : row + n_rows, column : column + n_columns] = cells
        (column, row), (right, top) = low.min(axis=0).tolist(), high.max(axis=0).tolist()
        return MapUpdate(column, row, self._cells[row:top, column:right])


def fill_update(message: Any, frame: str, stamp: int, update: MapUpdate) -> None:
    """Set an OccupancyGridUpdate."""
    fill_header(message.header, frame, stamp)
    message.x, message.y = update.column, update.row
    message.height, message.width = update.cells.shape
    message.data = array.array("b", update.cells.tobytes())


class MapPublisher:
    """Publishes the map, and what changes in it where map_msgs is there.

    Args:
        ros: the user's installation.
        node: of rclpy.
        topic: of the map; updates are on TOPIC_updates, as RViz and nav2 expect.
        frame: of the map.
        mode: how it is written.
    """

    def __init__(self, ros: Ros, node: Any, topic: str, frame: str, mode: MapMode) -> None:
        self._ros, self._frame, self._mode = ros, frame, mode
        qos = ros.module("qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._map = ros.create_publisher(node, _GRID, topic, latched)
        self._updates = ros.create_publisher(node, _UPDATE, f"{topic}_updates", _DEPTH)
        self._mirror = MapMirror(mode)
        self._waiting = dict[tuple[int, ...], MapChange]()
        self._published_ns = -_PERIOD_NS

    def publish(self, grid: GridMap, stamp: int) -> None:
        """The whole map; who comes later gets the last one."""
        message = self._ros.message(_GRID)()
        fill_grid(message, self._frame, stamp, grid, self._mode)
        self._map.publish(message)
        self._waiting.clear()
        if self._updates is not None:
            self._mirror.set_whole(grid)

    def publish_changes(self, changes: Sequence[MapChange], stamp: int) -> bool:
        """Publish the tiles that changed, once a second; False: the map has become larger, and a
        whole one is due."""
        if self._updates is None:
            return True
        for change in changes:
            if change.p_occupied.ndim == 2:
                self._waiting[tuple(change.first_cell.tolist())] = change
        if not self._waiting or 0 <= stamp - self._published_ns < _PERIOD_NS:
            return True
        update = self._mirror.take(list(self._waiting.values()))
        self._waiting.clear()
        self._published_ns = stamp
        is_heard = self._updates.get_subscription_count() > 0
        if update is not None and is_heard:
            message = self._ros.message(_UPDATE)()
            fill_update(message, self._frame, stamp, update)
            self._updates.publish(message)
        return update is not None or not is_heard
