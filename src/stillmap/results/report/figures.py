"""Map images of the report: occupancy, dynamic returns and coverage as palette images."""

import base64
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.grid_map import GridMap
from stillmap.core.tiles import release, tiles_of
from stillmap.pipeline.snapshots import Snapshot, Value, Window, cut_layer, extent
from stillmap.results.colors import ORANGE
from stillmap.results.reader import OCCUPIED_THRESH

Color = tuple[int, int, int]
UNKNOWN, VIOLET = (190, 196, 204), (140, 60, 220)  # RGB
VEIL_ALPHA = 80  # of 255, of thinly observed cells: walls and free space show through
MAX_PIXELS = 1_500_000  # of a map: fills a large screen, a few hundred kB as PNG
_SNAPSHOT_PIXELS = 480  # longest edge of a snapshot
_STRIP = 1 << 16  # cells drawn at once
_MAX_MARGIN = 500  # cells around pictures of long, narrow maps
_DOT_WIDTH = 600  # pixels of image width per pixel of dot size

UNKNOWN_LEVEL, _ORANGE_INDEX = 101, 102


@dataclass(frozen=True)
class MapView:
    """Window and scale shared by the layers of a map figure.

    Attributes:
        window: x0, y0, x1, y1 in m, in the map frame.
        size: width and height of the image in pixels.
        factor: cells along the edge of a pixel.
    """

    window: Window
    size: tuple[int, int]
    factor: int = 1

    @classmethod
    def of(cls, maps: Sequence[GridMap], max_pixels: int = MAX_PIXELS) -> Self:
        """The view of `draw_map` of any of `maps` in the window that contains them all."""
        window, resolution = map_window(maps), maps[0].resolution
        factor = reduction_factor(window, resolution, max_pixels)
        x0, y0, x1, y1 = window
        width, height = (-(-round(d / resolution) // factor) for d in (x1 - x0, y1 - y0))
        return cls(window, (width, height), factor)

    @property
    def is_reduced(self) -> bool:
        """True if several cells share a pixel."""
        return self.factor > 1

    @property
    def scale_bar(self) -> float:
        """Length in m, at most a quarter of the width."""
        return round_down(self.width / 4)

    @property
    def width(self) -> float:
        """Width in m."""
        return self.window[2] - self.window[0]

    @property
    def grid_path(self) -> str:
        """The `d` attribute of the lines at whole multiples of the scale bar's length."""
        step, (x0, y0, x1, y1), (width, height) = self.scale_bar, self.window, self.size
        columns = [k * step for k in range(math.ceil(x0 / step), math.floor(x1 / step) + 1)]
        rows = [k * step for k in range(math.ceil(y0 / step), math.floor(y1 / step) + 1)]
        return "".join(
            [f"M{(x - x0) * width / (x1 - x0):.1f} 0v{height}" for x in columns]
            + [f"M0 {(y1 - y) * height / (y1 - y0):.1f}h{width}" for y in rows]
        )

    def to_pixels(self, points: Float32 | Float) -> Float:
        """Column and row (K, 2) in pixels from the top left of map points (K, 2) in m."""
        x0, y0, x1, y1 = self.window
        width, height = self.size
        column = (points[:, 0] - x0) * (width / (x1 - x0))
        row = (y1 - points[:, 1]) * (height / (y1 - y0))
        return np.stack([column, row], axis=1).astype(np.float64)

    def svg_points(self, points: Float) -> str:
        """The `points` attribute of a polyline through map points (K, 2)."""
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in self.to_pixels(points).tolist())


def round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is at most `value` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max((step * power for step in (1, 2, 5) if step * power <= value), default=power)


def map_window(maps: Sequence[GridMap]) -> Window:
    """The smallest window that contains every occupied cell of `maps`, with a margin.

    Without occupied cells: every known cell; without known cells: the whole first map, of a map
    without cells the place of one.
    """
    for least in (OCCUPIED_THRESH, -1.0):
        boxes = [box for box in (_box(one, least) for one in maps) if box is not None]
        if boxes:
            left, bottom, right, top = zip(*boxes, strict=True)
            return min(left), min(bottom), max(right), max(top)
    x0, y0, x1, y1 = extent(maps[0])
    cell = maps[0].resolution
    return x0, y0, max(x1, x0 + cell), max(y1, y0 + cell)


def draw_map(occupancy: GridMap, window: Window, max_pixels: int = MAX_PIXELS) -> Image.Image:
    """White free, grey unknown, black occupied; larger maps are reduced to `max_pixels`."""
    return color_levels(map_levels(occupancy, window, max_pixels=max_pixels))


def map_levels(
    occupancy: GridMap,
    window: Window,
    free: NDArray[np.integer] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> NDArray[np.uint8]:
    """(h, w) of `reduce_levels`, row 0 with the highest y.

    Args:
        occupancy: the map.
        window: the part that is drawn.
        free: (n, 2) column and row, from the window's lower left, of cells taken for free.
        max_pixels: to which large maps are reduced.
    """
    factor, first = reduction_factor(window, occupancy.resolution, max_pixels), 0
    levels = []
    for cells in iter_strips(occupancy, occupancy.p_occupied, window, np.nan, factor):
        if free is not None:
            cells = cells.copy()
            column, row = free[(free[:, 1] >= first) & (free[:, 1] < first + len(cells))].T
            inside = (column >= 0) & (column < cells.shape[1])
            cells[row[inside] - first, column[inside]] = 0.0
            first += len(cells)
        levels.append(reduce_levels(cells, factor))
    return np.ascontiguousarray(np.concatenate(levels)[::-1])


def draw_thinly_observed(occupancy: GridMap, thin: Bool, window: Window) -> Image.Image:
    """Thinly observed cells (H, W) in violet, as a layer over the `draw_map` of the window."""
    factor, strips = reduction_factor(window, occupancy.resolution), []
    for cells, p in zip(
        iter_strips(occupancy, thin, window, False, factor),
        iter_strips(occupancy, occupancy.p_occupied, window, np.nan, factor),
        strict=True,
    ):
        count, known = (count_in_squares(some, factor) for some in (cells, ~np.isnan(p)))
        strips.append((count > 0) & (2 * count >= known))  # half or more of the known cells
    shown = np.concatenate(strips)[::-1].astype(np.uint8)
    return color_by_index(shown, (UNKNOWN, VIOLET), bytes([0, VEIL_ALPHA]))


def draw_points(points: Float32 | Float, view: MapView) -> Image.Image:
    """Orange dots on a transparent layer over the `draw_map` of a view."""
    pixels = np.zeros(view.size[::-1], np.uint8)
    _put_dots(pixels, view, points, 1, max(1, round(view.size[0] / _DOT_WIDTH)))
    return color_by_index(pixels, (UNKNOWN, ORANGE), 0)


def draw_snapshot(snapshot: Snapshot) -> Image.Image:
    """The snapshot's map with its dynamic returns in orange."""
    longest = max(snapshot.p_occupied.shape)
    levels = reduce_levels(snapshot.p_occupied, max(1, math.ceil(longest / _SNAPSHOT_PIXELS)))[::-1]
    larger = max(1, _SNAPSHOT_PIXELS // max(levels.shape))
    pixels = levels.repeat(larger, axis=0).repeat(larger, axis=1)
    view = MapView(extent(snapshot), (pixels.shape[1], pixels.shape[0]))
    _put_dots(pixels, view, snapshot.dynamic_points, _ORANGE_INDEX, 3)
    return color_levels(pixels)


def data_uri(image: Image.Image, format: str = "png", **options: int) -> str:
    """The image as a `data:` URI; the options are those of Pillow for the format."""
    buffer = io.BytesIO()
    image.save(buffer, format, **options)
    return f"data:image/{format};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def color_by_index(
    pixels: NDArray[np.uint8], colors: Iterable[Color], alpha: bytes | int | None = None
) -> Image.Image:
    """A palette image; `alpha` is the transparent index, or the opacity of each color."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    image.putpalette([value for color in colors for value in color])
    if alpha is not None:
        image.info["transparency"] = alpha
    return image


def _box(occupancy: GridMap, least: float) -> Window | None:
    """The window around the cells with more, with a margin of 4 cells and 1/20 of its length."""
    rows, columns = (np.zeros(n, bool) for n in occupancy.p_occupied.shape)
    for (at_rows, at_columns), p_occupied in tiles_of(occupancy.p_occupied):
        cells = p_occupied > least  # false where it is unknown
        rows[at_rows] |= cells.any(axis=1)
        columns[at_columns] |= cells.any(axis=0)
    if not rows.any():
        return None
    x, y = extent(occupancy)[:2]
    left, right, bottom, top = (
        int(n) for some in (columns, rows) for n in np.flatnonzero(some)[[0, -1]]
    )
    shorter, longer = sorted((right - left, top - bottom))
    margin = 4 + min(longer // 20, _MAX_MARGIN + 5 * shorter)
    low, high = np.array([left, bottom]) - margin, np.array([right, top]) + 1 + margin
    x0, y0 = (occupancy.resolution * low + (x, y)).tolist()
    x1, y1 = (occupancy.resolution * high + (x, y)).tolist()
    return x0, y0, x1, y1


def reduction_factor(window: Window, resolution: float, max_pixels: int = MAX_PIXELS) -> int:
    """Number of cells along each axis that share a pixel."""
    x0, y0, x1, y1 = window
    cells = round((x1 - x0) / resolution) * round((y1 - y0) / resolution)
    return max(1, math.ceil(math.sqrt(cells / max_pixels)))


def iter_strips(
    occupancy: GridMap, layer: NDArray[Value], window: Window, outside: float, factor: int
) -> Iterator[NDArray[Value]]:
    """The cells of a window in strips of whole squares from the bottom: a map may be large."""
    x0, y0, x1, y1 = window
    rows = round((y1 - y0) / occupancy.resolution)
    step = factor * max(1, _STRIP // (factor * max(1, round((x1 - x0) / occupancy.resolution))))
    for first in range(0, rows, step):
        bottom = y0 + first * occupancy.resolution
        top = y0 + min(first + step, rows) * occupancy.resolution
        cells, _ = cut_layer(occupancy, layer, (x0, bottom, x1, top), outside)
        yield np.ascontiguousarray(cells)
        release(layer)


def count_in_squares(cells: Bool, factor: int) -> Int64:
    """(h, w) number of true cells in squares of `factor` x `factor` cells."""
    return np.asarray(reduce_squares(np.add, cells, factor), np.int64)


def reduce_squares(ufunc: np.ufunc, cells: NDArray[Any], factor: int) -> NDArray[Any]:
    """(h, w) values of squares of `factor` x `factor` cells, cut off at the borders."""
    rows, columns = (np.arange(0, n, factor) for n in cells.shape)
    return np.asarray(ufunc.reduceat(ufunc.reduceat(cells, rows, axis=0), columns, axis=1))


def reduce_levels(cells: Float32, factor: int) -> NDArray[np.uint8]:
    """Occupancy in percent of squares of `factor` x `factor` cells, 101 where unknown.

    The maximum where a cell is occupied, so that thin walls stay visible; else the mean of the
    known cells.
    """
    known = count_in_squares(~np.isnan(cells), factor)
    total = reduce_squares(np.add, np.nan_to_num(cells.astype(np.float64)), factor)
    largest = reduce_squares(np.fmax, cells, factor)
    shown = np.where(largest > OCCUPIED_THRESH, largest, total / np.maximum(known, 1))
    percent = np.rint(100.0 * np.clip(shown, 0.0, 1.0))
    return np.where(known > 0, percent, UNKNOWN_LEVEL).astype(np.uint8)


def color_levels(levels: NDArray[np.uint8], *colors: Color) -> Image.Image:
    """Shades of levels; `colors` follow those of `_ORANGE_INDEX`."""
    # gamma 0.6 makes the few percent visible that a walker leaves in the raw map
    shades = [round(255 * (1 - (percent / 100) ** 0.6)) for percent in range(101)]
    return color_by_index(levels, (*((shade,) * 3 for shade in shades), UNKNOWN, ORANGE, *colors))


def _put_dots(
    pixels: NDArray[np.uint8], view: MapView, points: NDArray[Any], value: int, size: int
) -> None:
    """Squares of `size` pixels around map points (K, 2) in m."""
    height, width = pixels.shape
    offset = np.arange(size) - size // 2
    j, i = np.floor(view.to_pixels(points)).astype(np.int64).T[:, :, None] + offset
    x, y = np.broadcast_arrays(j[:, None, :], i[:, :, None])
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    pixels[y[inside], x[inside]] = value
