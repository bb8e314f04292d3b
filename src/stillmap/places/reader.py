"""A place read again from its folder."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.files import read_text, require_regular
from stillmap.places.evidence import BLOCK, Evidence
from stillmap.places.place import Place, PlacedSession, Refusal
from stillmap.places.place_graph import Tie
from stillmap.places.store import STATE, read_session
from stillmap.results.folder import read_record
from stillmap.results.labels import read_array
from stillmap.results.reader import SESSIONS

Float = NDArray[np.float64]

MAX_JSON = 64 << 20  # bytes
_MAX_ARRAY = 1 << 31  # bytes of an array in an archive when it is unpacked
_HINT = "merge the sessions anew"


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
    except (TypeError, KeyError, ValueError) as error:
        raise InputError("is no record of a place", where=str(folder / "run.json")) from error
    sessions = [_read_placed(folder / "sessions" / record["name"], record) for record in accepted]
    if len({one.session.dimension for one in sessions}) != 1:
        raise InputError("has sessions in 2D and in 3D", where=str(folder), hint=_HINT)
    ties = _read_ties(folder / "ties.npz", sessions)
    refusals = [
        Refusal(record["name"], record.get("input"), str(record.get("why", "")))
        for record in records
        if not record["accepted"]
    ]
    place = Place(sessions, ties, resolution, voxel_size)
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
        raise InputError("holds no session", where=str(folder / SESSIONS), hint=_HINT)
    if not isinstance(order, list) or sorted(map(str, order)) != sorted(accepted):
        what = "names other sessions than run.json: one of them was changed by hand"
        raise InputError(what, where=str(folder / SESSIONS), hint=_HINT)
    return [accepted[name] for name in order]


def read_sessions(folder: Path) -> list[dict[str, Any]]:
    """The entries of `sessions.json`.

    Raises:
        InputError: it is missing or damaged.
    """
    path = folder / SESSIONS
    require_regular(path)
    try:
        records = json.loads(read_text(path, MAX_JSON))
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
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputError(f"is damaged: {error}", where=str(path), hint=_HINT) from error
    return list(records)


def _read_placed(home: Path, record: dict[str, Any]) -> PlacedSession:
    stamp_ns = np.array(read_array(home / "beams" / "stamp_ns.npy", (None,), "i"), np.int64)
    session, state = read_session(home, record.get("input"), stamp_ns), home / STATE
    D, N, K = session.dimension, len(session.graph.keyframes), len(session.keyframes)
    nodes = _read_poses(state / "nodes.npy", N, D)
    measured_at = _read_poses(state / "measured_at.npy", K, D)
    dof = 3 * (D - 1)
    covariance = np.array(read_array(state / "covariance.npy", (dof, dof), "f"))
    evidence = _read_evidence(state / "evidence.npz", D)
    planar = evidence if D == 2 else _read_evidence(state / "planar_evidence.npz", 2)
    overlap = record.get("overlap", 1.0)
    if not isinstance(overlap, int | float):
        raise InputError("overlap is no number", where=str(home.parent.parent / SESSIONS))
    return PlacedSession(session, nodes, covariance, float(overlap), evidence, planar, measured_at)


def _read_poses(path: Path, count: int, D: int) -> Float:
    poses = np.array(read_array(path, (count, D + 1, D + 1), "f"), np.float64)
    R = poses[:, :D, :D]
    if not (np.isfinite(poses).all() and np.allclose(R @ R.swapaxes(1, 2), np.eye(D), atol=1e-6)):
        raise InputError("holds no rigid transforms", where=str(path), hint=_HINT)
    return poses


def _read_evidence(path: Path, D: int) -> Evidence:
    arrays = _read_archive(path, ("corner", "hits", "passes", "resolution"))
    corner, hits, passes, resolution = arrays
    shape = (len(corner), *(BLOCK[D],) * D)
    fits = corner.shape == (len(corner), D) and hits.shape == shape and passes.shape == shape
    kinds = corner.dtype == np.int32 and hits.dtype == np.uint8 and passes.dtype == np.uint8
    if not (fits and kinds and resolution.shape == () and 0.0 < float(resolution) < 100.0):
        raise InputError("is damaged or was changed by hand", where=str(path), hint=_HINT)
    return Evidence(corner, hits, passes, float(resolution))


def _read_ties(path: Path, sessions: list[PlacedSession]) -> list[Tie]:
    D = sessions[0].session.dimension
    dof = 3 * (D - 1)
    first, first_node, second, second_node, T, covariance = _read_archive(
        path, ("first", "first_node", "second", "second_node", "T", "covariance")
    )
    L, counts = len(first), np.array([len(one.nodes) for one in sessions])
    columns = first, first_node, second, second_node
    if any(column.shape != (L,) or column.dtype.kind != "i" for column in columns):
        raise InputError("is damaged: columns of unequal length", where=str(path), hint=_HINT)
    ends = ((first, first_node), (second, second_node))
    for session, node in ends:
        inside = (session >= 0) & (session < len(sessions)) & (node >= 0)
        if not inside.all() or (node >= counts[session]).any():
            raise InputError("names a session or node that is not there", where=str(path))
    if T.shape != (L, D + 1, D + 1) or covariance.shape != (L, dof, dof):
        raise InputError("is damaged: transforms of another shape", where=str(path), hint=_HINT)
    return [
        Tie(a, i, b, j, T[k], covariance[k])
        for k, (a, i, b, j) in enumerate(zip(*(c.tolist() for c in columns), strict=True))
    ]


def _read_archive(path: Path, names: tuple[str, ...]) -> list[NDArray[Any]]:
    """Arrays of an `.npz` file.

    Raises:
        InputError: it is missing, damaged, or too large when unpacked.
    """
    require_regular(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            out = []
            for name in names:
                if archive.zip.getinfo(f"{name}.npy").file_size > _MAX_ARRAY:
                    raise InputError(f"{name} is too large when unpacked", where=str(path))
                out.append(np.asarray(archive[name]))
            return out
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=str(path)) from error
    except Exception as error:  # whatever NumPy, zip and zlib make of damaged bytes
        raise InputError(f"is damaged: {error}", where=str(path), hint=_HINT) from error
