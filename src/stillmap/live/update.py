"""Result of one scan: pose, labels, doubts, changed map tiles."""

from dataclasses import dataclass, field
from types import MappingProxyType

from stillmap.core.array_types import Float, Float32
from stillmap.core.short_repr import ShortRepr
from stillmap.live.causal_labels import MapChange
from stillmap.live.movers import Mover

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
    p_static: Float32


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
    p_static: Float32
    T_map_odom: Float | None
    doubts: tuple[str, ...] = ()
    changes: list[MapChange] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    hindsight: list[LaterLabels] = field(default_factory=list)
