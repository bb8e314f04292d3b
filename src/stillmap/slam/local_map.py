"""The local map that 2D scans are matched against, and keyframes along a trajectory."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam.scan_hits import add_scan

SCAN_SPACING = 0.2  # m or rad between scans that are added to a map; 5 s count as 1 m
SPACING_PER_SECOND = 0.2
KEYFRAME_ANGLE = 0.5  # rad between keyframes


def is_spaced(T_last: Float, T_map_base: Float, step_ns: int) -> bool:
    """True if a scan at a pose (3, 3) shows enough that is new after the last one."""
    x, y, theta = se2.parameters(se2.inverse(T_last) @ T_map_base)
    seconds = 1e-9 * float(step_ns)
    return bool(np.hypot(x, y) + abs(theta) + SPACING_PER_SECOND * seconds >= SCAN_SPACING)


class LocalMap:
    """A map of spaced scans along the last stretch of travel.

    Args:
        grid: the sums; only this class may change it.
        recording: 2D.
        e: (M,) P(static) of every beam.
    """

    def __init__(self, grid: _core.OccupancyGrid2D, recording: Recording, e: Float32) -> None:
        self.grid = grid
        self._recording, self._e = recording, e
        self._kept: deque[tuple[int, Float, float]] = deque()  # scan, pose, m travelled

    def add(self, t: int, T_map_base: Float, travelled: float) -> None:
        """Adds scan t at a pose (3, 3), unless it is too close to the last one of its sensor."""
        if self._is_spaced(t, T_map_base):
            add_scan(self.grid, self._recording, self._e, t, T_map_base)
            self._kept.append((t, T_map_base, travelled))

    def clear(self) -> None:
        """Begins anew with an empty map."""
        self.grid = type(self.grid)(self.grid.resolution, self.grid.approach)
        self._kept.clear()

    def has_sensor(self, sensor: int) -> bool:
        """True if it holds a scan of a sensor."""
        return self._last_of(sensor) is not None

    def remove_before(self, travelled: float) -> None:
        """Removes the scans taken before that many metres of travel."""
        while self._kept and self._kept[0][2] < travelled:
            t, T_map_base, _ = self._kept.popleft()
            add_scan(self.grid, self._recording, self._e, t, T_map_base, remove=True)

    def _is_spaced(self, t: int, T_map_base: Float) -> bool:
        kept = self._last_of(self._recording.sensor[t])
        if kept is None:
            return True
        last, T_last, _ = kept
        stamps = self._recording.stamp_ns
        return is_spaced(T_last, T_map_base, stamps[t] - stamps[last])

    def _last_of(self, sensor: int) -> tuple[int, Float, float] | None:
        of_sensor = (
            kept for kept in reversed(self._kept) if self._recording.sensor[kept[0]] == sensor
        )
        return next(of_sensor, None)


def travelled_distance(poses: Float) -> Float:
    """(T,) m of travel up to each of the poses (T, D+1, D+1)."""
    return np.concatenate([[0.0], _step_lengths(poses).cumsum()])


def select_keyframes(
    poses: Float, distance: float, angle: float, breaks: Sequence[int] = ()
) -> Index:
    """(K,) scans about `distance` m or `angle` rad apart.

    Includes the first and the last scan, and those before and after each break.
    """
    kept, since = [0], 0.0
    for t, step in enumerate(_step_lengths(poses) / distance + _turns(poses) / angle, start=1):
        since += step
        if since >= 1.0:
            kept.append(t)
            since = 0.0
    if kept[-1] != len(poses) - 1:
        kept.append(len(poses) - 1)
    beside = [t + side for t in breaks for side in (-1, 0)]
    return np.unique(np.array([*kept, *beside], np.intp))


def select_keyframes_per_sensor(
    poses: Float, sensor: NDArray[np.integer], distance: float, angle: float
) -> Index:
    """(K,) keyframes selected from the scans of each sensor (T,) separately."""
    of_each = [np.flatnonzero(sensor == s) for s in np.unique(sensor)]
    return np.sort(
        np.concatenate(
            [scans[select_keyframes(poses[scans], distance, angle)] for scans in of_each]
        )
    )


def _step_lengths(poses: Float) -> Float:
    """(T-1,) m between successive poses."""
    lengths: Float = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    return lengths


def _turns(poses: Float) -> Float:
    """(T-1,) rad between successive poses."""
    if poses.shape[-1] == 3:
        return np.abs(se2.wrap(np.diff(se2.parameters(poses)[:, 2])))
    steps = se3.log_rotation(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    turns: Float = np.linalg.norm(steps, axis=-1)
    return turns


def propagate_corrections(poses: Float, keyframes: Index, corrected: Float) -> Float:
    """(T, D+1, D+1) all poses after the keyframes (K,) among them moved to (K, D+1, D+1).

    The corrections of the two keyframes around a scan are blended by travel, then by time.
    """
    if len(keyframes) < 2:
        return poses
    at = travelled_distance(poses) + 1e-6 * np.arange(len(poses))
    right = np.clip(np.searchsorted(keyframes, np.arange(len(poses))), 1, len(keyframes) - 1)
    left = right - 1
    span = at[keyframes[right]] - at[keyframes[left]]
    share = ((at - at[keyframes[left]]) / span)[:, None]
    correction = corrected @ se2.inverse(poses[keyframes])
    one, other = correction[left] @ poses, correction[right] @ poses
    if poses.shape[-1] == 4:
        return se3.normalize(one @ se3.exp(share * se3.log(se2.inverse(one) @ other)))
    x = se2.parameters(one)
    difference = se2.parameters(other) - x
    difference[:, 2] = se2.wrap(difference[:, 2])
    return se2.matrix(*(x + share * difference).T)
