"""Observations that update the labels: hits of a scan, and free space along its beams."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.live.scan import ScanBeams
from stillmap.slam import scan_hits

Float = NDArray[np.float64]

_MAX_REGISTERED = 600  # end points of a scan that are registered
# scans of a planar laser in a time bin in which each beam is followed; in others only its end
# counts
_FOLLOWED, _MAX_STRIDE, _RATE_GAIN = 3.0, 8, 0.1
_MARGIN, _MAX_MARGIN = 0.1, 1.0  # m behind a surface where a beam has passed it; at grazing angles


def select_hits(beams: ScanBeams) -> scan_hits.Scan:
    """The hits of a scan in the base frame with weight 1, and the normals of their surfaces."""
    points = scan_hits.transform_points(beams.points[beams.hit], beams.T_base_sensor)
    return scan_hits.make_scan(points, np.ones(len(points), np.float32), beams.T_base_sensor)


def thin(hits: scan_hits.Scan) -> scan_hits.Scan:
    """Hits for registration: more than so many say no more."""
    every = slice(None, None, max(-(-len(hits.points) // _MAX_REGISTERED), 1))
    points, weights, normals, isotropy = (
        np.ascontiguousarray(a[every])
        for a in (hits.points, hits.weights, hits.normals, hits.isotropy)
    )
    return scan_hits.Scan(points, weights, hits.T_base_sensor, normals, isotropy)


def normals_of(beams: ScanBeams, hits: scan_hits.Scan) -> Float:
    """(N, D) normals in the sensor frame; 0 where nothing was hit."""
    out = np.zeros(beams.points.shape)
    out[beams.hit] = hits.normals @ beams.T_base_sensor[:2, :2]  # rotated back
    return out


@dataclass(frozen=True, eq=False)
class Observation(ShortRepr):
    """A scan as the labels take it.

    Attributes:
        beams: of the scan, as if all had been taken at its stamp.
        margin: (N,) float32, m before the end of each beam that it has not passed; inf: only its
            end counts. In 3D None: it follows from the beams around.
        tag: number of the keyframe by which cells move when the map is corrected.
    """

    beams: ScanBeams
    margin: NDArray[np.float32] | None
    tag: int = 0


class BeamSelector:
    """Selects the beams of planar scans that are followed: fast sensors see the same several times
    in a time bin.

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
        scans = self._bin_ns / (_FOLLOWED * max(rate.period_ns, 1.0))
        stride = int(np.clip(scans, 1, _MAX_STRIDE))
        return np.asarray((np.arange(len(beams.points)) + rate.count) % stride == 0)


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


def find_margins(
    beams: ScanBeams, normals: Float, followed: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """(N,) margins of the beams of a planar scan, see `Observation`.

    Args:
        beams: of the scan.
        normals: (N, 2) of the surfaces that were hit, in the sensor frame; 0: unknown.
        followed: (N,) beams that show free space.
    """
    margin = np.full(len(beams.points), np.inf, np.float32)
    points = np.where(beams.hit[followed, None], beams.points[followed], 0.0)
    length = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    normals = normals[followed]
    cos = np.abs(np.einsum("nd,nd->n", points, normals)) / length
    cos[(normals[:, 0] == 0.0) & (normals[:, 1] == 0.0)] = 1.0
    margin[followed] = np.minimum(_MARGIN / np.maximum(cos, 1e-3), _MAX_MARGIN)
    return margin
