"""The map of the last stretch of travel, which scans are registered against as they come."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.recording.model import Recording
from stillmap.slam.scans import SurfaceOptions, put

Float = NDArray[np.float64]


class LocalMap:
    """Scans that lie a little apart, as long as the robot has not gone on too far."""

    def __init__(
        self,
        grid: _core.Grid2D,
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
        put(self.grid, self._recording, self._e, t, T_map_base, self._surface)
        self._kept.append((t, T_map_base, travelled))

    def has(self, sensor: int) -> bool:
        """Whether there is a scan of a sensor in it."""
        return self._last_of(sensor) is not None

    def forget(self, travelled: float) -> None:
        """Takes out what was seen before the robot had come that many metres."""
        while self._kept and self._kept[0][2] < travelled:
            t, T_map_base, _ = self._kept.popleft()
            put(self.grid, self._recording, self._e, t, T_map_base, self._surface, remove=True)

    def forget_since(self, t: int) -> None:
        """Takes out scan t and what came after it."""
        while self._kept and self._kept[-1][0] >= t:
            last, T_map_base, _ = self._kept.pop()
            put(self.grid, self._recording, self._e, last, T_map_base, self._surface, remove=True)

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
