"""Single scans of a recording, into a map and out of it again."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.options import field_with_doc
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Points = NDArray[np.float32]


@dataclass(frozen=True)
class SurfaceOptions:
    """Gaps between end points on one surface, which are filled before scans are laid on them."""

    gap: float = field_with_doc(1.5, "m between neighbouring end points on a surface, at most")
    straight: float = field_with_doc(0.1, "m by which three of them may be off a straight line")
    growth: float = field_with_doc(3.0, "times the gap beside it that a gap may be wide")

    def __post_init__(self) -> None:
        for name in ("gap", "straight", "growth"):
            if not 0.0 <= getattr(self, name) <= 1000.0:
                raise ValueError(f"'slam.surface.{name}' wants 0 to 1000")


def put(
    grid: _core.Grid2D,
    recording: Recording,
    e: NDArray[np.float32],
    t: int,
    T_map_base: Float,
    options: SurfaceOptions,
    remove: bool = False,
) -> None:
    """Adds the hits of scan t at a pose (3, 3) to a map to register against, or takes them out.

    What returned nothing may have met glass as well as nothing: it says little against a surface.
    """
    beams = recording.beams_of(t)
    points, hit, weights = recording.points[beams], recording.hit[beams], e[beams]
    T_map_sensor = (T_map_base @ recording.T_base_sensor[recording.sensor[t]])[None]
    all_hit, offset = hit[hit], np.array([0, np.count_nonzero(hit)])
    _core.add_beams(grid, points[hit], all_hit, weights[hit], offset, T_map_sensor, remove=remove)
    _core.fill_surfaces(
        grid,
        points,
        hit,
        weights,
        np.array([0, len(hit)]),
        T_map_sensor,
        gap=options.gap,
        tolerance=options.straight,
        growth=options.growth,
        remove=remove,
    )


@dataclass(frozen=True, eq=False)
class Scan:
    """The hits of a scan, or of several.

    Attributes:
        points: (N, 2) float32, end points in the frame of the robot base.
        weights: (N,) float32, e: how probable it is that each was static.
        T_base_sensor: (3, 3) where the beams begin.
    """

    points: Points
    weights: NDArray[np.float32]
    T_base_sensor: Float


def hits(recording: Recording, e: NDArray[np.float32], t: int) -> Scan:
    """The hits of scan t."""
    beams = recording.beams_of(t)
    hit = recording.hit[beams]
    T_base_sensor = recording.T_base_sensor[recording.sensor[t]]
    points = in_frame(recording.points[beams][hit], T_base_sensor)
    return Scan(points, e[beams][hit], T_base_sensor)


def in_frame(points: Points, T: Float) -> Points:
    """Points (N, D) float32 carried over by a transform (D+1, D+1)."""
    return np.ascontiguousarray(points @ T[:-1, :-1].T + T[:-1, -1], dtype=np.float32)
