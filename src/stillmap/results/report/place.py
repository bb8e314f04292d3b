"""`report.html` of a place of several sessions: pictures of its map, and the data of its page."""

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Float
from stillmap.core.grid_map import GridMap
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import MapMode
from stillmap.pipeline.snapshots import Window, extent
from stillmap.results.colors import KIND_COLORS, color_by_id
from stillmap.results.report import figures
from stillmap.results.report.figures import MapView, data_uri
from stillmap.results.report.maps import written_map_data
from stillmap.results.report.page import files_data
from stillmap.results.report.template import render_page
from stillmap.results.timeline import (
    Kind,
    PlaceSession,
    SessionChange,
    Timeline,
    format_date_time,
    read_timeline,
)

_MAX_PATH_POINTS = 1000  # of a session
_THUMBNAIL_PIXELS = 60_000  # 300 x 200, about 5 kB as PNG
_MAX_ROWS = 100  # changes listed and marked between two sessions
_KINDS: tuple[Kind, ...] = get_args(Kind)
# of one change and of several
_WORDS = {
    "appeared": ("appeared", "appeared"),
    "gone": ("gone", "gone"),
    "moved": ("moved", "moved"),
    "door": ("door swung", "doors swung"),
}
_FILES = {
    "sessions.json": "the sessions, and where each lies in the place",
    "changes.json": "what changed between which sessions",
    "changes.npz": "the cells of every change",
    "states.npz": "changed cells and their states in every session",
}
_FONT_SHARE, _PAD_SHARE = 1 / 45, 1 / 160  # of the longer edge of the view
_LABEL_SHARE = 0.06  # of the width, which a label takes at most
_OCCUPIED_LEVEL = 100
_CAME, _LEFT, _CLEAR = (figures.UNKNOWN_LEVEL + k for k in (2, 3, 4))
_MARGIN = 8  # cells around changed cells that a picture shows at least


def render_place_report(
    folder: Path, occupancy: GridMap, mode: MapMode, record: Mapping[str, Any]
) -> str:
    """The page, of a few megabytes at most: no outside request, images and script inline.

    Args:
        folder: of the place, with all its other files but `run.json`.
        occupancy: its map.
        mode: how the map file is written.
        record: the content of `run.json`.

    Raises:
        InputError: a file of the place is damaged.
    """
    timeline = read_timeline(folder)
    numbers = range(len(timeline.sessions))
    pictures = small = maps = None
    if occupancy.p_occupied.size:
        pictures = PlacePictures(occupancy, timeline)
        small = PlacePictures(occupancy, timeline, _THUMBNAIL_PIXELS)
        view, sessions = pictures.view, enumerate(timeline.sessions)
        maps = {
            **written_map_data(occupancy, mode, view),
            "base": data_uri(pictures.draw_map()),
            "font_size": max(view.size) * _FONT_SHARE,
            "paths": [_path_data(folder, one, k, view) for k, one in sessions],
        }
    data = {
        "title": f"{len(timeline.sessions)} sessions of a place",
        "place": record,
        "timeline": timeline,
        "maps": maps,
        "thumbnails": [small and (small.view, data_uri(small.draw(k))) for k in numbers],
        "steps": [_step_data(timeline, k, pictures) for k in numbers[1:]],
        "max_rows": _MAX_ROWS,
        "kinds": [(kind, _WORDS[kind][0], KIND_COLORS[kind]) for kind in _KINDS],
        "files": files_data(folder, _FILES),
        # functions of the templates
        "count_kinds": _count_kinds,
        "date_time": format_date_time,
        "color_of": _session_color,
        "heading": _heading,
    }
    return render_page(data)


def _count_kinds(changes: list[SessionChange]) -> list[tuple[str, int]]:
    """Words and number of each kind of which there are changes."""
    counts = Counter(one.kind for one in changes)
    return [(_WORDS[kind][counts[kind] > 1], counts[kind]) for kind in _KINDS if counts[kind]]


def _session_color(number: int) -> tuple[int, ...]:
    return tuple(color_by_id([number])[0].tolist())


def _heading(T: Float) -> float:
    """In degrees; + 0.0 turns a negative zero into zero."""
    return round(math.degrees(math.atan2(T[1, 0], T[0, 0])), 1) + 0.0


def _path_data(folder: Path, one: PlaceSession, number: int, view: MapView) -> dict[str, Any]:
    _, poses = read_tum(folder / "sessions" / one.name / "trajectory.tum")
    every = max(1, math.ceil(len(poses) / _MAX_PATH_POINTS))
    points: Float = poses[::every, :2, 3]
    return {
        "points": view.svg_points(points),
        "start": view.to_pixels(points[:1])[0].tolist(),
        "color": _session_color(number),
    }


def _step_data(timeline: Timeline, number: int, pictures: "PlacePictures | None") -> dict[str, Any]:
    """The changes from the session before to one on the map, and how that differs from the map as
    it was written."""
    changes = timeline.changes_at(number)[:_MAX_ROWS]
    if pictures is None or not changes:
        return {"marks": None, "patch": None}
    marks = [place_mark(one, pictures.view) for one in changes]
    patch = pictures.draw_difference(number)
    return {"marks": marks, "patch": patch and (*patch[:2], *patch[2].size, data_uri(patch[2]))}


def place_mark(change: SessionChange, view: MapView) -> dict[str, Any]:
    """A change on the map: its boxes as left, top, width and height in pixels, that where it is or
    was first, and where its label begins, or ends where that is nearer to the border."""
    pad, boxes = max(view.size) * _PAD_SHARE, []
    for low, high in change.boxes:
        (left, bottom), (right, top) = view.to_pixels(np.stack([low[:2], high[:2]])).tolist()
        boxes.append((left - pad, top - pad, right - left + 2 * pad, bottom - top + 2 * pad))
    left, top, width, _ = boxes[0]
    is_before = left + width > (1.0 - _LABEL_SHARE) * view.size[0]
    x = left - pad if is_before else left + width + pad
    return {
        "kind": change.kind,
        "label": change.label,
        "boxes": boxes,
        "centers": [(x + 0.5 * w, y + 0.5 * h) for x, y, w, h in boxes],
        "text": (x, top + max(view.size) * _FONT_SHARE, is_before),
    }


class PlacePictures:
    """Draws the map of a place as of its sessions.

    Attributes:
        view: window and size of the pictures.
    """

    def __init__(
        self, occupancy: GridMap, timeline: Timeline, max_pixels: int = figures.MAX_PIXELS
    ):
        """Draw the map as it was written.

        Args:
            occupancy: the map of the place, with at least one cell.
            timeline: of the place.
            max_pixels: of a picture.
        """
        cells, self._timeline = timeline.cells, timeline
        window = _window_of(occupancy, timeline)
        factor = figures.reduction_factor(window, occupancy.resolution, max_pixels)
        at = np.floor((cells.centers - np.array(window[:2])) / occupancy.resolution)
        local = at.astype(np.int64)
        self._levels = figures.map_levels(occupancy, window, max_pixels=max_pixels)
        self._cleared = figures.map_levels(occupancy, window, local, max_pixels)
        height, width = self._levels.shape
        self.view = MapView(window, (width, height), factor)
        row, column = height - 1 - local[:, 1] // factor, local[:, 0] // factor
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        self._drawn = np.flatnonzero(inside)
        self._row, self._column = row[inside], column[inside]

    def draw_map(self) -> Image.Image:
        """The map as it was written."""
        return figures.color_levels(self._levels)

    def draw(self, session: int) -> Image.Image:
        """The map as of a session, in color what came and left since the one before."""
        colors = KIND_COLORS["appeared"], KIND_COLORS["gone"]
        return figures.color_levels(self._levels_as_of(session), *colors)

    def draw_difference(self, session: int) -> tuple[int, int, Image.Image] | None:
        """The difference of `draw` of a session from `draw_map`, transparent elsewhere, after
        column and row of its upper left pixel."""
        levels = self._levels_as_of(session)
        differs = levels != self._levels
        if not differs.any():
            return None
        rows, columns = (np.flatnonzero(differs.any(axis=axis)) for axis in (1, 0))
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        pixels = np.where(differs, levels, np.uint8(_CLEAR))[part]
        image = figures.color_levels(
            pixels, KIND_COLORS["appeared"], KIND_COLORS["gone"], (0, 0, 0)
        )
        image.info["transparency"] = _CLEAR
        return int(columns[0]), int(rows[0]), image

    def _levels_as_of(self, session: int) -> NDArray[np.uint8]:
        now, came, left = (one[self._drawn] for one in self._timeline.cells_as_of(session))
        out, at = self._levels.copy(), (self._row, self._column)
        redrawn = np.zeros(out.shape, np.bool_)
        differs = now != self._timeline.cells.shown[self._drawn]
        redrawn[self._row[differs], self._column[differs]] = True
        out[redrawn] = self._cleared[redrawn]
        for cells, level in (
            (now & redrawn[at], _OCCUPIED_LEVEL),
            (left, _LEFT),
            (came, _CAME),
        ):
            out[self._row[cells], self._column[cells]] = level
        return out


def _window_of(occupancy: GridMap, timeline: Timeline) -> Window:
    """The window of the map, widened by changed cells at its border."""
    x0, y0, x1, y1 = figures.map_window([occupancy])
    cells, whole = timeline.cells, extent(occupancy)
    if not len(cells.cells):
        return x0, y0, x1, y1
    low = (cells.cells.min(axis=0) - _MARGIN) * cells.resolution
    high = (cells.cells.max(axis=0) + 1 + _MARGIN) * cells.resolution
    left, bottom = np.minimum([x0, y0], np.maximum(low, whole[:2])).tolist()
    right, top = np.maximum([x1, y1], np.minimum(high, whole[2:])).tolist()
    return left, bottom, right, top
