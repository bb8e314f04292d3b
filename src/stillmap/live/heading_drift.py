"""The drift of the heading while the robot maps, measured by the directions of the walls so far."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.slam.heading_alignment import DirectionDensity, Directions, HeadingOffset
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]

_KERNEL = np.radians(1.0)  # std of the normals about the direction of a wall
_MIN_TRAVEL = 8.0  # m after which directions are known
# normals of one wall share their errors: evidence of each; std of a building's walls about its
# directions, rad, which one metre of travel shows once
_EVIDENCE, _MIN_STD = 0.1, np.radians(0.3)


class WallDirections:
    """Directions of the walls so far, weighted by travel."""

    def __init__(self) -> None:
        self._seen, self._travelled = Directions(), 0.0

    def add(self, scan: Scan, T: Float, metres: float) -> None:
        """Add the normals of a scan at a pose (3, 3), `metres` after the last one."""
        directions = Directions.of_scan(scan, float(se2.parameters(T)[2]))
        self._seen.weights += min(metres, 1.0) * directions.weights
        self._travelled += min(metres, 1.0)

    def rotate(self, angle: float) -> None:
        """Rotate the frame, in which directions are, by `angle` rad."""
        self._seen = self._seen.rotate(angle)

    def measure(self, scan: Scan, T: Float) -> HeadingOffset | None:
        """Correction of the heading of a scan at a pose T (3, 3); None: it is not defined."""
        if self._travelled < _MIN_TRAVEL or not self._seen.weights.any():
            return None
        density = DirectionDensity(self._seen, _KERNEL)
        directions = Directions.of_scan(scan, float(se2.parameters(T)[2]))
        offset = density.measure(directions, _EVIDENCE)
        if offset is None:
            return None
        return offset._replace(variance=max(offset.variance, _MIN_STD**2))


def correct_heading(T: Float, covariance: Float, offset: HeadingOffset) -> Float:
    """A pose (3, 3) with covariance (3, 3) after a Kalman update by its heading's offset."""
    gain = covariance[:, 2] / (covariance[2, 2] + offset.variance)
    out: Float = se2.matrix(*(se2.parameters(T) + offset.value * gain))
    return out
