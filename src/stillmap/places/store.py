"""Files of a place: `sessions/NAME/` is enough to merge further ones without the recording.

`state/` holds flat arrays and the keyframes as a recording folder, from which all else follows;
`ties.npz` of the place the constraints between sessions.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from stillmap.core import arrays
from stillmap.core.array_folder import parse, read_array, read_npz, read_poses, write_arrays
from stillmap.core.array_types import Float
from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.errors import InputError
from stillmap.core.input_files import copy_content
from stillmap.io import stillmap_folder
from stillmap.io.stillmap_folder import read as read_recording
from stillmap.places.evidence import BeamCells
from stillmap.places.keyframes import Keyframes, Session
from stillmap.places.place import Place, PlacedSession, Tie
from stillmap.results.folder import ResultFolder
from stillmap.results.near_result import MAX_DISTANCE
from stillmap.results.pose_graph_g2o import read_g2o, write_g2o
from stillmap.results.reader import RECORD, SESSIONS, read_beams, read_labels, read_run, read_tracks
from stillmap.results.timeline import HINT, PlaceSession, read_sessions
from stillmap.slam import PoseGraph

STATE, TIES = "state", "ties.npz"
# in the record of a session: of the frame that a place has it in, in the map frame of its result
SESSION_ORIGIN = "session_origin"
_BEAMS = ("stamp_ns", "offset", "hit")  # of `beams/`; labels are written anew by every merge
_MAX_ARRAY = 1 << 31  # bytes of an array in an archive when it is unpacked
_KEYFRAMES, _GRAPH = "keyframes", "graph.g2o"
_TIES = ("first", "first_node", "second", "second_node")

_Edge = Annotated[float, Meta(gt=0.0, lt=100.0)]


@dataclass(frozen=True)
class _Settings:
    """`place` of the record of a place."""

    resolution: _Edge
    voxel_size: _Edge
    frame: str


def write_session(
    home: Path, poses: Float, graph: PoseGraph, keyframes: Keyframes, beams: BeamCells
) -> None:
    """Write what a place keeps of a session into its existing folder `sessions/NAME`: all else
    follows from it.

    Args:
        home: the folder.
        poses: (T, D+1, D+1) T_session_base.
        graph: the session's own pose graph.
        keyframes: its keyframes.
        beams: the cells of all its beams.
    """
    state, folder = home / STATE, home / STATE / _KEYFRAMES
    folder.mkdir(parents=True)
    cells = {"cells": beams.cells, "cell_node": beams.node, "beam_cell": beams.of_beam}
    write_arrays(state, {"poses": poses, **cells, "p_static": beams.p_static})
    write_g2o(state / _GRAPH, graph, poses)
    stillmap_folder.write_into(keyframes.recording, folder)
    write_arrays(folder, {"scans": keyframes.scans.astype(np.int64), "e": keyframes.e})


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


def read_place(folder: Path, threads: int = 1) -> tuple[Place, list[PlaceSession], list[str]]:
    """A place, the sessions that are not in it, and the names of all in their order.

    Args:
        folder: which `stillmap merge` wrote.
        threads: number of threads.

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
        _read_placed_session(
            folder / "sessions" / name, accepted[name], settings.voxel_size, threads
        )
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


def _read_placed_session(
    home: Path, record: PlaceSession, voxel_size: float, threads: int
) -> PlacedSession:
    session, state = read_session(home, record.input, threads), home / STATE
    read_beam_cells(home, session, voxel_size)
    read_tracks(state / "objects" / "objects.json")
    D, N, K = session.dimension, len(session.graph.keyframes), len(session.keyframes)
    covariance = np.asarray(record.covariance)
    if len(covariance) != 3 * (D - 1):
        raise _inconsistent(home)
    nodes = read_poses(state / "nodes.npy", N, D, MAX_DISTANCE)
    measured_at = read_poses(state / "measured_at.npy", K, D, MAX_DISTANCE)
    return PlacedSession(session, nodes, covariance, record.overlap, measured_at=measured_at)


def read_session(home: Path, path: str | None, threads: int = 1) -> Session:
    """The session that `write_session` wrote; arrays are memory-mapped.

    Args:
        home: `sessions/NAME` of a place.
        path: of its input, as it was given; None: it had none.
        threads: number of threads.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    state, folder = home / STATE, home / STATE / _KEYFRAMES
    stamp_ns, recording = np.array(read_beams(home)[0]), read_recording(folder)
    # compared, not subtracted: differences of numbers from a file may overflow
    if not len(stamp_ns) or (stamp_ns[1:] < stamp_ns[:-1]).any():
        raise _inconsistent(home / "beams")
    K, D, T = recording.n_scans, recording.dimension, len(stamp_ns)
    scans = np.array(read_array(folder / "scans.npy", (K,), np.int64), np.intp)
    e = read_array(folder / "e.npy", (recording.n_beams,), np.float32)
    poses, graph = read_poses(state / "poses.npy", T, D, MAX_DISTANCE), read_g2o(state / _GRAPH)
    rises = K > 0 and scans[0] >= 0 and scans[-1] < T and bool((np.diff(scans) > 0).all())
    fits = graph.poses.shape[-1] == D + 1 and bool(np.isin(graph.keyframes, scans).all())
    if (
        not (rises and fits)
        or not np.allclose(graph.poses, poses[graph.keyframes])
        or not ((e >= 0.0) & (e <= 1.0)).all()
    ):
        raise _inconsistent(state)
    nodes = np.searchsorted(scans, graph.keyframes)
    keyframes = Keyframes(recording, scans, poses[scans], e, nodes)
    run = ResultFolder(home, read_run(home))
    output, origin = run.output_options, run.read_origin(SESSION_ORIGIN)
    band = output.min_obstacle_height, output.max_obstacle_height
    return Session(home.name, path, stamp_ns, poses, graph, keyframes, band, origin, threads)


def read_beam_cells(home: Path, session: Session, resolution: float) -> BeamCells:
    """The cells, of edges of `resolution` m, in which the beams of a session ended; mapped files.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    state, n_beams = home / STATE, len(read_array(home / "beams" / "hit.npy", (None,), np.bool_))
    cells = read_array(state / "cells.npy", (None, session.dimension), np.int32)
    node = read_array(state / "cell_node.npy", (len(cells),), np.int32)
    of_beam = read_array(state / "beam_cell.npy", (n_beams,), np.int32)
    p_static = read_array(state / "p_static.npy", (n_beams,), np.float16)
    for values, first, last in (
        (node, 0, len(session.graph.keyframes) - 1),
        (of_beam, -1, len(cells) - 1),
        (p_static, 0, 1),
    ):
        for block in arrays.iter_blocks(values):
            if ((values[block] < first) | (values[block] > last)).any():
                raise _inconsistent(state)
    return BeamCells(cells, node, of_beam, p_static, resolution)


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
    counts = np.concatenate([np.diff(labels.offset) for labels in every])
    write_npy(folder / "offset.npy", np.concatenate([np.zeros(1, np.int64), counts.cumsum()]))
    for name in ("stamp_ns", "p_static", "hit"):
        parts = [getattr(labels, name) for labels in every]
        whole = arrays.empty((sum(map(len, parts)),), parts[0].dtype, folder)
        write_npy(folder / f"{name}.npy", np.concatenate(parts, out=whole))
