"""After the last session: states, changes, labels, map, and all files of the place."""

import datetime
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stillmap.core.arrays import iter_blocks
from stillmap.core.config import to_dict
from stillmap.core.errors import InputError
from stillmap.core.files import write_text
from stillmap.core.json import package_version, write_json
from stillmap.em import OccupancyMap
from stillmap.pipeline.options import Options
from stillmap.places.changes import detect_place_changes
from stillmap.places.checksums import write_checksums
from stillmap.places.clouds import write_place_clouds
from stillmap.places.grow import estimate_planar
from stillmap.places.objects import write_objects
from stillmap.places.place import Place, Refusal
from stillmap.places.place_map import make_place_map
from stillmap.places.place_states import estimate_place
from stillmap.places.quality import rate_place
from stillmap.places.report.page import render_place_report
from stillmap.places.shown_state import show_state
from stillmap.places.writer import PlaceResult, write_place_files, write_sessions
from stillmap.results.labels import read_array
from stillmap.results.map_npz import write_map_npz
from stillmap.results.map_server import write_map_server
from stillmap.results.run_json import FORMAT_VERSION, LOCAL_ORIGIN, RECORD, quality_record

LAST, MAJORITY = "last", "majority"
_STATES_HINT = "map_state=last, majority, the name of a session, or a date such as 2026-05-31"
_DAY_NS = 86_400 * 10**9


def finish_place(
    place: Place, refusals: list[Refusal], order: list[str], map_state: str
) -> PlaceResult:
    """States, changes and the shown state of a place.

    Args:
        place: its sessions, with evidence.
        refusals: sessions that are not in it.
        order: names of all inputs.
        map_state: see `MergeJob`.

    Raises:
        InputError: the state is none that the place can show.
    """
    limit = _find_limit(place, map_state)
    planar_states = estimate_planar(place)
    planar_states, planar_changes = detect_place_changes(planar_states)
    planar = show_state(planar_states, planar_changes, limit)
    if place.dimension == 2:
        return PlaceResult(place, refusals, order, planar_changes, planar, planar)
    states = estimate_place([place.sessions[k].require_evidence()[0] for k in place.in_time()])
    states, changes = detect_place_changes(states)
    return PlaceResult(place, refusals, order, changes, show_state(states, changes, limit), planar)


def require_map_state(map_state: str, names: Sequence[str]) -> None:
    """Refuse what is no state of a map that shows sessions of these names.

    Raises:
        InputError: it is none.
    """
    if map_state not in (LAST, MAJORITY, *names):
        _parse_date(map_state)


def _find_limit(place: Place, map_state: str) -> int | None:
    """Index of the session, in the order of time, as of which the map is shown; None: majority."""
    in_time = [place.sessions[k].session for k in place.in_time()]
    if map_state == LAST:
        return len(in_time) - 1
    if map_state == MAJORITY:
        return None
    names = [one.name for one in in_time]
    if map_state in names:
        return names.index(map_state)
    until = _parse_date(map_state)
    before = [k for k, one in enumerate(in_time) if int(one.stamp_ns[0]) <= until]
    if not before:
        raise InputError(f"no session is as old as the state that the map shall show: {map_state}")
    return before[-1]


def _parse_date(text: str) -> int:
    """Nanoseconds since 1970 of a date, its end if it has no time; UTC unless it says otherwise.

    Raises:
        InputError: it is none.
    """
    try:
        date = datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(f"is no state of a map: {text}", hint=_STATES_HINT) from error
    if date.tzinfo is None:
        date = date.replace(tzinfo=datetime.UTC)
    nanoseconds = round(date.timestamp() * 1e6) * 1000
    return nanoseconds + (_DAY_NS - 1 if len(text) == len("2026-05-31") else 0)


def write_place(folder: Path, result: PlaceResult, options: Options, map_state: str) -> None:
    """Write all files of a place into its new folder.

    Args:
        folder: with `sessions/` and what each session keeps.
        result: see PlaceResult.
        options: of mapping, and of the map.
        map_state: see `MergeJob`.
    """
    place = result.place
    write_sessions(folder, result)
    for one in place.sessions:
        write_checksums(folder / "sessions" / one.session.name)
    write_place_files(folder, result)
    write_objects(folder, place)
    if place.dimension == 3:
        write_place_clouds(folder, result)
    planar = [place.sessions[k].require_evidence()[1] for k in place.in_time()]
    occupancy = make_place_map(planar, result.planar)
    record = place_record(folder, result, options, map_state, occupancy)
    occupancy = replace(occupancy, origin=place.local_frame.corner_to_map(occupancy.origin))
    write_map_server(folder, occupancy, options.output.map_mode)
    write_map_npz(folder / "map.npz", occupancy)
    page = render_place_report(folder, occupancy, options.output.map_mode, record)
    write_text(folder / "report.html", page)
    write_json(folder / RECORD, record)


def place_record(
    folder: Path,
    result: PlaceResult,
    options: Options,
    map_state: str,
    occupancy: OccupancyMap,
) -> dict[str, Any]:
    """The content of `run.json` of a place; `occupancy` is its map in its local frame."""
    place = result.place
    origin = place.local_frame.origin
    known = int(np.count_nonzero(~np.isnan(np.asarray(occupancy.p_occupied))))
    return {
        "format_version": FORMAT_VERSION,
        "version": package_version(),
        "input": {
            "format": "stillmap place",
            "path": None,
            "sessions": [one.session.name for one in place.sessions],
        },
        "dimension": place.dimension,
        **({LOCAL_ORIGIN: origin.tolist()} if origin.any() else {}),
        "options": to_dict(options),
        "iterations": [],
        "counts": _count(folder),
        "area": {"known": round(known * place.resolution**2, 6)},
        "warnings": [f"{one.name} is not in the place: {one.why}" for one in result.refusals],
        "quality": quality_record(rate_place(place, occupancy)),
        "place": {
            "resolution": place.resolution,
            "voxel_size": place.voxel_size,
            "map_state": map_state,
            "frame": place.frame or place.sessions[0].session.name,
            "sessions": len(place.sessions),
            "constraints": len(place.ties),
            "changes": len(result.changes),
        },
    }


def _count(folder: Path) -> dict[str, int]:
    """Scans, beams and hits of a place, and how many of the hits are dynamic."""
    stamps = read_array(folder / "beams" / "stamp_ns.npy", (None,), "i")
    hit = read_array(folder / "beams" / "hit.npy", (None,), "b")
    p_static = read_array(folder / "beams" / "p_static.npy", (len(hit),), "f")
    hits = dynamic = unusable = 0
    for block in iter_blocks(hit, p_static):
        hits += int(np.count_nonzero(hit[block]))
        dynamic += int(np.count_nonzero(hit[block] & (p_static[block] < 0.5)))
        unusable += int(np.count_nonzero(np.isnan(p_static[block])))
    return {
        "scans": len(stamps),
        "beams": len(hit),
        "hits": hits,
        "max_range": len(hit) - hits - unusable,
        "unusable": unusable,
        "dynamic": dynamic,
    }
