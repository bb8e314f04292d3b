"""`report.html` of a place: one self-contained page, in the style of that of a single result."""

import functools
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.core.json import package_version
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import MapMode
from stillmap.places.pictures import KIND_COLORS, PlacePictures
from stillmap.places.place_change import Kind
from stillmap.places.report.marks import place_marks
from stillmap.places.timeline import ChangeRecord, SessionRecord, Timeline, format_date_time
from stillmap.places.timeline_reader import read_timeline
from stillmap.results.colors import color_by_id
from stillmap.results.report.facts import files_data
from stillmap.results.report.figures import MapView, data_uri
from stillmap.results.report.maps import written_data
from stillmap.results.report.page import environment, script_data

if TYPE_CHECKING:
    from jinja2 import Environment

_TEMPLATES = Path(__file__).parent / "templates"
_MAX_PATH_POINTS = 1000  # of a session
_THUMBNAIL_PIXELS = 60_000  # 300 x 200, about 5 kB as PNG
_MAX_ROWS = 100  # changes listed and marked between two sessions
_KINDS: tuple[Kind, ...] = get_args(Kind)
# of one change and of several
_WORDS = {
    "appeared": ("appeared", "appeared"),
    "gone": ("gone", "gone"),
    "moved": ("moved", "moved"),
    "door": ("door otherwise", "doors otherwise"),
}
_FILES = {
    "sessions.json": "the sessions, and where each lies in the place",
    "changes.json": "what changed between which sessions",
    "changes.npz": "the cells of every change",
    "states.npz": "changed cells and their states in every session",
}


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
    timeline = read_timeline(folder, str(record["place"]["map_state"]))
    pictures = PlacePictures(occupancy, timeline) if occupancy.p_occupied.size else None
    data = {
        "place": _place_data(timeline, record),
        "maps": _map_data(folder, timeline, occupancy, mode, pictures),
        "sessions": [_session_data(timeline, k) for k in range(len(timeline.sessions))],
        "refused": timeline.refused,
        "thumbnails": _thumbnails_data(occupancy, timeline),
        "steps": [_step_data(timeline, k, pictures) for k in range(1, len(timeline.sessions))],
        "kinds": [(kind, _WORDS[kind][0], KIND_COLORS[kind]) for kind in _KINDS],
        "files": files_data(folder, _FILES),
        "version": package_version(),
        **script_data(),
    }
    return _environment().get_template("place.html.j2").render(data)


@functools.cache
def _environment() -> "Environment":
    """The templates beside, and those of results."""
    from jinja2 import ChoiceLoader, FileSystemLoader

    base = environment()
    loaders = [FileSystemLoader(_TEMPLATES)] + ([base.loader] if base.loader else [])
    return base.overlay(loader=ChoiceLoader(loaders))


def _place_data(timeline: Timeline, record: Mapping[str, Any]) -> dict[str, Any]:
    """Headline figures."""
    first, last = (
        format_date_time(pick(getattr(one, f"{end}_ns") for one in timeline.sessions))
        for pick, end in ((min, "first"), (max, "last"))
    )
    counts = record["counts"]
    return {
        "dimension": timeline.sessions[0].T.shape[0] - 1,
        "first": first,
        "last": last,
        "counts": _count_kinds(timeline.changes),
        "changes": len(timeline.changes),
        "scans": counts["scans"],
        "hits": counts["hits"],
        "dynamic": counts["dynamic"],
        "constraints": record["place"]["constraints"],
        "area": record["area"]["known"],
        "geometry": record["quality"]["geometry"],
        "map_state": timeline.map_state,
    }


def _count_kinds(changes: list[ChangeRecord]) -> list[tuple[str, int]]:
    """Words and number of each kind of which there are changes."""
    counts = Counter(one.kind for one in changes)
    return [(_WORDS[kind][counts[kind] > 1], counts[kind]) for kind in _KINDS if counts[kind]]


def _map_data(
    folder: Path,
    timeline: Timeline,
    occupancy: GridMap,
    mode: MapMode,
    pictures: PlacePictures | None,
) -> dict[str, Any] | None:
    """The map as written with the trajectories; None for a map without cells."""
    if pictures is None:
        return None
    view = pictures.view
    return {
        "view": view,
        "image": data_uri(pictures.draw_map()),
        "meters": tuple(n * occupancy.resolution for n in occupancy.p_occupied.shape[::-1]),
        "cell": occupancy.resolution,
        "written": written_data(occupancy, mode, view),
        "font_size": max(view.size) / 45,
        "paths": [_path_data(folder, one, k, view) for k, one in enumerate(timeline.sessions)],
    }


def _path_data(folder: Path, one: SessionRecord, number: int, view: MapView) -> dict[str, Any]:
    _, poses = read_tum(folder / "sessions" / one.name / "trajectory.tum")
    every = max(1, math.ceil(len(poses) / _MAX_PATH_POINTS))
    points: NDArray[np.float64] = poses[::every, :2, 3]
    return {
        "points": view.svg_points(points),
        "start": view.to_pixels(points[:1])[0].tolist(),
        "color": _session_color(number),
    }


def _session_color(number: int) -> tuple[int, int, int]:
    red, green, blue = color_by_id([number])[0].tolist()
    return red, green, blue


def _session_data(timeline: Timeline, number: int) -> dict[str, Any]:
    one = timeline.sessions[number]
    position = ", ".join(f"{v:.2f}" for v in one.T[:-1, -1])
    return {
        "name": one.name,
        "source": one.source,
        "color": _session_color(number),
        "date": format_date_time(one.first_ns),
        "seconds": 1e-9 * (one.last_ns - one.first_ns),
        "overlap": one.overlap,
        "position": position,
        # + 0.0 turns a negative zero into zero
        "heading": round(math.degrees(math.atan2(one.T[1, 0], one.T[0, 0])), 1) + 0.0,
    }


def _thumbnails_data(occupancy: GridMap, timeline: Timeline) -> list[dict[str, Any]]:
    """A small picture of the map as of every session."""
    if not occupancy.p_occupied.size:
        return []
    pictures = PlacePictures(occupancy, timeline, _THUMBNAIL_PIXELS)
    return [
        {
            "view": pictures.view,
            "image": data_uri(pictures.draw(k)),
            "name": one.name,
            "date": timeline.date(k),
            "counts": _count_kinds(timeline.changes_at(k)),
        }
        for k, one in enumerate(timeline.sessions)
    ]


def _step_data(timeline: Timeline, number: int, pictures: PlacePictures | None) -> dict[str, Any]:
    """The changes from the session before to one, in a table and on the map."""
    before, after = (timeline.sessions[k] for k in (number - 1, number))
    changes = timeline.changes_at(number)
    listed = changes[:_MAX_ROWS]
    data: dict[str, Any] = {
        "number": number,
        "names": (before.name, after.name),
        "dates": (timeline.date(number - 1), timeline.date(number)),
        "counts": _count_kinds(changes),
        "total": len(changes),
        "rows": [_change_row(one, timeline) for one in listed],
        "marks": None,
    }
    if pictures is not None and changes:
        patch = pictures.draw_difference(number)
        data["marks"] = place_marks(listed, pictures.view)
        data["patch"] = (
            None if patch is None else (*patch[:2], *patch.image.size, data_uri(patch.image))
        )
    return data


def _change_row(change: ChangeRecord, timeline: Timeline) -> dict[str, Any]:
    def center(low: NDArray[np.float64], high: NDArray[np.float64]) -> str:
        return ", ".join(f"{v:.2f}" for v in 0.5 * (low + high))

    moved = change.from_low is not None and change.from_high is not None
    return {
        "label": change.label,
        "kind": change.kind,
        "center": center(change.low, change.high),
        "start": center(*change.boxes[1]) if moved else "",
        "size": " x ".join(f"{v:.2f}" for v in change.high - change.low),
        "since": "" if change.before == change.after - 1 else timeline.sessions[change.before].name,
        "probability": change.probability,
    }
