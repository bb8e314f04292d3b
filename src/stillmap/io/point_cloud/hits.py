"""The hits of a recording in 3D, for writers of point clouds."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.rigid_transforms import embed_in_3d

_BLOCK = 1 << 20  # beams transformed at once


def require_single_sensor(recording: Recording, where: str) -> None:
    """Refuse recordings of several sensors, for formats that hold one.

    Raises:
        InputError: there are several sensors.
    """
    n = len(recording.T_base_sensor)
    if n != 1:
        what = f"cannot be written: the recording has {n} sensors, the format holds one"
        raise InputError(what, where=where)


def sensor_poses(
    recording: Recording, T_map_base: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """(T, 4, 4) sensor poses of robot poses (T, D+1, D+1); None for None."""
    return None if T_map_base is None else embed_in_3d(recording.T_map_sensor(T_map_base))


def scan_hits(
    recording: Recording, scan: int
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(n, 3) hits of a scan in the sensor frame, and their times (n,) or None."""
    beams = recording.beams_of(scan)
    hit = recording.hit[beams]
    times = None if recording.beam_time is None else recording.beam_time[beams][hit]
    return _to_3d(recording.points[beams][hit]), times


def iter_map_points(
    recording: Recording, T_map_base: NDArray[np.float64]
) -> Iterator[NDArray[np.float64]]:
    """Yield all hits in the map frame in blocks (n, 3), in recording order.

    Args:
        recording: 2D hits lie at z = 0.
        T_map_base: (T, D+1, D+1).
    """
    for start in range(0, recording.n_beams, _BLOCK):
        hit = start + np.flatnonzero(recording.hit[start : start + _BLOCK])
        yield _to_3d(recording.end_points(hit, T_map_base))


def _to_3d(points: NDArray[Any]) -> NDArray[Any]:
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points), points.dtype)])
