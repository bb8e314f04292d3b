"""Result of one scan: pose, labels, doubts, changed map tiles."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr
from stillmap.live.causal_labels import MapChange
from stillmap.live.movers import Mover
from stillmap.live.scan import ScanBeams

Float = NDArray[np.float64]

# for people
DOUBTS = MappingProxyType(
    {
        "slip": "odometry disagrees with the scans",
        "blind": "no beam meets anything",
        "carried": "the scans contradict the map",
        "contradicted": "the last scans contradict the map",
        "lost": "the pose in the map is not known",
        "ambiguous": "several places in the map fit",
    }
)


@dataclass(frozen=True, eq=False)
class LaterLabels(ShortRepr):
    """Labels of an earlier scan by what is known now.

    Attributes:
        number: how many scans were pushed before it.
        p_static: (N,) float32 of its beams; NaN: unusable.
    """

    number: int
    p_static: NDArray[np.float32]


class Hindsight:
    """The scans of the last seconds.

    Args:
        lag: s after which they are taken; None: none are kept.
    """

    def __init__(self, lag: float | None) -> None:
        self._lag_ns = None if lag is None else round(1e9 * lag)
        self._scans = deque[tuple[int, ScanBeams]]()

    def add(self, number: int, beams: ScanBeams) -> None:
        """Keep a scan, the number of which is that of scans before it."""
        if self._lag_ns is not None:
            self._scans.append((number, beams))

    def take(self, stamp_ns: int) -> Iterator[tuple[int, ScanBeams]]:
        """The scans that are old enough now, and not taken yet."""
        while self._scans and stamp_ns - self._scans[0][1].stamp_ns >= (self._lag_ns or 0):
            yield self._scans.popleft()


@dataclass(frozen=True, eq=False)
class Update(ShortRepr):
    """Result of pushing one scan.

    Attributes:
        pose: (D+1, D+1) T_map_base.
        covariance: (3, 3) of x, y (map axes) and heading, in 3D (6, 6).
        p_static: (N,) float32 of the beams, from what is known so far; NaN: unusable.
        T_map_odom: (D+1, D+1); None: without odometry.
        doubts: any of "slip" (odometry disagrees with the scans), "blind" (no beam met anything
            that the map knows), "contradicted" (the last scans contradict the map: they are not
            added to it), "carried" (so many do that the robot was carried), "lost" (the pose is
            none in the map), "ambiguous" (several places in it fit about as well).
        changes: parts of the map that changed: with each scan some, so that each is told about once
            a second.
        movers: what moves now, as far as it has been seen to.
        hindsight: earlier scans that are labelled once more, see `LiveMapper(lag=)`.
    """

    pose: Float
    covariance: Float
    p_static: NDArray[np.float32]
    T_map_odom: Float | None
    doubts: tuple[str, ...] = ()
    changes: list[MapChange] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    hindsight: list[LaterLabels] = field(default_factory=list)
