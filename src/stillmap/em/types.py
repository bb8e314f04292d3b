"""Results of an E-step, common to all estimators."""

from dataclasses import dataclass, field

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Int32, Int64
from stillmap.core.arrays import finite_rows
from stillmap.core.short_repr import ShortRepr

Grid = _core.OccupancyGrid2D | _core.OccupancyGrid3D

DYNAMIC_BELOW = 0.5  # P(c = 1) below which a beam is labelled dynamic
MIN_PROBABILITY = 1e-6  # probabilities are kept this far from 0 and 1 before taking log odds

GROUND_SQUARE = 1.0  # m, edge of a square of the ground map


@dataclass(frozen=True)
class Likelihood:
    """Log likelihood of a recording in nats, summed over all beams or cells.

    Attributes:
        expected: expected complete-data log likelihood; for the printed method (5) with gamma (7),
            the curve of Fig. 5.
        bound: expected + entropy of the posterior, which EM at fixed poses never lowers.
    """

    expected: float
    bound: float


@dataclass(frozen=True, eq=False)
class CellProbabilities(ShortRepr):
    """Occupancy probabilities of single cells.

    Attributes:
        cells: (K, D) int64 cells in which beams ended.
        p_occupied: (K,) float32.
        free_prior: occupancy probability of every other cell before beams passed through it.
    """

    cells: Int64
    p_occupied: Float32
    free_prior: float


@dataclass(frozen=True, eq=False)
class NoReturnModel(ShortRepr):
    """Free space shown by beams without a return; fewer than three neighbours show none.

    Attributes:
        stop_cells: (S, D) int64 solid cells; such a beam shows nothing from the first of them on.
        end_margin: metres before its end from which on it shows nothing; inf: it shows nothing.
    """

    stop_cells: Int64
    end_margin: float


@dataclass(frozen=True, eq=False)
class ChangedCells(ShortRepr):
    """K cells in which objects may have arrived or left; only groups of them are significant.

    Attributes:
        cells: (K, D) int64.
        p_object: (K,) float32, probability that an object stood there at the last observation.
        n_changes: (K,) int32, number of arrivals and departures.
        change_bins: (K, 2, 2) int32, time bins of the observations before and after the first and
            the last change; -1: there was none.
    """

    cells: Int64
    p_object: Float32
    n_changes: Int32
    change_bins: Int32

    def select(self, kept: Bool) -> "ChangedCells":
        """Some of the cells."""
        return ChangedCells(
            self.cells[kept], self.p_object[kept], self.n_changes[kept], self.change_bins[kept]
        )


@dataclass(frozen=True, eq=False)
class GroundMap(ShortRepr):
    """Height of the ground in squares of one metre.

    Attributes:
        height: (H, W) metres in the map frame, row 0 at the lowest y; squares without observations
            are filled from their neighbours.
        corner: (2,) x, y of the lower-left corner of the lowest square.
        sensor_height: metres of the sensors above the ground.
        observed: whether any ground was observed.
    """

    height: Float
    corner: Float
    sensor_height: float
    observed: bool

    def height_at(self, xy: Float) -> Float:
        """(N,) height at positions (N, 2) in metres; outside, that of the nearest edge square."""
        H, W = self.height.shape
        column, row = (  # one after the other: rows of two numbers are slow
            np.floor((x - corner) / GROUND_SQUARE).astype(np.int64).clip(0, last)
            for x, corner, last in zip(xy.T, self.corner, (W - 1, H - 1), strict=True)
        )
        return np.asarray(self.height.take(row * W + column))


@dataclass(frozen=True, eq=False)
class EStepResult(ShortRepr):
    """Result of an E-step.

    Attributes:
        p_static: (M,) float32 responsibilities e_n = P(c_n = 1); NaN for unusable beams, the prior
            for maximum-range beams.
        likelihood: at the map that the E-step used.
        occupied: occupancy of cells in which beams ended; None: alpha / (alpha + beta), (15).
        learned: fitted parameters, JSON-able.
        no_return: free space shown by beams without a return; None: they count at full length.
        changed_cells: cells of objects that arrived or left, in 3D with `change_detection_3d`.
        ground: height of the ground, in 3D where the estimator needs it.
    """

    p_static: Float32
    likelihood: Likelihood
    occupied: CellProbabilities | None = None
    learned: dict[str, object] = field(default_factory=dict)
    no_return: NoReturnModel | None = None
    changed_cells: ChangedCells | None = None
    ground: GroundMap | None = None

    @property
    def known_cells(self) -> CellProbabilities:
        """Occupancy of cells in which beams ended.

        Raises:
            ValueError: the estimator has none.
        """
        if self.occupied is None:
            raise ValueError("occupied: only the default estimator knows its cells")
        return self.occupied


def fill_beams(points: Float32, hit: Bool, values: Float32, prior: float) -> Float32:
    """(M,) `values` for hits, the prior for maximum-range beams, NaN for unusable ones."""
    e = np.where(hit, values, np.float32(prior)).astype(np.float32, copy=False)
    e[~finite_rows(points)] = np.nan
    return e
