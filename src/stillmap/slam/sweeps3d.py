"""Single sweeps of a recording in space: in the frame of the base, thinned out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Points = NDArray[np.float32]

_COARSER = 1.25  # times the edge of cells, where too many points are left


@dataclass(frozen=True, eq=False)
class Sweep:
    """Hits of a sweep that weigh something.

    Attributes:
        points: (N, 3) float32, metres in the frame of the base at the time of each.
        weights: (N,) float32, e: how probable it is that each was static.
        times: (N,) float32, seconds from the stamp.
    """

    points: Points
    weights: NDArray[np.float32]
    times: NDArray[np.float32]

    def part(self, kept: NDArray[np.int64]) -> "Sweep":
        """Some of them."""
        return Sweep(self.points[kept], self.weights[kept], self.times[kept])

    def at_its_stamp(self, twist: Float) -> Points:
        """(N, 3) float32 as seen from where the base was at the stamp, moving by a twist (6,)."""
        return np.asarray(_core.carried(self.points, self.times, twist))


def sweep_of(
    recording: Recording, e: NDArray[np.float32], t: int, reach: float, edge: float
) -> Sweep:
    """Sweep t within `reach` metres, the first of its hits in each cell of `edge` metres.

    Args:
        recording: 3D.
        e: (M,) probability that each beam was reflected by something static.
    """
    beams = recording.beams_of(t)
    points = np.asarray(recording.points[beams])
    with np.errstate(invalid="ignore"):
        near = np.einsum("ni,ni->n", points, points) <= reach * reach
    weights = np.where(recording.hit[beams] & near, e[beams], np.float32(0.0))
    kept = _core.first_in_cells(points, weights, edge)
    T = recording.T_base_sensor[recording.sensor[t]]
    in_base = (points[kept] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    times = recording.beam_time
    seconds = np.zeros(len(kept), np.float32) if times is None else np.asarray(times[beams])[kept]
    return Sweep(np.ascontiguousarray(in_base), weights[kept], seconds)


def thinned(sweep: Sweep, edge: float, most: int) -> Sweep:
    """The first point in each cell of `edge` metres, or of more where over `most` are left."""
    kept = _core.first_in_cells(sweep.points, sweep.weights, edge)
    while len(kept) > most:
        edge *= _COARSER
        kept = _core.first_in_cells(sweep.points, sweep.weights, edge)
    return sweep.part(kept)
