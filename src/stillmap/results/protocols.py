"""What the writers need of a result: the pipeline's dataclasses satisfy these by their shape."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.mesh.options import MeshOptions
from stillmap.pipeline.options import OutputOptions
from stillmap.pipeline.snapshots import Snapshot
from stillmap.tracking.options import ObjectOptions


class MapLike(Protocol):
    """A grid map, row 0 at the lowest y.

    Attributes:
        p_occupied: (H, W) float32, NaN where no beam tells anything.
        origin: x, y in metres and yaw in radians of the lower-left cell's lower-left corner.
        resolution: edge of a cell in metres.
    """

    @property
    def p_occupied(self) -> NDArray[np.float32]: ...
    @property
    def origin(self) -> tuple[float, float, float]: ...
    @property
    def resolution(self) -> float: ...


class OccupancyMapLike(MapLike, Protocol):
    """A grid map with what it is made from.

    Attributes:
        alpha: (H, W) float32, the sums of (10): beams that ended on something static here.
        beta: (H, W) float32, the sums of (10): evidence that the cell is free.
    """

    @property
    def alpha(self) -> NDArray[np.float32]: ...
    @property
    def beta(self) -> NDArray[np.float32]: ...


class EvidenceLike(Protocol):
    """What the cells of a map rest on, laid out as the map is.

    Attributes:
        looks: (H, W) uint16, looks at each cell.
        clear: (H, W) uint16, those of them in which nothing that moves was near.
        thin: (H, W) bool, known cells with fewer than `least` clear looks.
        least: clear looks that a cell should have.
        near: metres within which something that moves spoils a look.
    """

    @property
    def observations(self) -> NDArray[np.uint16]: ...
    @property
    def unobstructed(self) -> NDArray[np.uint16]: ...
    @property
    def thinly_observed(self) -> NDArray[np.bool_]: ...
    @property
    def min_observations(self) -> int: ...
    @property
    def mover_radius(self) -> float: ...


class IterationRecordLike(Protocol):
    """The numbers of one EM iteration.

    Attributes:
        number: counted from 1.
        expected_log_likelihood: by the printed method (5) with the constant of (7), the curve of
            Fig. 5; by the default, its like for what was seen of the cells.
        bound: the above plus the entropy of what is hidden: what the loop watches.
        held_out_log_likelihood: of the ranges in scans left out of the map, in nats per beam above
            a world without a map; None where not computed.
        changed_share: share of hits whose label or probability still moved.
        seconds: wall-clock time of the iteration.
    """

    @property
    def number(self) -> int: ...
    @property
    def expected_log_likelihood(self) -> float: ...
    @property
    def bound(self) -> float: ...
    @property
    def held_out_log_likelihood(self) -> float | None: ...
    @property
    def changed_share(self) -> float: ...
    @property
    def seconds(self) -> float: ...


class LoopLike(Protocol):
    """One attempt at closing a loop.

    Attributes:
        earlier, later: numbers of two scans that may see the same place, from 0.
        explained: share of the later beams that the earlier ones explain.
        refused: why it was not accepted; empty when it was.
    """

    @property
    def earlier(self) -> int: ...
    @property
    def later(self) -> int: ...
    @property
    def explained(self) -> float: ...
    @property
    def refused(self) -> str: ...


class DoubtsLike(Protocol):
    """Where odometry and scans do not agree; numbers of scans, from 0.

    Attributes:
        widened: those that a wider search had to find.
        disagreeing: those where odometry was disbelieved.
        breaks: those before which the robot lost its way or was carried elsewhere.
        apart: those of them from which on the map stands beside the rest.
    """

    @property
    def widened(self) -> list[int]: ...
    @property
    def odometry_faults(self) -> list[int]: ...
    @property
    def breaks(self) -> list[int]: ...
    @property
    def unconnected(self) -> list[int]: ...


class RelationLike(Protocol):
    """T_first_second as somebody measured it.

    Attributes:
        first, second: indices of keyframes.
        T: (3, 3).
        covariance: (3, 3) of x, y, heading in the frame of the second pose.
    """

    @property
    def first(self) -> int: ...
    @property
    def second(self) -> int: ...
    @property
    def T(self) -> NDArray[np.float64]: ...
    @property
    def covariance(self) -> NDArray[np.float64]: ...


class GraphLike(Protocol):
    """The pose graph.

    Attributes:
        scans: (K,) numbers of the scans that are keyframes.
        relations: between keyframes: along the way, and the loops that were accepted.
    """

    @property
    def keyframes(self) -> NDArray[np.intp]: ...
    @property
    def constraints(self) -> Sequence[RelationLike]: ...


class MovingObjectLike(Protocol):
    """Something that moved.

    Attributes:
        id: its number.
        scan: (L,) scans that saw it.
        stamp_ns: (L,) their stamps.
        xy: (L, 2) metres, its middle in the map frame.
        velocity: (L, 2) metres per second.
        size: metres along and across the way it went.
        beams: (n,) beams of the recording that ended on it.
        p_dynamic: mean probability of these beams to be dynamic.
        z: (L,) metres, how high its middle is; None in 2D.
    """

    @property
    def id(self) -> int: ...
    @property
    def scan(self) -> NDArray[np.intp]: ...
    @property
    def stamp_ns(self) -> NDArray[np.int64]: ...
    @property
    def xy(self) -> NDArray[np.float64]: ...
    @property
    def velocity(self) -> NDArray[np.float64]: ...
    @property
    def size(self) -> tuple[float, ...]: ...
    @property
    def z(self) -> NDArray[np.float64] | None: ...
    @property
    def beams(self) -> NDArray[np.intp]: ...
    @property
    def p_dynamic(self) -> float: ...


class TrafficLike(Protocol):
    """How often squares of the floor were crossed, row 0 at the lowest y.

    Attributes:
        crossings: (H, W) int32.
        speed: (H, W) float32, metres per second, NaN where nothing crossed.
        origin: x, y in metres and yaw of the lower-left square's lower-left corner.
        resolution: edge of a square in metres.
    """

    @property
    def crossings(self) -> NDArray[np.int32]: ...
    @property
    def speed(self) -> NDArray[np.float32]: ...
    @property
    def origin(self) -> tuple[float, float, float]: ...
    @property
    def resolution(self) -> float: ...


class OptionsLike(Protocol):
    """The resolved options: a frozen dataclass with a section for the writers.

    Attributes:
        estimator: what said which beams are static: `stillmap`, `paper`, `hit-ratio` or
            `tracker`.
        objects: how moving things were found.
        mesh: how models were made.
        output: options of the writers.
        threads: how many may be used, 0: all.
    """

    @property
    def estimator(self) -> str: ...
    @property
    def threads(self) -> int: ...
    @property
    def mesh(self) -> MeshOptions: ...
    @property
    def objects(self) -> ObjectOptions: ...
    @property
    def output(self) -> OutputOptions: ...


class ChangeLike(Protocol):
    """A place that changed.

    Attributes:
        kind: "came", "left" or "comes and goes".
        x, y, z: metres, its middle in the map frame; z is None in the plane.
        size: metres along x and y, and in space z.
        cells: (K, 2) int64 cells that changed.
        swept_cells: (S, 2) int64 cells of the whole place: of a door all that it sweeps.
        before_ns, stamp_ns: last scan that saw it as it was, first that saw it otherwise.
        last_ns: first scan that saw the last change.
        times: how often it changed.
    """

    @property
    def kind(self) -> str: ...
    @property
    def x(self) -> float: ...
    @property
    def y(self) -> float: ...
    @property
    def z(self) -> float | None: ...
    @property
    def size(self) -> tuple[float, ...]: ...
    @property
    def cells(self) -> NDArray[np.int64]: ...
    @property
    def swept_cells(self) -> NDArray[np.int64]: ...
    @property
    def before_ns(self) -> int: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def last_ns(self) -> int: ...
    @property
    def times(self) -> int: ...


class TiltingLike(Protocol):
    """What a second laser built in 3D, T scans with M beams.

    Attributes:
        recording: as it was read.
        seen: the same without motion during its scans; what nobody knows the place of is unusable.
        poses: (T, 4, 4) float64, T_map_base.
        p_static: (M,) float32, P(c = 1); NaN for unusable beams.
        objects: what moved, in 3D.
        left_out: beams that were taken when nobody knows where the robot was.
        boxes: how many cut something out.
        learned: what the evidence in 3D says; empty without.
    """

    @property
    def recording(self) -> Recording: ...
    @property
    def deskewed(self) -> Recording: ...
    @property
    def poses(self) -> NDArray[np.float64]: ...
    @property
    def p_static(self) -> NDArray[np.float32]: ...
    @property
    def objects(self) -> Sequence[MovingObjectLike]: ...
    @property
    def unposed_beams(self) -> int: ...
    @property
    def boxes(self) -> int: ...
    @property
    def learned(self) -> Mapping[str, Any]: ...


class ResultLike(Protocol):
    """What `stillmap map` found out about T scans with M beams in D dimensions.

    Attributes:
        recording: what it was made from.
        seen: the same without the motion during its scans, as `poses` have it.
        options: every option as resolved.
        iterations: one record per EM iteration, in order.
        snapshots: a small part of the map at the first, second, best and last iteration (Fig. 8).
        poses: (T, D+1, D+1) float64, T_map_base.
        p_static: (M,) float32, P(c = 1); NaN for unusable beams, the prior at maximum range.
        map: the map of what stands still.
        raw_map: the map with every hit counted in full, from the same poses, of the same cells.
        evidence: the looks that these cells rest on.
        best_iteration: number of the iteration that was kept.
        converged: whether the loop stopped by itself.
        warnings: one sentence each.
        learned: what the estimator learned: empty, or shares, scatter and tables of shares.
        loops: attempts at closing loops, accepted or refused.
        doubts: where odometry and scans do not agree.
        graph: the pose graph; None where poses were given or no loops were looked for.
        objects: what moved.
        traffic: how often squares of the floor were crossed by it.
        changes: places where something came to stay, left, or comes and goes.
        stages: name to `seconds`, `cpu_seconds` and `peak_memory_bytes`, in the order they ran.
    """

    @property
    def recording(self) -> Recording: ...
    @property
    def seen(self) -> Recording: ...
    @property
    def options(self) -> OptionsLike: ...
    @property
    def iterations(self) -> Sequence[IterationRecordLike]: ...
    @property
    def snapshots(self) -> Sequence[Snapshot]: ...
    @property
    def poses(self) -> NDArray[np.float64]: ...
    @property
    def p_static(self) -> NDArray[np.float32]: ...
    @property
    def map(self) -> OccupancyMapLike: ...
    @property
    def raw_map(self) -> OccupancyMapLike: ...
    @property
    def evidence(self) -> EvidenceLike: ...
    @property
    def best_iteration(self) -> int: ...
    @property
    def converged(self) -> bool: ...
    @property
    def warnings(self) -> Sequence[str]: ...
    @property
    def learned(self) -> Mapping[str, Any]: ...
    @property
    def loops(self) -> Sequence[LoopLike]: ...
    @property
    def doubts(self) -> DoubtsLike: ...
    @property
    def graph(self) -> GraphLike | None: ...
    @property
    def objects(self) -> Sequence[MovingObjectLike]: ...
    @property
    def traffic(self) -> TrafficLike: ...
    @property
    def changes(self) -> Sequence[ChangeLike]: ...
    @property
    def stages(self) -> Mapping[str, Mapping[str, Any]]: ...
