"""The map of the last stretch of travel, which scans are registered against as they come.

Keyframes along the way, and how what is found out about them spreads to the other scans.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.recording import Recording
from stillmap.slam.scan_matching import SurfaceOptions, add_scan

Float = NDArray[np.float64]

Index = NDArray[np.intp]


class LocalMap:
    """Scans that lie a little apart, as long as the robot has not gone on too far."""

    def __init__(
        self,
        grid: _core.OccupancyGrid2D,
        recording: Recording,
        e: NDArray[np.float32],
        spacing: float,
        surface: SurfaceOptions,
    ) -> None:
        """An empty one.

        Args:
            grid: where the sums go; nobody else may change it.
            recording: 2D.
            e: (M,) probability that each beam was reflected by something static.
            spacing: metres or radians between scans that are kept; 5 s count as one of them.
            surface: how gaps are filled.
        """
        self.grid = grid
        self._recording, self._e, self._spacing = recording, e, spacing
        self._surface = surface
        self._kept: deque[tuple[int, Float, float]] = deque()  # scan, pose, metres travelled

    def add(self, t: int, T_map_base: Float, travelled: float) -> None:
        """Scan t at a pose (3, 3), unless the last one of its sensor shows the same."""
        if not self._is_apart(t, T_map_base):
            return
        add_scan(self.grid, self._recording, self._e, t, T_map_base, self._surface)
        self._kept.append((t, T_map_base, travelled))

    def has(self, sensor: int) -> bool:
        """Whether there is a scan of a sensor in it."""
        return self._last_of(sensor) is not None

    def forget(self, travelled: float) -> None:
        """Takes out what was seen before the robot had come that many metres."""
        while self._kept and self._kept[0][2] < travelled:
            t, T_map_base, _ = self._kept.popleft()
            add_scan(self.grid, self._recording, self._e, t, T_map_base, self._surface, remove=True)

    def forget_since(self, t: int) -> None:
        """Takes out scan t and what came after it."""
        while self._kept and self._kept[-1][0] >= t:
            last, T_map_base, _ = self._kept.pop()
            add_scan(
                self.grid, self._recording, self._e, last, T_map_base, self._surface, remove=True
            )

    def _is_apart(self, t: int, T_map_base: Float) -> bool:
        kept = self._last_of(self._recording.sensor[t])
        if kept is None:
            return True
        last, T_last, _ = kept
        x, y, theta = se2.parameters(se2.inverse(T_last) @ T_map_base)
        seconds = 1e-9 * float(self._recording.stamp_ns[t] - self._recording.stamp_ns[last])
        return float(np.hypot(x, y) + abs(theta) + 0.2 * seconds) >= self._spacing

    def _last_of(self, sensor: int) -> tuple[int, Float, float] | None:
        of_sensor = (
            kept for kept in reversed(self._kept) if self._recording.sensor[kept[0]] == sensor
        )
        return next(of_sensor, None)


def travelled_distance(poses: Float) -> Float:
    """(T,) metres travelled up to each of the poses (T, D+1, D+1)."""
    steps = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    return np.concatenate([[0.0], steps.cumsum()])


def select_keyframes(
    poses: Float, distance: float, turn: float, breaks: Sequence[int] = ()
) -> Index:
    """(K,) indices of scans about `distance` metres or `turn` radians apart.

    The first and the last one are among them, and those before and after each of the breaks.
    """
    metres = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    kept, since = [0], 0.0
    for t, step in enumerate(metres / distance + _turns(poses) / turn, start=1):
        since += step
        if since >= 1.0:
            kept.append(t)
            since = 0.0
    if kept[-1] != len(poses) - 1:
        kept.append(len(poses) - 1)
    beside = [t + side for t in breaks for side in (-1, 0)]
    return np.unique(np.array([*kept, *beside], np.intp))


def _turns(poses: Float) -> Float:
    """(T-1,) radians from each pose to the next one."""
    if poses.shape[-1] == 3:
        return np.abs(se2.wrap(np.diff(se2.parameters(poses)[:, 2])))
    steps = se3.log_rotation(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    turns: Float = np.linalg.norm(steps, axis=-1)
    return turns


def select_keyframes_per_sensor(
    poses: Float, sensor: NDArray[np.integer], distance: float, turn: float
) -> Index:
    """(K,) indices of scans chosen from those of each sensor (T,): each may see its own side."""
    of_each = [np.flatnonzero(sensor == s) for s in np.unique(sensor)]
    return np.sort(
        np.concatenate([scans[select_keyframes(poses[scans], distance, turn)] for scans in of_each])
    )


def propagate_corrections(poses: Float, keyframes: Index, moved: Float) -> Float:
    """(T, D+1, D+1) all poses when the keyframes among them moved to (K, D+1, D+1).

    A scan between two keyframes is carried along by both; how far it is from each, in travel and
    then in time, says how the two are blended.
    """
    if len(keyframes) < 2:
        return poses
    at = travelled_distance(poses) + 1e-6 * np.arange(len(poses))
    right = np.clip(np.searchsorted(keyframes, np.arange(len(poses))), 1, len(keyframes) - 1)
    left = right - 1
    span = at[keyframes[right]] - at[keyframes[left]]
    share = ((at - at[keyframes[left]]) / span)[:, None]
    correction = moved @ se2.inverse(poses[keyframes])
    one, other = correction[left] @ poses, correction[right] @ poses
    if poses.shape[-1] == 4:
        return se3.normalize(one @ se3.exp(share * se3.log(se2.inverse(one) @ other)))
    x = se2.parameters(one)
    difference = se2.parameters(other) - x
    difference[:, 2] = se2.wrap(difference[:, 2])
    return se2.matrix(*(x + share * difference).T)
