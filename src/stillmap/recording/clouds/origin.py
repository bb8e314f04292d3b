"""Clouds without a place of their sensor, maybe far from the origin of their coordinates."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.spool import Column

_NEAR = 4096.0  # m: so far single precision resolves half a millimetre
NO_SENSOR = "the file tells no place of a sensor: beams count as sent from the origin"


class Origin:
    """Where points are counted from, the same for all clouds of a recording.

    Points near the origin of their coordinates stay where they are. Others are moved by whole
    metres, found from the first block of points that is seen, unless `at` (3,) is given.
    """

    def __init__(self, at: NDArray[np.float64] | None = None) -> None:
        self.at = at

    def moved(self, points: NDArray[Any]) -> NDArray[np.float32]:
        """(n, 3) as seen from here, of points (n, 3) in metres as recorded."""
        points = np.asarray(points, np.float64)
        if self.at is None:
            self.at = _origin_of(points)
        with np.errstate(over="ignore"):
            return (points - (0.0 if self.at is None else self.at)).astype(np.float32)

    def notes(self) -> dict[str, Any]:
        """For Recording.source; known after the first cloud."""
        moved = self.at is not None and bool(np.any(self.at != 0.0))
        return {"origin": [float(v) for v in self.at]} if moved and self.at is not None else {}

    def warnings(self) -> list[str]:
        """What was assumed."""
        place = self.notes().get("origin")
        if place is None:
            return [NO_SENSOR]
        at = " ".join(f"{value:.0f}" for value in place)
        return [f"the file tells no place of a sensor: beams count as sent from {at}, the new zero"]


def _origin_of(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return None
    middle = np.median(finite, axis=0)
    return np.round(middle) if np.abs(middle).max() > _NEAR else np.zeros(3)


class Growing:
    """(n, 3) points that come in blocks; in a file where they are many."""

    def __init__(self, origin: Origin, scratch: Path | None) -> None:
        self._origin = origin
        self._points = Column(np.float32, (3,), scratch)

    def add(self, points: NDArray[Any]) -> None:
        self._points.append(self._origin.moved(points))

    def finished(self) -> NDArray[np.float32]:
        return self._points.finished()
