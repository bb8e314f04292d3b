"""Labels and map where a place is known to have changed; elsewhere they stay what they were."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.em.observations import iter_chunks
from stillmap.mapping.change_detection import Change

Float = NDArray[np.float64]
Labels = NDArray[np.float32]


def relabel_changes(
    recording: Recording,
    poses: Float,
    p_static: Labels,
    occupied: em.CellProbabilities,
    courses: em.CellHistories,
    changes: list[Change],
    state: em.MapState,
    threads: int = 1,
) -> tuple[Labels, em.CellProbabilities]:
    """(M,) labels and the cells of the map: in the cells of the changes those of their courses.

    A beam's p_static is the probability that the map in this state shows what it met. Few cells
    change. What looks like a change without being listed as one is noise.

    Args:
        recording: M beams.
        poses: (T, 3, 3) T_map_base.
        p_static, occupied, courses: from the last E-step at these poses.
        changes: from `changed_places`.
        state: which state of places that changed is the map's.
        threads: same result with any number.
    """
    if not changes:
        return p_static, occupied
    if not np.array_equal(occupied.cells, courses.cells):
        raise ValueError("occupied: expected the cells of the last E-step")
    listed = np.isin(_keys(courses.cells), _keys(np.concatenate([one.cells for one in changes])))
    shown, out, T_map_sensor = (
        courses.p_in_map(state),
        arrays.copy(p_static, recording.scratch),
        recording.T_map_sensor(poses),
    )
    for scans, beams, offset in iter_chunks(recording, release=[out]):
        element = courses.surfel_map.elements_of(
            recording.points[beams], recording.hit[beams], offset, T_map_sensor[scans], threads
        )
        ended = np.flatnonzero(element >= 0)
        ended = ended[listed[element[ended]]]
        out[beams][ended] = shown[element[ended]]
    p_occupied = np.where(listed, shown * courses.p_in_cell, occupied.p_occupied)
    return out, dataclasses.replace(occupied, p_occupied=p_occupied)


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) one number for each cell (N, 2); map coordinates stay far below 2 ** 31 cells."""
    return np.asarray((cells[:, 0] << 32) + cells[:, 1], np.int64)
