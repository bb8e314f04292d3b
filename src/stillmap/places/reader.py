"""A place read again from its folder."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_folder import read_npz
from stillmap.core.errors import InputError
from stillmap.core.json import read_json
from stillmap.places.checksums import check_checksums
from stillmap.places.evidence import BLOCK, Evidence
from stillmap.places.inputs import TIES
from stillmap.places.keyframes import Keyframes
from stillmap.places.objects import check_objects
from stillmap.places.place import Place, PlacedSession, Refusal, to_planar
from stillmap.places.place_graph import Tie
from stillmap.places.store import (
    HINT,
    STATE,
    check_beam_cells,
    is_rigid,
    read_beam_cells,
    read_poses,
    read_session,
)
from stillmap.results.labels import read_array
from stillmap.results.reader import SESSIONS
from stillmap.results.run_record import read_record

Float = NDArray[np.float64]

_MAX_JSON = 64 << 20  # bytes
_MAX_ARRAY = 1 << 31  # bytes of an array in an archive when it is unpacked


def read_place(folder: Path) -> tuple[Place, list[Refusal], list[str]]:
    """A place, the sessions that are not in it, and the names of all in their order.

    Args:
        folder: which `stillmap merge` wrote.

    Raises:
        InputError: a file is missing, damaged, or was changed by hand.
    """
    run = read_record(folder)
    records = read_sessions(folder)
    accepted = _order_accepted(folder, records, run["input"].get("sessions"))
    settings = run.get("place")
    try:
        resolution, voxel_size = (float(settings[name]) for name in ("resolution", "voxel_size"))  # type: ignore[index]
        if not (0.0 < resolution < 100.0 and 0.0 < voxel_size < 100.0):
            raise ValueError("edges of cells")
        frame = str(settings["frame"])  # type: ignore[index]
        if frame not in {record["name"] for record in accepted}:
            raise ValueError("the frame of no session")
    except (TypeError, KeyError, ValueError) as error:
        raise InputError("is no record of a place", where=str(folder / "run.json")) from error
    sessions = [
        _read_placed(folder / "sessions" / record["name"], record, voxel_size)
        for record in accepted
    ]
    if len({one.session.dimension for one in sessions}) != 1:
        raise InputError("has sessions in 2D and in 3D", where=str(folder), hint=HINT)
    ties = _read_ties(folder / TIES, sessions)
    refusals = [
        Refusal(record["name"], record.get("input"), str(record.get("why", "")))
        for record in records
        if not record["accepted"]
    ]
    # that of the first one stays by itself: its first pose is what the pose graph holds
    moved = None if frame == accepted[0]["name"] else frame
    place = Place(sessions, ties, resolution, voxel_size, moved)
    return place, refusals, [record["name"] for record in records]


def _order_accepted(
    folder: Path, records: list[dict[str, Any]], order: Any
) -> list[dict[str, Any]]:
    """The entries of accepted sessions in the order in which they were merged.

    Raises:
        InputError: there are none, or `run.json` names others.
    """
    accepted = {record["name"]: record for record in records if record["accepted"]}
    if not accepted:
        raise InputError("holds no session", where=str(folder / SESSIONS), hint=HINT)
    if not isinstance(order, list) or sorted(map(str, order)) != sorted(accepted):
        what = "names other sessions than run.json: one of them was changed by hand"
        raise InputError(what, where=str(folder / SESSIONS), hint=HINT)
    return [accepted[name] for name in order]


def read_sessions(folder: Path) -> list[dict[str, Any]]:
    """The entries of `sessions.json`.

    Raises:
        InputError: it is missing or damaged.
    """
    path = folder / SESSIONS
    records = read_json(path, _MAX_JSON, HINT)
    try:
        for record in records:
            name = record["name"]
            if not isinstance(name, str) or not name or "/" in name or name in (".", ".."):
                raise ValueError(f"a session cannot have the name {name!r}")
            if not isinstance(record.get("input"), str | None):
                raise ValueError(f"the input of {name} is no path")
            if not isinstance(record["accepted"], bool):
                raise ValueError(f"'accepted' of {name} is neither true nor false")
        if len({record["name"] for record in records}) != len(records):
            raise ValueError("two sessions have one name")
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"is damaged: {error}", where=str(path), hint=HINT) from error
    return list(records)


def _read_placed(home: Path, record: dict[str, Any], voxel_size: float) -> PlacedSession:
    check_checksums(home)
    read_record(home)
    stamp_ns, n_beams = _read_beams(home / "beams")
    session, state = read_session(home, record.get("input"), stamp_ns), home / STATE
    check_beam_cells(home, read_beam_cells(home, n_beams, voxel_size), session)
    check_objects(state)
    D, N, K = session.dimension, len(session.graph.keyframes), len(session.keyframes)
    nodes = read_poses(state / "nodes.npy", N, D)
    measured_at = read_poses(state / "measured_at.npy", K, D)
    dof = 3 * (D - 1)
    covariance = np.array(read_array(state / "covariance.npy", (dof, dof), "f"))
    if not np.isfinite(covariance).all():
        raise InputError("is not finite", where=str(state / "covariance.npy"), hint=HINT)
    evidence = _read_evidence(state / "evidence.npz", session.keyframes, measured_at)
    planar = evidence
    if D == 3:
        at = to_planar(session, measured_at)
        planar = _read_evidence(state / "planar_evidence.npz", session.planar, at)
    overlap = record.get("overlap", 1.0)
    if not isinstance(overlap, int | float):
        raise InputError("overlap is no number", where=str(home.parent.parent / SESSIONS))
    return PlacedSession(session, nodes, covariance, float(overlap), evidence, planar, measured_at)


def _read_beams(folder: Path) -> tuple[NDArray[np.int64], int]:
    """(T,) stamps of the scans of a session, and the number of its beams.

    Raises:
        InputError: `beams/` is damaged.
    """
    stamp_ns = np.array(read_array(folder / "stamp_ns.npy", (None,), "i"), np.int64)
    offset = np.array(read_array(folder / "offset.npy", (len(stamp_ns) + 1,), "i"), np.int64)
    if offset[0] != 0 or np.any(np.diff(offset) < 0):
        raise InputError("does not rise from 0", where=str(folder / "offset.npy"), hint=HINT)
    if np.any(stamp_ns[1:] < stamp_ns[:-1]) or not len(stamp_ns):
        raise InputError("stamps decrease", where=str(folder / "stamp_ns.npy"), hint=HINT)
    read_array(folder / "hit.npy", (int(offset[-1]),), "b")
    return stamp_ns, int(offset[-1])


def _read_evidence(path: Path, keyframes: Keyframes, poses: Float) -> Evidence:
    """The evidence of keyframes that lay at poses (K, D+1, D+1) when it was measured."""
    D = poses.shape[-1] - 1
    corner, hits, passes, resolution = read_npz(
        path, ("corner", "hits", "passes", "resolution"), _MAX_ARRAY, HINT
    ).values()
    shape = (len(corner), *(BLOCK[D],) * D)
    fits = corner.shape == (len(corner), D) and hits.shape == shape and passes.shape == shape
    kinds = corner.dtype == np.int32 and hits.dtype == np.uint8 and passes.dtype == np.uint8
    if not (fits and kinds and resolution.shape == () and 0.0 < float(resolution) < 100.0):
        raise InputError("is damaged or was changed by hand", where=str(path), hint=HINT)
    low = corner.min(axis=0, initial=0) * float(resolution)
    high = (corner.max(axis=0, initial=0) + BLOCK[D]) * float(resolution)
    if np.any(corner % BLOCK[D]) or not _end_within(keyframes, poses, low, high):
        raise InputError("is not that of the keyframes", where=str(path), hint=HINT)
    return Evidence(corner, hits, passes, float(resolution))


def _end_within(keyframes: Keyframes, poses: Float, low: Float, high: Float) -> bool:
    """Whether all beams that hit something end in a box of corners (D,), metres."""
    recording = keyframes.recording
    for block in arrays.iter_blocks(recording.hit):
        beams = block.start + np.flatnonzero(recording.hit[block])
        ends = recording.end_points(beams, poses)
        if ((ends < low) | (ends > high)).any():
            return False
    return True


def _read_ties(path: Path, sessions: list[PlacedSession]) -> list[Tie]:
    D = sessions[0].session.dimension
    dof = 3 * (D - 1)
    first, first_node, second, second_node, T, covariance = read_npz(
        path, ("first", "first_node", "second", "second_node", "T", "covariance"), _MAX_ARRAY, HINT
    ).values()
    L, counts = len(first), np.array([len(one.nodes) for one in sessions])
    columns = first, first_node, second, second_node
    if any(column.shape != (L,) or column.dtype.kind != "i" for column in columns):
        raise InputError("is damaged: columns of unequal length", where=str(path), hint=HINT)
    ends = ((first, first_node), (second, second_node))
    for session, node in ends:
        inside = (session >= 0) & (session < len(sessions)) & (node >= 0)
        if not inside.all() or (node >= counts[session]).any() or (first == second).any():
            raise InputError("names a session or node that is not there", where=str(path))
    if T.shape != (L, D + 1, D + 1) or covariance.shape != (L, dof, dof):
        raise InputError("is damaged: transforms of another shape", where=str(path), hint=HINT)
    if not is_rigid(T) or not np.isfinite(covariance).all():
        raise InputError("is damaged: no rigid transforms", where=str(path), hint=HINT)
    if len(covariance) and np.linalg.eigvalsh(covariance).min() <= 0.0:
        raise InputError("is damaged: no covariances", where=str(path), hint=HINT)
    return [
        Tie(a, i, b, j, T[k], covariance[k])
        for k, (a, i, b, j) in enumerate(zip(*(c.tolist() for c in columns), strict=True))
    ]
