"""Coordinates of clouds, perhaps those of a country: their common origin, and hits to write."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import finite_rows
from stillmap.core.recording import Recording
from stillmap.io.rigid_transforms import MAX_TRANSLATION, embed_in_3d

_BLOCK = 1 << 20  # beams transformed at once
_MAX_COORDINATE = 4096.0  # m: float32 resolves half a millimetre up to there


class Origin:
    """Common origin of all clouds of a recording, so that float32 coordinates stay precise.

    Unless `position` (3,) is given: zero where the first block of points is near the origin, else
    its median, rounded to metres.
    """

    def __init__(self, position: NDArray[np.float64] | None = None) -> None:
        self.position = position

    def shift(self, points: NDArray[Any]) -> NDArray[np.float32]:
        """(n, 3) points relative to the origin, of recorded points (n, 3) in metres."""
        points = np.asarray(points, np.float64)
        if self.position is None:
            self.position = _find_origin(points)
        with np.errstate(over="ignore"):
            return (points - (0.0 if self.position is None else self.position)).astype(np.float32)

    def place(self, recording: Recording) -> None:
        """Let the recorded poses of scans whose points were shifted say so, in place: they are the
        scans without a rotation and a position, beside others that have them."""
        T = recording.T_recorded_base
        if T is not None and self.position is not None:
            is_unplaced = np.equal(T, np.eye(4)).all(axis=(1, 2))
            T[is_unplaced, :3, 3] = self.position

    def add_notes(self, recording: Recording, *, in_sensor_frame: bool = False) -> None:
        """Note the origin in the source of a recording, and warn that the sensor is assumed there;
        neither where points are `in_sensor_frame` and near its origin."""
        if self.position is not None and np.any(self.position != 0.0):
            recording.source.origin = tuple(self.position.tolist())
            at = " ".join(f"{value:.0f}" for value in self.position)
            at = f"{at}, the new origin"
        elif in_sensor_frame:
            return
        else:
            at = "the origin"
        recording.source.warnings.append(f"no sensor pose is recorded: beams start at {at}")


def cloud_origin(recording: Recording) -> NDArray[np.float64]:
    """(3,) metres by which the coordinates of a recording's clouds were shifted in reading."""
    noted = recording.source.origin if recording.dimension == 3 else None
    origin = np.array(noted or (0.0, 0.0, 0.0))
    return origin if (np.abs(origin) < MAX_TRANSLATION).all() else np.zeros(3)


def place_clouds(
    recording: Recording, poses: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """Poses (T, D+1, D+1) for writing; None: there are none, and the coordinates are as they were.

    Args:
        recording: T scans.
        poses: as the recording has them; None: there are none.
    """
    origin = cloud_origin(recording)
    if not origin.any() or recording.T_recorded_base is not None:
        return poses
    if poses is None:
        poses = np.tile(np.eye(4), (recording.n_scans, 1, 1))
    placed = np.array(poses)
    placed[:, :3, 3] += origin
    return placed


def _find_origin(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    finite = points[finite_rows(points)]
    if not len(finite):
        return None
    # column by column: np.median(axis=0) takes several times as long
    middle = np.array([np.median(column) for column in finite.T])
    return np.round(middle) if np.abs(middle).max() > _MAX_COORDINATE else np.zeros(3)


def sensor_poses(
    recording: Recording, T_map_base: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """(T, 4, 4) sensor poses of robot poses (T, D+1, D+1), for writing; see `place_clouds`."""
    T = place_clouds(recording, T_map_base)
    return None if T is None else embed_in_3d(recording.T_map_sensor(T))


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
