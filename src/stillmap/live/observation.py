"""What a scan adds to the map: its hits, and the beams that are followed through free space."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.short_repr import ShortRepr
from stillmap.live.scan import ScanBeams, take_beams

Float = NDArray[np.float64]

# scans of a planar laser in a time bin in which each beam is followed; in others only its end
# counts
_FOLLOWED, _MAX_STRIDE, _RATE_GAIN = 3.0, 8, 0.1
_MAX_FOLLOWED = 8000  # beams of a sweep in 3D
_FOLLOWED_RANGE = 60.0  # m up to which beams of a sweep are followed


@dataclass(frozen=True, eq=False)
class Observation(ShortRepr):
    """A scan as the labels take it.

    Attributes:
        beams: of the scan, as if all had been taken at its stamp; in 3D one hit for each voxel.
        followed: (N,) bool, beams that show free space up to their end.
        normals: (N, D) of the surfaces that were hit, in the sensor frame; 0: unknown.
        tag: number of the keyframe by which cells move when the map is corrected.
    """

    beams: ScanBeams
    followed: NDArray[np.bool_]
    normals: Float
    tag: int = 0


def thin_to_voxels(beams: ScanBeams, edge: float) -> ScanBeams:
    """The first hit in each voxel of a 3D scan."""
    kept = _core.voxel_downsample(beams.points, beams.hit.astype(np.float32), edge)
    return take_beams(beams, kept)


class BeamSelector:
    """Selects the beams that are followed: fast sensors see the same several times in a time bin.

    Args:
        bin_seconds: length of a time bin.
    """

    def __init__(self, bin_seconds: float) -> None:
        self._bin_ns = 1e9 * bin_seconds
        self._rates = dict[str | int, _ScanRate]()

    def select(self, beams: ScanBeams) -> NDArray[np.bool_]:
        """(N,) beams to follow, others in every scan."""
        rate = self._rates.setdefault(beams.sensor, _ScanRate())
        rate.update(beams.stamp_ns)
        number = np.arange(len(beams.points))
        if beams.dimension == 2:
            stride = self._bin_ns / (_FOLLOWED * max(rate.period_ns, 1.0))
            return (number + rate.count) % int(np.clip(stride, 1, _MAX_STRIDE)) == 0
        # squares of coordinates that are not finite compare as false
        near = np.einsum("nd,nd->n", beams.points, beams.points) <= _FOLLOWED_RANGE**2
        rank = np.cumsum(near)
        return near & ((rank + rate.count) % max(-(-int(rank[-1:].sum()) // _MAX_FOLLOWED), 1) == 0)


@dataclass
class _ScanRate:
    """Running mean of the nanoseconds between the scans of a sensor, and their number."""

    period_ns: float = np.inf
    count: int = 0
    last_ns: int = 0

    def update(self, stamp_ns: int) -> None:
        step = float(stamp_ns - self.last_ns)
        if self.count == 1:
            self.period_ns = step
        elif self.count > 1:
            self.period_ns += _RATE_GAIN * (step - self.period_ns)
        self.count, self.last_ns = self.count + 1, stamp_ns
