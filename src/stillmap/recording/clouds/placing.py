"""Hits of a recording for writers of clouds: scan by scan, or all in one frame."""

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stillmap.errors import InputError
from stillmap.recording.clouds.rigid import in_space
from stillmap.recording.model import Recording

_Number = TypeVar("_Number", np.float32, np.float64)

_BLOCK = 1 << 20  # beams placed together


def one_sensor(recording: Recording, where: str) -> None:
    """Refuse recordings of several sensors for formats that know of one.

    Raises:
        InputError: there are several.
    """
    n = len(recording.T_base_sensor)
    if n != 1:
        what = f"cannot be written: the recording has {n} sensors, the format one"
        raise InputError(what, where=where)


def sensor_poses(
    recording: Recording, T_map_base: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """(T, 4, 4) of the sensors, of robot poses (T, D+1, D+1); None for none."""
    return None if T_map_base is None else in_space(recording.T_map_sensor(T_map_base))


def hits_of(
    recording: Recording, scan: int
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """(n, 3) hits of a scan in the sensor's frame, and (n,) their times if there are any."""
    beams = recording.beams_of(scan)
    hit = recording.hit[beams]
    times = None if recording.beam_time is None else recording.beam_time[beams][hit]
    return _three(recording.points[beams][hit]), times


def placed(recording: Recording, T_map_base: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """All hits in the map frame, blocks (n, 3) in the recording's order.

    Args:
        recording: of any dimension; the plane lies at height 0.
        T_map_base: (T, D+1, D+1).
    """
    for start in range(0, recording.n_beams, _BLOCK):
        hit = start + np.flatnonzero(recording.hit[start : start + _BLOCK])
        yield _three(recording.end_points(hit, T_map_base))


def _three(points: NDArray[_Number]) -> NDArray[_Number]:
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points), points.dtype)])
