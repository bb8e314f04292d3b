"""The state of a session in its place, `sessions/NAME/state/`: enough to merge further sessions
without its recording."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.arrays import write_npy
from stillmap.core.errors import InputError
from stillmap.core.input_files import copy_content
from stillmap.io import stillmap_folder
from stillmap.io.stillmap_folder import read as read_recording
from stillmap.places.beam_cells import BeamCells
from stillmap.places.inputs import MAX_DISTANCE, SESSION_ORIGIN
from stillmap.places.keyframes import Keyframes
from stillmap.places.session import Session
from stillmap.results.labels import read_array
from stillmap.results.pose_graph_g2o import read_g2o, write_g2o
from stillmap.results.run_json import RECORD
from stillmap.results.run_record import read_frame, read_record

Float = NDArray[np.float64]

STATE = "state"
BEAMS = ("stamp_ns", "offset", "hit")  # of `beams/`; labels are written anew by every merge
# of the state, by every merge
WRITTEN_ANEW = (
    *("nodes.npy", "covariance.npy", "measured_at.npy"),
    *("evidence.npz", "planar_evidence.npz"),
)
HINT = "merge the sessions anew"
_COPIED_AT_ONCE = 1 << 20  # bytes
_KEYFRAMES, _PLANAR, _GRAPH = "keyframes", "planar", "graph.g2o"


def write_session(folder: Path, session: Session, beams: BeamCells) -> None:
    """Write the state of a session into an existing folder of the session.

    Args:
        folder: `sessions/NAME`.
        session: T scans.
        beams: the cells in which its beams ended, and its own labels.
    """
    state = folder / STATE
    state.mkdir()
    write_npy(state / "poses.npy", session.poses)
    write_npy(state / "clearance.npy", session.clearance)
    write_g2o(state / _GRAPH, session.graph, session.poses)
    _write_keyframes(state / _KEYFRAMES, session.keyframes)
    if session.dimension == 3:
        _write_keyframes(state / _PLANAR, session.planar)
    write_npy(state / "cells.npy", beams.cells)
    write_npy(state / "cell_node.npy", beams.node)
    write_npy(state / "beam_cell.npy", beams.of_beam)
    write_npy(state / "p_static.npy", beams.p_static)


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
    names = [RECORD, *(f"beams/{name}.npy" for name in BEAMS)]
    for folder, _, files in os.walk(source / STATE):
        part = os.path.relpath(folder, source)
        os.mkdir(target / part)
        names += [f"{part}/{name}" for name in sorted(files)]
    for name in names:
        copy_content(f"{source}/{name}", f"{target}/{name}")


def _write_keyframes(folder: Path, keyframes: Keyframes) -> None:
    folder.mkdir()
    stillmap_folder.write_into(keyframes.recording, folder)
    write_npy(folder / "scans.npy", keyframes.scans.astype(np.int64))
    write_npy(folder / "poses.npy", keyframes.poses)
    write_npy(folder / "e.npy", keyframes.e)
    write_npy(folder / "nodes.npy", keyframes.nodes.astype(np.int64))


def read_session(folder: Path, path: str | None, stamp_ns: NDArray[np.int64]) -> Session:
    """The session that `write_session` wrote; arrays are memory-mapped.

    Args:
        folder: `sessions/NAME` of a place.
        path: of its input, as it was given; None: it had none.
        stamp_ns: (T,) stamps of its scans.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    state = folder / STATE
    keyframes = _read_keyframes(state / _KEYFRAMES)
    D, K = keyframes.dimension, len(keyframes)
    planar = _read_keyframes(state / _PLANAR) if D == 3 else keyframes
    poses = read_poses(state / "poses.npy", len(stamp_ns), D)
    graph = read_g2o(state / _GRAPH)
    clearance = np.array(read_array(state / "clearance.npy", (K,), "f"), np.float64)
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
    frame = read_frame(folder, read_record(folder), SESSION_ORIGIN)
    return Session(folder.name, path, stamp_ns, poses, graph, keyframes, planar, clearance, frame)


def read_poses(path: Path, count: int, D: int) -> Float:
    """(count, D+1, D+1) rigid transforms of an `.npy` file.

    Raises:
        InputError: it is missing or damaged, or holds something else.
    """
    poses = np.array(read_array(path, (count, D + 1, D + 1), "f"), np.float64)
    if not is_rigid(poses):
        raise InputError("holds no rigid transforms", where=str(path), hint=HINT)
    return poses


def is_rigid(poses: Float) -> bool:
    """Whether all of (N, D+1, D+1) are rigid transforms within a possible distance."""
    D = poses.shape[-1] - 1
    R = poses[:, :D, :D]
    return bool(
        (np.abs(poses) < MAX_DISTANCE).all()
        and (poses[:, D] == np.eye(D + 1)[D]).all()
        and np.allclose(R @ R.swapaxes(1, 2), np.eye(D), atol=1e-6)
    )


def _read_keyframes(folder: Path) -> Keyframes:
    recording = read_recording(folder)
    K = recording.n_scans
    scans = np.array(read_array(folder / "scans.npy", (K,), "i"), np.intp)
    poses = np.array(read_array(folder / "poses.npy", (K, None, None), "f"), np.float64)
    e = read_array(folder / "e.npy", (recording.n_beams,), "f")
    nodes = np.array(read_array(folder / "nodes.npy", (None,), "i"), np.intp)
    if not K or not len(nodes) or np.any(np.diff(scans) <= 0) or np.any(np.diff(nodes) <= 0):
        raise _inconsistent(folder)
    if nodes[0] < 0 or nodes[-1] >= K or scans[0] < 0 or poses.shape[1] not in (3, 4):
        raise _inconsistent(folder)
    if poses.shape[1] != poses.shape[2] or not is_rigid(poses):
        raise _inconsistent(folder)
    if e.dtype != np.float32 or not ((e >= 0.0) & (e <= 1.0)).all():
        raise InputError("holds no probabilities", where=str(folder / "e.npy"), hint=HINT)
    return Keyframes(recording, scans, poses, e, nodes)


def read_beam_cells(folder: Path, n_beams: int, resolution: float) -> BeamCells:
    """The cells in which the beams of a session ended; the files are memory-mapped.

    Args:
        folder: `sessions/NAME` of a place.
        n_beams: of the session.
        resolution: m, edge of a cell.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    state = folder / STATE
    cells = read_array(state / "cells.npy", (None, None), "i")
    node = read_array(state / "cell_node.npy", (len(cells),), "i")
    of_beam = read_array(state / "beam_cell.npy", (n_beams,), "i")
    return BeamCells(
        cells, node, of_beam, read_array(state / "p_static.npy", (n_beams,), "f"), resolution
    )


def check_beam_cells(folder: Path, beams: BeamCells, session: Session) -> None:
    """Refuse cells and labels of beams that cannot be those of a session.

    Raises:
        InputError: names the file.
    """
    count, state = len(beams.cells), folder / STATE
    if beams.cells.shape[1:] != (session.dimension,):
        raise _inconsistent(state)
    for name, values, last in (
        ("cell_node", beams.node, len(session.graph.keyframes) - 1),
        ("beam_cell", beams.of_beam, count - 1),
    ):
        first = -1 if name == "beam_cell" else 0
        for block in arrays.iter_blocks(values):
            if ((values[block] < first) | (values[block] > last)).any():
                what = "names what is not there"
                raise InputError(what, where=str(state / f"{name}.npy"), hint=HINT)
    for block in arrays.iter_blocks(beams.p_static):
        if ((beams.p_static[block] < 0.0) | (beams.p_static[block] > 1.0)).any():
            what = "holds no probabilities"
            raise InputError(what, where=str(state / "p_static.npy"), hint=HINT)


def _inconsistent(folder: Path) -> InputError:
    what = "is damaged or was changed by hand: its arrays do not belong together"
    return InputError(what, where=str(folder), hint=HINT)
