"""Files of a place: `sessions/NAME/` is enough to merge further ones without the recording.

`state/` holds flat arrays, the keyframes as recording folders, and evidence; `ties.npz` of the
place the constraints between sessions.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_folder import parse, read_array, read_npz, read_poses, write_arrays
from stillmap.core.array_types import Int64
from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.errors import InputError
from stillmap.core.input_files import copy_content
from stillmap.io import stillmap_folder
from stillmap.io.stillmap_folder import read as read_recording
from stillmap.places.evidence import BLOCK, BeamCells, Evidence
from stillmap.places.keyframes import Keyframes, Session
from stillmap.places.place import Place, PlacedSession, Tie
from stillmap.results.folder import ResultFolder
from stillmap.results.near_result import MAX_DISTANCE
from stillmap.results.pose_graph_g2o import read_g2o, write_g2o
from stillmap.results.reader import RECORD, SESSIONS, read_labels, read_run, read_tracks
from stillmap.results.timeline import HINT, PlaceSession, read_sessions

STATE, TIES = "state", "ties.npz"
# in the record of a session: of the frame that a place has it in, in the map frame of its result
SESSION_ORIGIN = "session_origin"
_BEAMS = ("stamp_ns", "offset", "hit")  # of `beams/`; labels are written anew by every merge
_MAX_ARRAY = 1 << 31  # bytes of an array in an archive when it is unpacked
_KEYFRAMES, _PLANAR, _GRAPH = "keyframes", "planar", "graph.g2o"
_TIES = ("first", "first_node", "second", "second_node")

_Edge = Annotated[float, Meta(gt=0.0, lt=100.0)]


@dataclass(frozen=True)
class _Settings:
    """`place` of the record of a place."""

    resolution: _Edge
    voxel_size: _Edge
    frame: str


def write_session(home: Path, session: Session, beams: BeamCells) -> None:
    """Write the state of a session into its existing folder `sessions/NAME`."""
    state = home / STATE
    state.mkdir()
    write_arrays(
        state,
        {
            "poses": session.poses,
            "clearance": session.clearance,
            "cells": beams.cells,
            "cell_node": beams.node,
            "beam_cell": beams.of_beam,
            "p_static": beams.p_static,
        },
    )
    write_g2o(state / _GRAPH, session.graph, session.poses)
    _write_keyframes(state / _KEYFRAMES, session.keyframes)
    if session.dimension == 3:
        _write_keyframes(state / _PLANAR, session.planar)


def _write_keyframes(folder: Path, keyframes: Keyframes) -> None:
    folder.mkdir()
    stillmap_folder.write_into(keyframes.recording, folder)
    of = {"scans": keyframes.scans.astype(np.int64), "nodes": keyframes.nodes.astype(np.int64)}
    write_arrays(folder, {**of, "poses": keyframes.poses, "e": keyframes.e})


def write_placement(home: Path, placed: PlacedSession) -> None:
    """Write where a session lies in its place, and its evidence there."""
    state = home / STATE
    evidence, planar = placed.require_evidence()
    of = {"nodes": placed.nodes, "covariance": placed.covariance, "measured_at": placed.measured_at}
    write_arrays(state, of)
    _write_evidence(state / "evidence.npz", evidence)
    if planar is not evidence:
        _write_evidence(state / "planar_evidence.npz", planar)


def _write_evidence(path: Path, evidence: Evidence) -> None:
    of = {name: getattr(evidence, name) for name in ("corner", "hits", "passes")}
    write_npz(path, {**of, "resolution": np.array(evidence.resolution)})


def write_ties(path: Path, ties: Sequence[Tie], D: int) -> None:
    """Write the constraints between sessions in D dimensions."""
    dof = 3 * (D - 1)
    columns = {name: np.array([getattr(tie, name) for tie in ties], np.int64) for name in _TIES}
    T = np.array([tie.T for tie in ties]).reshape(-1, D + 1, D + 1)
    covariance = np.array([tie.covariance for tie in ties]).reshape(-1, dof, dof)
    write_npz(path, {**columns, "T": T, "covariance": covariance})


def copy_session(source: Path, target: Path) -> None:
    """Copy what a place keeps of a session, with permissions as of new files.

    What every merge writes anew stays behind: labels, trajectory, placed objects.

    Args:
        source: `sessions/NAME` of a place.
        target: the same of another place; must not exist.

    Raises:
        InputError: a file cannot be read.
    """
    target.mkdir()
    (target / "beams").mkdir()
    names = [RECORD, *(f"beams/{name}.npy" for name in _BEAMS)]
    for folder, _, files in os.walk(source / STATE):
        part = os.path.relpath(folder, source)
        os.mkdir(target / part)
        names += [f"{part}/{name}" for name in sorted(files)]
    for name in names:
        copy_content(f"{source}/{name}", f"{target}/{name}")


def read_place(folder: Path) -> tuple[Place, list[PlaceSession], list[str]]:
    """A place, the sessions that are not in it, and the names of all in their order.

    Args:
        folder: which `stillmap merge` wrote.

    Raises:
        InputError: a file is missing or damaged.
    """
    run, records = read_run(folder), read_sessions(folder)
    settings = parse(run.get("place"), _Settings, folder / RECORD, HINT)
    accepted = {record.name: record for record in records if record.accepted}
    order = run["input"].get("sessions")
    if not isinstance(order, list) or not order or sorted(map(str, order)) != sorted(accepted):
        what = "names other sessions than run.json: one of them was changed by hand"
        raise InputError(what, where=str(folder / SESSIONS), hint=HINT)
    if settings.frame not in accepted:
        raise _inconsistent(folder / RECORD)
    sessions = [
        _read_placed(folder / "sessions" / name, accepted[name], settings.voxel_size)
        for name in order
    ]
    if len({placed.session.dimension for placed in sessions}) != 1:
        raise _inconsistent(folder)
    # that of the first one stays by itself: its first pose is what the pose graph holds
    frame = None if settings.frame == order[0] else settings.frame
    ties = _read_ties(folder / TIES, sessions)
    place = Place(sessions, ties, settings.resolution, settings.voxel_size, frame)
    refused = [record for record in records if not record.accepted]
    return place, refused, [record.name for record in records]


def _read_placed(home: Path, record: PlaceSession, voxel_size: float) -> PlacedSession:
    stamp_ns, n_beams = _read_beams(home / "beams")
    session, state = read_session(home, record.input, stamp_ns), home / STATE
    _check_beam_cells(home, read_beam_cells(home, n_beams, voxel_size), session)
    read_tracks(state / "objects" / "objects.json")
    D, N, K = session.dimension, len(session.graph.keyframes), len(session.keyframes)
    nodes = read_poses(state / "nodes.npy", N, D, MAX_DISTANCE)
    measured_at = read_poses(state / "measured_at.npy", K, D, MAX_DISTANCE)
    covariance = np.array(read_array(state / "covariance.npy", (3 * (D - 1),) * 2, np.float64))
    if not np.isfinite(covariance).all():
        raise _inconsistent(state / "covariance.npy")
    evidence = planar = _read_evidence(state / "evidence.npz", D)
    if D == 3:
        planar = _read_evidence(state / "planar_evidence.npz", 2)
    return PlacedSession(session, nodes, covariance, record.overlap, evidence, planar, measured_at)


def _read_beams(folder: Path) -> tuple[Int64, int]:
    """(T,) stamps of the scans of a session, and the number of its beams."""
    stamp_ns = np.array(read_array(folder / "stamp_ns.npy", (None,), np.int64))
    offset = np.array(read_array(folder / "offset.npy", (len(stamp_ns) + 1,), np.int64))
    # compared, not subtracted: differences of numbers from a file may overflow
    rises = all((column[1:] >= column[:-1]).all() for column in (offset, stamp_ns))
    if not len(stamp_ns) or offset[0] != 0 or not rises:
        raise _inconsistent(folder)
    read_array(folder / "hit.npy", (int(offset[-1]),), np.bool_)
    return stamp_ns, int(offset[-1])


def read_session(home: Path, path: str | None, stamp_ns: Int64) -> Session:
    """The session that `write_session` wrote; arrays are memory-mapped.

    Args:
        home: `sessions/NAME` of a place.
        path: of its input, as it was given; None: it had none.
        stamp_ns: (T,) stamps of its scans.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    state = home / STATE
    keyframes = _read_keyframes(state / _KEYFRAMES)
    D, K = keyframes.dimension, len(keyframes)
    planar = _read_keyframes(state / _PLANAR) if D == 3 else keyframes
    poses = read_poses(state / "poses.npy", len(stamp_ns), D, MAX_DISTANCE)
    graph = read_g2o(state / _GRAPH)
    clearance = np.array(read_array(state / "clearance.npy", (K,), np.float64))
    if (
        planar.dimension != 2
        or len(planar) != K
        or graph.poses.shape[-1] != D + 1
        or not np.array_equal(keyframes.scans[keyframes.nodes], graph.keyframes)
        or keyframes.scans[-1] >= len(poses)
        or not np.array_equal(keyframes.poses, poses[keyframes.scans])
        or not (np.abs(clearance) < MAX_DISTANCE).all()
    ):
        raise _inconsistent(state)
    origin = ResultFolder(home, read_run(home)).read_origin(SESSION_ORIGIN)
    return Session(home.name, path, stamp_ns, poses, graph, keyframes, planar, clearance, origin)


def _read_keyframes(folder: Path) -> Keyframes:
    recording = read_recording(folder)
    K, name = recording.n_scans, folder / "poses.npy"
    scans = np.array(read_array(folder / "scans.npy", (K,), np.int64), np.intp)
    nodes = np.array(read_array(folder / "nodes.npy", (None,), np.int64), np.intp)
    D = read_array(name, (K, None, None), np.float64).shape[1] - 1
    poses = read_poses(name, K, D, MAX_DISTANCE) if D in (2, 3) else np.zeros(0)
    e = read_array(folder / "e.npy", (recording.n_beams,), np.float32)
    if not K or not len(nodes) or np.any(np.diff(scans) <= 0) or np.any(np.diff(nodes) <= 0):
        raise _inconsistent(folder)
    if nodes[0] < 0 or nodes[-1] >= K or scans[0] < 0 or not ((e >= 0.0) & (e <= 1.0)).all():
        raise _inconsistent(folder)
    return Keyframes(recording, scans, poses, e, nodes)


def read_beam_cells(home: Path, n_beams: int, resolution: float) -> BeamCells:
    """The cells, of edges of `resolution` m, in which the beams of a session ended; mapped files.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    state = home / STATE
    cells = read_array(state / "cells.npy", (None, None), np.int32)
    node = read_array(state / "cell_node.npy", (len(cells),), np.int32)
    of_beam = read_array(state / "beam_cell.npy", (n_beams,), np.int32)
    p_static = read_array(state / "p_static.npy", (n_beams,), np.float16)
    return BeamCells(cells, node, of_beam, p_static, resolution)


def _check_beam_cells(home: Path, beams: BeamCells, session: Session) -> None:
    """Refuse cells and labels of beams that cannot be those of a session."""
    if beams.cells.shape[1:] != (session.dimension,):
        raise _inconsistent(home / STATE)
    for values, first, last in (
        (beams.node, 0, len(session.graph.keyframes) - 1),
        (beams.of_beam, -1, len(beams.cells) - 1),
        (beams.p_static, 0, 1),
    ):
        for block in arrays.iter_blocks(values):
            if ((values[block] < first) | (values[block] > last)).any():
                raise _inconsistent(home / STATE)


def _read_evidence(path: Path, D: int) -> Evidence:
    corner, hits, passes, resolution = read_npz(
        path, ("corner", "hits", "passes", "resolution"), _MAX_ARRAY, HINT
    ).values()
    shape = (len(corner), *(BLOCK[D],) * D)
    fits = corner.shape == (len(corner), D) and hits.shape == shape and passes.shape == shape
    kinds = corner.dtype == np.int32 and hits.dtype == np.uint8 and passes.dtype == np.uint8
    is_usable = fits and kinds and resolution.shape == () and 0.0 < float(resolution) < 100.0
    if not is_usable or np.any(corner % BLOCK[D]):
        raise _inconsistent(path)
    return Evidence(corner, hits, passes, float(resolution))


def _read_ties(path: Path, sessions: list[PlacedSession]) -> list[Tie]:
    D = sessions[0].session.dimension
    *columns, T, covariance = read_npz(path, (*_TIES, "T", "covariance"), _MAX_ARRAY, HINT).values()
    L, counts = len(columns[0]), np.array([len(placed.nodes) for placed in sessions])
    shapes = [(L,)] * 4 + [(L, D + 1, D + 1), (L, 3 * (D - 1), 3 * (D - 1))]
    if [array.shape for array in (*columns, T, covariance)] != shapes or any(
        column.dtype.kind != "i" for column in columns
    ):
        raise _inconsistent(path)
    ends = np.array(columns)
    sessions_of, nodes = ends[::2], ends[1::2]
    inside = (sessions_of >= 0) & (sessions_of < len(sessions)) & (nodes >= 0)
    inside &= nodes < counts[sessions_of % len(sessions)]
    apart = (sessions_of[0] != sessions_of[1]).all()
    usable = (np.abs(T) < MAX_DISTANCE).all() and np.isfinite(covariance).all()
    if not (inside.all() and apart and usable):
        raise _inconsistent(path)
    if L and np.linalg.eigvalsh(covariance).min() <= 0.0:
        raise _inconsistent(path)
    rows = enumerate(ends.T.tolist())
    return [Tie(a, i, b, j, T[k], covariance[k]) for k, (a, i, b, j) in rows]


def _inconsistent(folder: Path) -> InputError:
    what = "is damaged or was changed by hand: its arrays do not belong together"
    return InputError(what, where=str(folder), hint=HINT)


def write_joined_beams(folder: Path, homes: list[Path]) -> None:
    """Write `beams/` of a place: the labels of its sessions one after the other."""
    folder.mkdir()
    every = [read_labels(home) for home in homes]
    offsets, first = [np.zeros(1, np.int64)], 0
    for labels in every:
        offsets.append(labels.offset[1:] + first)
        first += int(labels.offset[-1])
    write_npy(
        folder / "stamp_ns.npy", np.concatenate([of_session.stamp_ns for of_session in every])
    )
    write_npy(folder / "offset.npy", np.concatenate(offsets))
    _write_joined(folder / "p_static.npy", [of_session.p_static for of_session in every])
    _write_joined(folder / "hit.npy", [of_session.hit for of_session in every])


def _write_joined(path: Path, parts: Sequence[NDArray[Any]]) -> None:
    """Write arrays one after the other as one, without all of them in memory."""
    header = np.lib.format.header_data_from_array_1_0(np.empty(0, parts[0].dtype))
    with path.open("wb") as file:
        shape = (sum(len(part) for part in parts),)
        np.lib.format.write_array_header_1_0(file, {**header, "shape": shape})
        for part in parts:
            for block in arrays.iter_bytes(part):
                file.write(block)
