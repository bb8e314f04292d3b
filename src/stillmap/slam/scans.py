"""Single scans of a recording, into a map and out of it again."""

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Points = NDArray[np.float32]


def put(
    grid: _core.Grid2D,
    recording: Recording,
    e: NDArray[np.float32],
    t: int,
    T_map_base: Float,
    remove: bool = False,
) -> None:
    """Adds scan t at a pose (3, 3) to the sums of (10), or takes it out again."""
    beams = recording.beams_of(t)
    hit = recording.hit[beams]
    T_map_sensor = T_map_base @ recording.T_base_sensor[recording.sensor[t]]
    offset = np.array([0, len(hit)])
    _core.add_beams(
        grid, recording.points[beams], hit, e[beams], offset, T_map_sensor[None], remove=remove
    )


def hits(
    recording: Recording, e: NDArray[np.float32], t: int
) -> tuple[Points, NDArray[np.float32]]:
    """End points (N, 2) of scan t in the frame of the robot base, and their e (N,)."""
    beams = recording.beams_of(t)
    hit = recording.hit[beams]
    T_base_sensor = recording.T_base_sensor[recording.sensor[t]]
    return in_frame(recording.points[beams][hit], T_base_sensor), e[beams][hit]


def in_frame(points: Points, T: Float) -> Points:
    """Points (N, D) float32 carried over by a transform (D+1, D+1)."""
    return np.ascontiguousarray(points @ T[:-1, :-1].T + T[:-1, -1], dtype=np.float32)
