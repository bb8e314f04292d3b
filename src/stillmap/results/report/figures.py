"""The report's pictures: maps as PNG, the likelihood as SVG, all inline.

The likelihood over the iterations (Fig. 5) as inline SVG, in the page's own colours.
"""

import base64
import io
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.em import OccupancyMap
from stillmap.pipeline.estimate import IterationRecord
from stillmap.pipeline.snapshots import Snapshot, Window, cut, cut_layer, extent
from stillmap.results.map_server import OCCUPIED_THRESH

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ORANGE = (240, 120, 0)

UNKNOWN = (190, 196, 204)

VIOLET = (140, 60, 220)

VEIL = 80  # of 255: walls and free space show through

# enough for a large screen, and two maps of it stay within a few megabytes
PIXEL_BUDGET = 1_500_000

_SNAPSHOT_PIXELS = 480

_SHOWN_WIDTH = 600

_UNKNOWN_INDEX, _ORANGE_INDEX = 101, 102


def map_window(maps: Sequence[OccupancyMap]) -> Window:
    """The smallest window that holds every occupied cell of `maps`, with a margin.

    Free space may reach far beyond, where beams met nothing. Without an occupied cell the window
    holds every known one, and the whole map where none is known.
    """
    for chosen in (_occupied, _known):
        boxes = [box for box in (_box(one, chosen(one)) for one in maps) if box is not None]
        if boxes:
            corners = np.array(boxes)
            x0, y0 = corners[:, :2].min(axis=0).tolist()
            x1, y1 = corners[:, 2:].max(axis=0).tolist()
            return x0, y0, x1, y1
    return extent(maps[0])


def draw_map(occupancy: OccupancyMap, window: Window) -> Image.Image:
    """White free, grey unknown, black occupied; large maps are reduced to the pixel budget."""
    cells, _ = cut(occupancy, window)
    factor = _reduction(window, occupancy.resolution)
    return _with_palette(_levels(cells, factor)[::-1])


def draw_poorly_observed(
    occupancy: OccupancyMap, thin: NDArray[np.bool_], window: Window
) -> Image.Image:
    """A veil over the thin (H, W) cells, to lie over the `map_image` of that window."""
    factor = _reduction(window, occupancy.resolution)
    known, _ = cut_layer(occupancy, _known(occupancy), window, False)
    veiled, _ = cut_layer(occupancy, thin, window, False)
    count = _sums(veiled, factor)
    half = (count > 0) & (2 * count >= _sums(known, factor))
    image = Image.fromarray(np.ascontiguousarray(half[::-1].astype(np.uint8)))
    image.putpalette([*UNKNOWN, *VIOLET])
    image.info["transparency"] = bytes([0, VEIL])
    return image


def draw_points(points: NDArray[np.float32], window: Window, size: tuple[int, int]) -> Image.Image:
    """Orange dots on nothing, to lie over a `map_image` of `size` (width, height) pixels."""
    width, height = size
    pixels = np.zeros((height, width), np.uint8)
    column, row = map_to_pixels(points, window, size).T
    _put_dots(pixels, column, row, 1, max(1, round(width / _SHOWN_WIDTH)))
    image = Image.fromarray(pixels)
    image.putpalette([*UNKNOWN, *ORANGE])
    image.info["transparency"] = 0
    return image


def draw_snapshot(snapshot: Snapshot) -> Image.Image:
    """The snapshot's part of the map with its dynamic end points in orange."""
    longest = max(snapshot.p_occupied.shape)
    levels = _levels(snapshot.p_occupied, max(1, math.ceil(longest / _SNAPSHOT_PIXELS)))[::-1]
    larger = max(1, _SNAPSHOT_PIXELS // max(levels.shape))
    pixels = levels.repeat(larger, axis=0).repeat(larger, axis=1)
    h, w = snapshot.p_occupied.shape
    x, y, _ = snapshot.origin
    window = (x, y, x + w * snapshot.resolution, y + h * snapshot.resolution)
    column, row = map_to_pixels(snapshot.dynamic_points, window, pixels.shape[::-1]).T
    _put_dots(pixels, column, row, _ORANGE_INDEX, 3)
    return _with_palette(pixels)


def map_to_pixels(
    points: NDArray[np.float32] | NDArray[np.float64], window: Window, size: tuple[int, ...]
) -> NDArray[np.float64]:
    """(K, 2) column and row, as fractions of pixels from the top left, of (K, 2) map points."""
    x0, y0, x1, y1 = window
    width, height = size
    column = (points[:, 0] - x0) * (width / (x1 - x0))
    row = (y1 - points[:, 1]) * (height / (y1 - y0))
    return np.stack([column, row], axis=1).astype(np.float64)


def png_uri(image: Image.Image) -> str:
    """The picture as a `data:` address."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _occupied(occupancy: OccupancyMap) -> NDArray[np.bool_]:
    return occupancy.p_occupied > OCCUPIED_THRESH


def _known(occupancy: OccupancyMap) -> NDArray[np.bool_]:
    return ~np.isnan(occupancy.p_occupied)


def _box(occupancy: OccupancyMap, cells: NDArray[np.bool_]) -> Window | None:
    """The window around the chosen cells, a margin of a twentieth included."""
    rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    if not len(rows):
        return None
    x, y, _, _ = extent(occupancy)
    left, right, bottom, top = (int(n) for n in (*columns[[0, -1]], *rows[[0, -1]]))
    margin = 4 + max(right - left, top - bottom) // 20
    return (
        x + (left - margin) * occupancy.resolution,
        y + (bottom - margin) * occupancy.resolution,
        x + (right + 1 + margin) * occupancy.resolution,
        y + (top + 1 + margin) * occupancy.resolution,
    )


def _reduction(window: Window, resolution: float) -> int:
    """How many cells along each axis share a pixel."""
    x0, y0, x1, y1 = window
    cells = round((x1 - x0) / resolution) * round((y1 - y0) / resolution)
    return max(1, math.ceil(math.sqrt(cells / PIXEL_BUDGET)))


def _sums(cells: NDArray[np.bool_], factor: int) -> NDArray[np.int64]:
    """How many cells are true in squares of `factor` cells."""
    height, width = cells.shape
    rows = np.add.reduceat(cells, np.arange(0, height, factor), axis=0, dtype=np.int64)
    return np.asarray(np.add.reduceat(rows, np.arange(0, width, factor), axis=1))


def _levels(cells: NDArray[np.float32], factor: int) -> NDArray[np.uint8]:
    """Percent occupied of squares of `factor` cells, 101 where unknown.

    A square with an occupied cell shows that cell, or thin walls would vanish from large maps;
    any other shows the mean of what is known.
    """
    height, width = (-(-n // factor) for n in cells.shape)
    levels = np.empty((height, width), np.uint8)
    # by strips: the intermediate arrays of a whole large map would be many times its size
    strip = max(1, (1 << 20) // (width * factor * factor))
    for top in range(0, height, strip):
        part = cells[top * factor : (top + strip) * factor]
        rows = -(-len(part) // factor)
        padded = np.full((rows * factor, width * factor), np.nan, np.float32)
        padded[: len(part), : part.shape[1]] = part
        squares = padded.reshape(rows, factor, width, factor)
        known = ~np.isnan(squares)
        count = known.sum(axis=(1, 3))
        mean = np.where(known, squares, 0).sum(axis=(1, 3)) / np.maximum(count, 1)
        most = np.where(known, squares, 0).max(axis=(1, 3))
        p = np.where(most > OCCUPIED_THRESH, most, mean)
        levels[top : top + strip] = np.where(count, np.rint(100 * p), _UNKNOWN_INDEX)
    return levels


def _with_palette(levels: NDArray[np.uint8]) -> Image.Image:
    # a walker leaves a few percent in the raw map's cells: they are drawn darker, to be seen
    shades = [round(255 * (1 - (percent / 100) ** 0.6)) for percent in range(101)]
    greys = [grey for shade in shades for grey in (shade, shade, shade)]
    image = Image.fromarray(np.ascontiguousarray(levels))
    image.putpalette([*greys, *UNKNOWN, *ORANGE])
    return image


def _put_dots(
    pixels: NDArray[np.uint8],
    column: NDArray[np.float64],
    row: NDArray[np.float64],
    value: int,
    size: int,
) -> None:
    height, width = pixels.shape
    i, j = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    for di in range(size):
        for dj in range(size):
            y, x = i + di - size // 2, j + dj - size // 2
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            pixels[y[inside], x[inside]] = value


# stand-ins that become the page's colours, so that the curve follows its light or dark theme
_INK, _FAINT, _LINE, _MARK = "#010203", "#010204", "#010205", "#010206"

_PAGE_COLOURS = {
    _INK: "var(--ink)",
    _FAINT: "var(--rule)",
    _LINE: "var(--accent)",
    _MARK: "var(--orange)",
}


def likelihood_svg(
    iterations: Sequence[IterationRecord], best: int, titles: tuple[str, str]
) -> str:
    """`<svg>` with the expected log likelihood and the bound, the best iteration marked."""
    # matplotlib is slow to load and needed nowhere else
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    numbers = np.array([it.number for it in iterations], float)
    curves = ([it.expected_log_likelihood for it in iterations], [it.bound for it in iterations])
    # a fixed salt makes the element ids, and so the file, repeatable
    style: dict[Any, Any] = {"svg.hashsalt": "stillmap", "svg.fonttype": "none", "font.size": 9.0}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(9.0, 2.9), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots(1, 2)
        for axis, title, values in zip(axes, titles, curves, strict=True):
            _draw(axis, title, numbers, np.array(values, float), best)
        buffer = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", metadata=nothing)
    return _inline(buffer.getvalue())


def _draw(
    axis: "Axes",
    title: str,
    numbers: np.ndarray,
    values: np.ndarray,
    best: int,
) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.set_title(title, color=_INK, fontsize=9.5, loc="left")
    axis.plot(numbers, values, color=_LINE, linewidth=1.6, marker="o", markersize=3.5)
    chosen = numbers == best
    axis.plot(
        numbers[chosen],
        values[chosen],
        linestyle="none",
        marker="o",
        markersize=9,
        markerfacecolor="none",
        markeredgecolor=_MARK,
        markeredgewidth=2,
    )
    axis.set_xlabel("iteration", color=_INK)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axis.ticklabel_format(axis="y", useOffset=False, useMathText=True, scilimits=(-4, 7))
    axis.yaxis.get_offset_text().set_color(_INK)
    axis.tick_params(colors=_INK, which="both")
    axis.grid(color=_FAINT, linewidth=0.7)
    axis.patch.set_visible(False)
    for name, spine in axis.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(_FAINT)


def _inline(document: str) -> str:
    """The `<svg>` element alone, without fixed size, foreign addresses or colours of its own."""
    svg = document[document.index("<svg") :]
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg, count=2)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r"<g id=\"patch_1\">.*?</g>", "", svg, count=1, flags=re.DOTALL)
    for stand_in, colour in _PAGE_COLOURS.items():
        svg = svg.replace(stand_in, colour)
    return svg.replace("<svg", '<svg aria-hidden="true" class="curve"', 1).strip()
