"""What a place keeps of a session, in `sessions/NAME/state/`: enough to merge further sessions
without its recording."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy
from stillmap.core.errors import InputError
from stillmap.io import stillmap_folder
from stillmap.io.stillmap_folder import read as read_recording
from stillmap.places.beam_cells import BeamCells
from stillmap.places.keyframes import Keyframes
from stillmap.places.session import Session
from stillmap.results.labels import read_array
from stillmap.results.pose_graph_g2o import read_g2o, write_g2o

Float = NDArray[np.float64]

STATE = "state"
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
    poses = read_array(state / "poses.npy", (len(stamp_ns), D + 1, D + 1), "f")
    graph = read_g2o(state / _GRAPH)
    nodes = keyframes.nodes
    if not np.array_equal(keyframes.scans[nodes], graph.keyframes) or len(planar) != K:
        raise _inconsistent(state)
    if graph.poses.shape[-1] != D + 1 or planar.dimension != 2 or graph.keyframes[-1] >= len(poses):
        raise _inconsistent(state)
    clearance = read_array(state / "clearance.npy", (K,), "f")
    return Session(
        folder.name, path, stamp_ns, np.array(poses), graph, keyframes, planar, clearance
    )


def _read_keyframes(folder: Path) -> Keyframes:
    recording = read_recording(folder)
    K, D = recording.n_scans, recording.dimension
    scans = np.array(read_array(folder / "scans.npy", (K,), "i"), np.intp)
    poses = np.array(read_array(folder / "poses.npy", (K, D + 1, D + 1), "f"), np.float64)
    e = read_array(folder / "e.npy", (recording.n_beams,), "f")
    nodes = np.array(read_array(folder / "nodes.npy", (None,), "i"), np.intp)
    if not K or not len(nodes) or np.any(np.diff(scans) <= 0) or np.any(np.diff(nodes) <= 0):
        raise _inconsistent(folder)
    if nodes[0] < 0 or nodes[-1] >= K or scans[0] < 0 or not np.isfinite(poses).all():
        raise _inconsistent(folder)
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
    return BeamCells(
        cells,
        read_array(state / "cell_node.npy", (len(cells),), "i"),
        read_array(state / "beam_cell.npy", (n_beams,), "i"),
        read_array(state / "p_static.npy", (n_beams,), "f"),
        resolution,
    )


def _inconsistent(folder: Path) -> InputError:
    what = "is damaged or was changed by hand: its arrays do not belong together"
    return InputError(what, where=str(folder), hint="merge the sessions anew")
