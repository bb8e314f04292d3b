"""After the last session: states, changes, labels, map, and all files of the place."""

import datetime
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, files, input_files
from stillmap.core.array_folder import FORMAT_VERSION, write_arrays
from stillmap.core.array_types import Float, Float32
from stillmap.core.errors import InputError
from stillmap.core.json import write_json
from stillmap.core.local_frame import Fields, Shift, shift, shift_poses
from stillmap.core.short_repr import ShortRepr
from stillmap.em import OccupancyMap
from stillmap.io.trajectory import MAX_BYTES, write_tum
from stillmap.mapping.labelled_recording import count_beams
from stillmap.pipeline.map_frame import FIELDS
from stillmap.pipeline.options import Options
from stillmap.pipeline.quality import rate_geometry
from stillmap.places import objects, place_map, store
from stillmap.places.changes import PlaceChange, detect_place_changes
from stillmap.places.keyframes import join_keyframes
from stillmap.places.place import Place, PlacedSession, fit_alignment, join_constraints
from stillmap.places.place_states import PlaceStates, estimate_place
from stillmap.results import map_server, point_cloud, pose_graph_g2o, run_json
from stillmap.results.reader import LOCAL_ORIGIN, RECORD, SESSIONS, read_labels
from stillmap.results.report.place import render_place_report
from stillmap.results.timeline import CHANGES, STATES, PlaceSession
from stillmap.slam import PoseGraph

# of `sessions.json`, what is known of a session that is not in the place
_REFUSAL = ("name", "input", "accepted", "why")
LAST, MAJORITY = "last", "majority"
_STATES_HINT = "map_state=last, majority, the name of a session, or a date such as 2026-05-31"
_DAY_NS = 86_400 * 10**9
# fields that depend on the frame
_FIELDS: Fields = {PlaceChange: dict.fromkeys(("low", "high", "from_low", "from_high"), "points")}


@dataclass(frozen=True, eq=False)
class PlaceResult(ShortRepr):
    """A merged place, ready to be written.

    Attributes:
        place: its sessions.
        refusals: sessions that are not in it.
        order: names of all inputs, accepted or not, as they were given.
        changes: between sessions, in the order of time.
        shown: state of the cells in D dimensions.
        planar: state of the cells in the plane; in 2D the same.
    """

    place: Place
    refusals: list[PlaceSession]
    order: list[str]
    changes: list[PlaceChange]
    shown: place_map.ShownState
    planar: place_map.ShownState


def finish_place(
    place: Place, refusals: list[PlaceSession], order: list[str], map_state: str
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
    limit, in_time = _find_limit(place, map_state), place.in_time()

    def show(k: int) -> tuple[list[PlaceChange], place_map.ShownState]:
        states = estimate_place([placed.require_evidence()[k] for placed in in_time])
        states, changes = detect_place_changes(states)
        return changes, place_map.show_state(states, changes, limit)

    changes, planar = show(1)
    changes, shown = show(0) if place.dimension == 3 else (changes, planar)
    return PlaceResult(place, refusals, order, changes, shown, planar)


def require_map_state(map_state: str, names: Sequence[str]) -> None:
    """Refuse what is no state of a map that shows sessions of these names.

    Raises:
        InputError: it is none.
    """
    if map_state not in (LAST, MAJORITY, *names):
        _parse_date(map_state)


def _find_limit(place: Place, map_state: str) -> int | None:
    """Index of the session, in the order of time, as of which the map is shown; None: majority."""
    in_time = [placed.session for placed in place.in_time()]
    names = [session.name for session in in_time]
    if map_state == MAJORITY:
        return None
    if map_state in names and map_state != LAST:
        return names.index(map_state)
    until = in_time[-1].stamp_ns[0] if map_state == LAST else _parse_date(map_state)
    before = sum(int(session.stamp_ns[0]) <= until for session in in_time)
    if not before:
        raise InputError(f"no session is as old as the state that the map shall show: {map_state}")
    return before - 1


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
    place, by = result.place, _to_map_frame(result.place)
    for time, placed in enumerate(place.in_time()):
        _write_session(folder, result, placed, time)
    _write_place_files(folder, result)
    transforms = {placed.session.name: _between_maps(placed, by) for placed in place.sessions}
    objects.write_objects(folder, transforms)
    joined = join_keyframes([placed.session.keyframes for placed in place.sessions]).recording
    poses = np.concatenate([placed.keyframe_poses for placed in place.sessions])
    if place.dimension == 3:
        parts = [_label_keyframes(placed, result.shown) for placed in place.sessions]
        labels = np.concatenate(parts)
        moved = shift_poses(poses, by.metres)
        point_cloud.write_clouds(folder, joined, moved, labels, origin=by.metres)
    planar = [placed.require_evidence()[1] for placed in place.in_time()]
    occupancy = place_map.make_place_map(planar, result.planar)
    record = place_record(folder, result, options, map_state, occupancy)
    # labels are not rated: keyframes are too far apart for that
    record["quality"] = run_json.quality_record(rate_geometry(joined, poses, occupancy))
    occupancy = shift(occupancy, by, FIELDS)
    map_server.write_map_server(folder, occupancy, options.output.map_mode)
    map_server.write_map_npz(folder / "map.npz", occupancy)
    page = render_place_report(folder, occupancy, options.output.map_mode, record)
    files.write_text(folder / "report.html", page)
    write_json(folder / RECORD, record)


def place_record(
    folder: Path, result: PlaceResult, options: Options, map_state: str, occupancy: OccupancyMap
) -> dict[str, Any]:
    """The content of `run.json` of a place; `occupancy` is its map in its local frame."""
    place, labels = result.place, read_labels(folder)
    origin = place.home.origin
    return {
        "format_version": FORMAT_VERSION,
        "version": files.package_version(),
        "input": {
            "format": "stillmap place",
            "path": None,
            "sessions": [placed.session.name for placed in place.sessions],
        },
        "dimension": place.dimension,
        **({LOCAL_ORIGIN: origin.tolist()} if origin.any() else {}),
        "options": asdict(options),
        "iterations": [],
        "counts": {"scans": len(labels.stamp_ns), **count_beams(labels.hit, labels.p_static)},
        "area": {"known": run_json.known_area(occupancy)},
        "warnings": [
            f"{refusal.name} is not in the place: {refusal.why}" for refusal in result.refusals
        ],
        "quality": {},
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


def _write_session(folder: Path, result: PlaceResult, placed: PlacedSession, time: int) -> None:
    """Write what differs from merge to merge into `sessions/NAME/`; `time` is its index there."""
    place, home = result.place, folder / "sessions" / placed.session.name
    poses = shift_poses(placed.poses, place.home.origin)
    write_tum(home / "trajectory.tum", placed.session.stamp_ns, poses)
    beams = store.read_beam_cells(home, placed.session, place.voxel_size)
    centres = beams.place_centres(placed.session.node_poses, placed.nodes)
    p_static = place_map.label_session(result.shown, beams, centres, time)
    arrays.write_npy(home / "beams" / "p_static.npy", p_static)
    write_arrays(home / store.STATE, {"nodes": placed.nodes, "measured_at": placed.measured_at})


def _to_map_frame(place: Place) -> Shift:
    """From the frame of the place to the map frame of the result of the session that has it."""
    return Shift.of(place.home.origin, place.resolution)


def _between_maps(placed: PlacedSession, by: Shift, T: Float | None = None) -> Float:
    """(D+1, D+1) of a session, from the map frame of its result to that of the place.

    Args:
        placed: the session.
        by: as of `_to_map_frame`.
        T: T_place_session, in the frames that it was placed in; None: fitted to all nodes.
    """
    if T is None:
        T = fit_alignment(placed.session.node_poses, placed.nodes)
    if placed.session.origin.any():
        T = T @ shift_poses(np.eye(len(T)), -placed.session.origin)
    return shift_poses(T, by.metres)


def _label_keyframes(placed: PlacedSession, shown: place_map.ShownState) -> Float32:
    """(M,) P(static) of the beams of a session's keyframes, as the map shows the place."""
    keyframes = placed.session.keyframes
    beams = np.flatnonzero(keyframes.recording.hit)
    ends = keyframes.recording.end_points(beams, placed.keyframe_poses)
    # look_up gives 0 where nothing ever stood clearly: those beams keep their own label
    p_gone = shown.place.look_up(ends, 1.0 - shown.p_shown)
    labels = np.array(keyframes.e)
    labels[beams] *= (1.0 - p_gone).astype(np.float32)
    return labels


def _write_place_files(folder: Path, result: PlaceResult) -> None:
    """Write the files of the place as a whole, but the map, the report and `run.json`."""
    place, by = result.place, _to_map_frame(result.place)
    names = [placed.session.name for placed in place.in_time()]
    homes = [folder / "sessions" / placed.session.name for placed in place.sessions]
    poses = shift_poses(np.concatenate([placed.poses for placed in place.sessions]), by.metres)
    with (folder / "trajectory.tum").open("wb") as file:
        for home in homes:
            file.write(input_files.read_bytes(home / "trajectory.tum", MAX_BYTES))
    store.write_joined_beams(folder / "beams", homes)
    pose_graph_g2o.write_g2o(folder / "graph.g2o", _join_graphs(place), poses)
    write_json(folder / SESSIONS, session_records(result))
    write_json(folder / CHANGES, _change_records(shift(result.changes, by, _FIELDS), names))
    arrays.write_npz(folder / "changes.npz", _change_cells(result.changes, result.shown.place, by))
    states = place_map.changed_cell_table(result.planar, names)
    states["cells"] = (states["cells"] + by.cells[:2]).astype(np.int32)
    arrays.write_npz(folder / STATES, states)
    store.write_ties(folder / store.TIES, place.ties, place.dimension)


def _join_graphs(place: Place) -> PoseGraph:
    """The pose graph of all sessions; scans are numbered through all of them."""
    sessions = [placed.session for placed in place.sessions]
    first_scan = accumulate([0, *(len(session.stamp_ns) for session in sessions)])
    pairs = zip(sessions, first_scan, strict=False)
    keyframes = [session.graph.keyframes + first for session, first in pairs]
    chain, loops = join_constraints(sessions, place.ties)
    nodes = np.concatenate([placed.nodes for placed in place.sessions])
    return PoseGraph(np.concatenate(keyframes), nodes, [*chain, *loops])


def session_records(result: PlaceResult) -> list[dict[str, Any]]:
    """The entries of `sessions.json`, in the order in which the inputs were given."""
    records: dict[str, dict[str, Any]] = {
        refused.name: {name: getattr(refused, name) for name in _REFUSAL}
        for refused in result.refusals
    }
    first_scan, by = 0, _to_map_frame(result.place)
    for placed in result.place.sessions:
        records[placed.session.name] = _placed_record(placed, first_scan, by)
        first_scan += len(placed.session.stamp_ns)
    return [records[name] for name in result.order if name in records]


def _placed_record(placed: PlacedSession, first_scan: int, by: Shift) -> dict[str, Any]:
    """The entry of a session whose scans begin at `first_scan` of those of the place."""
    stamp_ns = placed.session.stamp_ns
    return {
        "name": placed.session.name,
        "input": placed.session.input,
        "accepted": True,
        "T_place_session": _between_maps(placed, by, placed.T).tolist(),
        "covariance": placed.covariance.tolist(),
        "overlap": round(placed.overlap, 4),
        "first_stamp_ns": int(stamp_ns[0]),
        "last_stamp_ns": int(stamp_ns[-1]),
        "first_scan": first_scan,
        "scans": len(stamp_ns),
    }


def _change_records(
    changes: Sequence[PlaceChange], names: Sequence[str]
) -> list[dict[str, object]]:
    """The entries of `changes.json`.

    Args:
        changes: in the order of time, in the map frame.
        names: of the sessions, in the order of time.
    """
    out = list[dict[str, object]]()
    for number, change in enumerate(changes):
        record = {"id": number, "kind": change.kind, "box": _corners(change.low, change.high)}
        if change.from_low is not None and change.from_high is not None:
            record["from_box"] = _corners(change.from_low, change.from_high)
        between = [names[change.before], names[change.after]]
        out.append({**record, "between": between, "probability": round(change.probability, 4)})
    return out


def _corners(low: Float, high: Float) -> list[float]:
    """x0, y0, x1, y1, and in 3D z0, z1."""
    corners = [*low[:2], *high[:2], *low[2:], *high[2:]]
    return [round(float(x), 3) for x in corners]


def _change_cells(
    changes: Sequence[PlaceChange], place: PlaceStates, by: Shift
) -> dict[str, NDArray[np.generic]]:
    """The cells of all changes: `change` (K,) the entry of `changes.json`, and `xy` (K, 2) or `xyz`
    (K, 3), the centres of the cells in metres."""
    cells = [change.cells for change in changes]
    number = np.repeat(np.arange(len(changes), dtype=np.int32), [len(of) for of in cells])
    of = np.concatenate([np.zeros(0, np.intp), *cells])
    D = place.cells.shape[1]
    centres = (place.cells[of] + 0.5) * place.resolution + by.metres[:D]
    return {"change": number, "xyz"[:D]: centres}
