"""Relabel the beams and map cells of changed places."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core import arrays
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording
from stillmap.mapping.change_detection import Change

Float = NDArray[np.float64]
Labels = NDArray[np.float32]


def relabel_changes(
    recording: Recording,
    poses: Float,
    p_static: Labels,
    occupied: em.CellProbabilities,
    histories: em.CellHistories,
    changes: list[Change],
    state: em.MapState,
    threads: int = 1,
) -> tuple[Labels, em.CellProbabilities]:
    """Labels (M,) and map cells, taken from the cell histories within the listed changes.

    There p_static of a beam is the probability that the map in this state shows the object that
    reflected it. Changes of cells that are not listed are noise.

    Args:
        recording: M beams.
        poses: (T, 3, 3) T_map_base.
        p_static, occupied, histories: from the final E-step at these poses.
        changes: from `detect_changes`.
        state: state of changed places that the map shows.
        threads: number of threads; the result does not depend on it.
    """
    if not changes:
        return p_static, occupied
    if not np.array_equal(occupied.cells, histories.cells):
        raise ValueError("occupied: expected the cells of the final E-step")
    listed = np.isin(_keys(histories.cells), _keys(np.concatenate([one.cells for one in changes])))
    p_in_map, out = histories.p_in_map(state), arrays.copy(p_static, recording.scratch)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording, release=[out]):
        surfel = histories.surfel_map.associate_beams(
            recording.points[beams], recording.hit[beams], offset, T_map_sensor[scans], threads
        )
        ended = np.flatnonzero(surfel >= 0)
        ended = ended[listed[surfel[ended]]]
        out[beams][ended] = p_in_map[surfel[ended]]
    p_occupied = np.where(listed, p_in_map * histories.p_in_cell, occupied.p_occupied)
    return out, dataclasses.replace(occupied, p_occupied=p_occupied)


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) one key per cell (N, 2); map coordinates stay far below 2 ** 31 cells."""
    return np.asarray((cells[:, 0] << 32) + cells[:, 1], np.int64)
