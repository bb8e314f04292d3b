"""Pictures of a result: matplotlib axes, and the summary that notebooks show by themselves."""

import html
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

from stillmap.core.array_types import Float
from stillmap.core.errors import import_extra
from stillmap.mapping.labelled_recording import sample_points
from stillmap.results.colors import KIND_COLORS
from stillmap.results.mapped_place import MappedPlace
from stillmap.results.report.figures import MapView, data_uri, draw_map, map_window
from stillmap.results.timeline import SessionChange

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BLUE, _ORANGE = "#1f6feb", "#f07800"
_MAX_POINTS = 50_000  # dynamic returns in a figure
_PREVIEW_PIXELS = 420  # longest edge in a notebook


def plot_result(
    result: MappedPlace,
    ax: "Axes | None",
    *,
    trajectory: bool,
    moving: Iterable[MappedPlace],
    changes: bool,
) -> "Axes":
    """See `Result.plot`; dynamic returns are those of the sessions `moving`."""
    if ax is None:
        pyplot = import_extra("matplotlib.pyplot", "a plot", "drawn", group="notebook")
        ax = pyplot.subplots(layout="constrained")[1]
    view = MapView.of([result.map])
    image, (x0, y0, x1, y1) = draw_map(result.map, view.window), view.window
    # pixels are whole squares of cells: the last ones may reach beyond the window
    width, height = (n * view.factor * result.map.resolution for n in image.size)
    extent = (x0, x0 + width, y0, y0 + height)
    ax.imshow(np.asarray(image.convert("RGB")), extent=extent, interpolation="nearest")
    placed = [one for one in result.sessions if one.accepted]
    for session in moving:
        points = sample_points(session.deskewed, session.poses, session.p_static, limit=_MAX_POINTS)
        x, y = points[:, :2].T
        ax.plot(x, y, ".", color=_ORANGE, markersize=1.5, label="dynamic returns")
    for one in placed if trajectory else []:
        x, y = _track(result)[one.scans].T
        color = _BLUE if len(placed) == 1 else None
        label = "trajectory" if len(placed) == 1 else one.name
        ax.plot(x, y, color=color, linewidth=1.0, label=label)
    if changes and result.changes:
        _draw_changes(result.changes, ax)
    ax.set_aspect("equal")
    ax.set_xlim(x0, x1)
    ax.set_ylim(y0, y1)
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    return ax


def _draw_changes(changes: list[SessionChange], ax: "Axes") -> None:
    """Draw a box around what changed, and an arrow from where it stood before."""
    patches = import_extra("matplotlib.patches", "a plot", "drawn", group="notebook")
    for one in changes:
        color = tuple(level / 255.0 for level in KIND_COLORS[one.kind])
        (low, high), *earlier = one.boxes
        width, height = (high - low)[:2].tolist()
        style = {"fill": False, "edgecolor": color, "linewidth": 1.2}
        ax.add_patch(patches.Rectangle(tuple(low[:2]), width, height, **style))
        for box in earlier:
            before, after = np.mean(box, axis=0)[:2], 0.5 * (low + high)[:2]
            arrow = {"arrowstyle": "->", "color": color}
            ax.annotate("", tuple(after), tuple(before), arrowprops=arrow)


def summarize_as_html(result: MappedPlace) -> str:
    """A small picture of the map and what it is of; needs neither matplotlib nor a network."""
    lines = [repr(result), *result.warnings]
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    picture = data_uri(_draw_preview(result))
    return f"<img alt='map with trajectory' src='{picture}'><ul>{items}</ul>"


def _draw_preview(result: MappedPlace) -> Image.Image:
    """The map with the trajectory, small."""
    window = map_window([result.map])
    image = draw_map(result.map, window).convert("RGB")
    factor = _PREVIEW_PIXELS / max(image.size)
    width, height = (max(1, round(n * factor)) for n in image.size)
    how = Image.Resampling.BOX if factor < 1.0 else Image.Resampling.NEAREST
    image = image.resize((width, height), how)
    pixels = MapView(window, (width, height)).to_pixels(_track(result))
    for scans in result.stretches:
        way = [(x, y) for x, y in pixels[scans].tolist()]
        ImageDraw.Draw(image).line(way, fill=_BLUE, width=2)
    return image.quantize(64)


def _track(result: MappedPlace) -> Float:
    """(T, 2) positions of the robot in metres."""
    return result.poses[:, :2, -1]
