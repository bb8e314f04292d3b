"""Results of the M-step, and what the parts of loop closure pass to each other."""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import stillmap._core as _core
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.slam import scan_hits
from stillmap.slam.pose_graph import PoseGraph
from stillmap.slam.scan_hits import Scan

if TYPE_CHECKING:
    Grid = _core.OccupancyGrid2D | _core.OccupancyGrid3D
else:
    Grid = Any  # msgspec, which reads checkpoints, knows no union of two such classes
ScanProgress = Callable[[int, int], None]  # scans done, total


@dataclass(frozen=True, eq=False)
class LoopCandidate(ShortRepr):
    """Two scans that may see the same place.

    Attributes:
        earlier, later: scans.
        T: (3, 3) pose of the later scan in the frame of the earlier one, by the current graph.
        drift_distance: m of travel whose drift equals the uncertainty of T.
        blind_std: m and rad, standard deviations of the drift where scans said nothing.
    """

    earlier: int
    later: int
    T: Float
    drift_distance: float
    blind_std: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class LoopClosure(ShortRepr):
    """One attempt to close a loop.

    Attributes:
        earlier, later: scans that see the same place.
        T: (D+1, D+1) pose of the later scan in the frame of the earlier one.
        covariance: (3, 3) of x, y, heading in the frame of the later scan; in 3D (6, 6).
        explained: share of the comparable beams of the later scan that the earlier map explains.
        rejected: reason of the rejection; empty if accepted.
        comparable: share of the later scan that the earlier map observed from the same side.
        score: in 2D, nats by which both are more likely to see the same place than two alike.
    """

    earlier: int
    later: int
    T: Float
    covariance: Float
    explained: float
    rejected: str = ""
    comparable: float = 1.0
    score: float = 1.0

    def reject(self, reason: str) -> "LoopClosure":
        """The same closure, rejected."""
        return dataclasses.replace(self, rejected=reason)


class BareStretch(NamedTuple):
    """A stretch whose length the scans do not show.

    Attributes:
        first, last: its scans.
        metres: of travel, as estimated.
        std: of that length, m.
    """

    first: int
    last: int
    metres: float
    std: float


@dataclass(frozen=True)
class Diagnostics(ShortRepr):
    """Scans at which odometry and scan matching disagree.

    Attributes:
        widened: matched only by a wider search.
        odometry_faults: odometry was rejected.
        possible_faults: that odometry failed is as likely, but for its rarity.
        breaks: first scans after the robot was carried elsewhere; before loop closure, those
            before which it may have been.
        segments: first scans of all segments that were placed, those that follow by odometry too.
        ambiguous: first scans of segments that contradict the map where they lie, and fit
            nowhere else.
        bare_stretches: whose length the scans do not show, and no accepted loop measures.
        follows_odometry: scan matching makes a less likely map than odometry.
    """

    widened: list[int] = field(default_factory=list)
    odometry_faults: list[int] = field(default_factory=list)
    possible_faults: list[int] = field(default_factory=list)
    breaks: list[int] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    ambiguous: list[int] = field(default_factory=list)
    bare_stretches: list[BareStretch] = field(default_factory=list)
    follows_odometry: bool = False


@dataclass(frozen=True)
class MStepResult(ShortRepr):
    """Result of one M-step.

    Attributes:
        poses: (T, D+1, D+1) T_map_base; the map frame is the base of the first scan.
        covariance: (T, 3, 3) of x, y, heading against the local map, after refinement against the
            map of all other scans; (T, 6, 6) in 3D.
        grid: the sums alpha, beta of (10) over all scans; empty if they were not asked for.
        explained: (T,) share of each scan's beams that the local map explained; NaN: poses given.
        drift: (T, 3, 3) covariance of x, y, heading (map axes) that the step to each scan adds
            where the scan says nothing, as along a bare wall; None: not known.
        diagnostics: scans at which odometry and scan matching disagree.
        loops: attempted loop closures, accepted or rejected.
        graph: the pose graph; None without loop closure.
    """

    poses: Float
    covariance: Float
    grid: Grid
    explained: Float
    drift: Float | None = None
    diagnostics: Diagnostics = field(default_factory=Diagnostics)
    loops: list[LoopClosure] = field(default_factory=list)
    graph: PoseGraph | None = None

    def without_grid(self) -> "MStepResult":
        """The same with an empty grid: grids are large."""
        return dataclasses.replace(self, grid=type(self.grid)(self.grid.resolution))


@dataclass(frozen=True, eq=False)
class LoopContext:
    """A 2D trajectory in which loops are searched.

    Attributes:
        e: (M,) P(static) of every beam.
        poses: (T, 3, 3) T_map_base.
        travelled: (T,) m up to each scan.
        explained: (T,) share of each scan that the local map explained.
        keyframes: (K,) scans.
        resolution: m, edge of a map cell.
        keyframe_distance: m of travel between keyframes.
        search_distance: m between a keyframe and an earlier one for a loop candidate.
        drift: (T, 3, 3) as of MStepResult.
    """

    recording: Recording
    e: Float32
    poses: Float
    travelled: Float
    explained: Float
    keyframes: Index
    resolution: float
    keyframe_distance: float
    search_distance: float
    drift: Float

    def hits(self, t: int) -> Scan:
        """The hits of scan t."""
        return scan_hits.select_hits(self.recording, self.e, t)

    def build_map(self, scans: Iterable[int]) -> _core.OccupancyGrid2D:
        """A map for registration of some of the scans."""
        grid = _core.OccupancyGrid2D(self.resolution, scan_hits.FREE_SPACE_MARGIN)
        for t in scans:
            scan_hits.add_scan(grid, self.recording, self.e, t, self.poses[t])
        return grid

    def count_beams(self, scans: Index, poses: Float, **near: Any) -> _core.OccupancyGrid2D:
        """The counts (10) of some of the scans, at poses (n, 3, 3), as of `scan_hits`."""
        return scan_hits.count_beams(self.recording, self.e, scans, poses, self.resolution, **near)
