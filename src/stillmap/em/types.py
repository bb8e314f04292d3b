"""What an E-step finds out, whichever estimator made it."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.arrays import finite_rows

if TYPE_CHECKING:
    from stillmap.em.ground import GroundMap


@dataclass(frozen=True, eq=False)
class ChangedCells:
    """K cells; what each of them says is little, but many side by side may say the same.

    Attributes:
        cells: (K, D) int64.
        p_thing: (K,) float32, that a thing stood there at the last look.
        count: (K,) int32, how often one came or left: once or twice.
        between: (K, 2, 2) int32, looks before and after the first and the last of these changes.
    """

    cells: NDArray[np.int64]
    p_object: NDArray[np.float32]
    n_changes: NDArray[np.int32]
    change_bins: NDArray[np.int32]


Grid = _core.Grid2D | _core.Grid3D


@dataclass(frozen=True)
class Likelihood:
    """Terms of the log likelihood, summed over all beams, in nats.

    Attributes:
        expected: the expected complete-data log likelihood, for the printed method (5) with gamma
            (7): the curve of Fig. 5.
        bound: expected + entropy of the posterior: what no EM iteration with fixed poses lowers.
    """

    expected: float
    bound: float


@dataclass(frozen=True, eq=False)
class CellProbabilities:
    """Occupancy of single cells, as an estimator knows it better than by counting.

    Attributes:
        cells: (K, D) int64 cells in which beams ended.
        p_occupied: (K,) float32.
        free_prior: probability that any other cell is occupied, before beams passed through it.
    """

    cells: NDArray[np.int64]
    p_occupied: NDArray[np.float32]
    free_prior: float


@dataclass(frozen=True, eq=False)
class NoReturnModel:
    """How far beams without a return are believed; fewer than three in a row are not at all.

    Attributes:
        stops: (S, D) int64 cells from the first of which on they say nothing.
        beyond: metres before their end from which on they say nothing; inf: all of their way.
    """

    stop_cells: NDArray[np.int64]
    end_margin: float


@dataclass(frozen=True, eq=False)
class EStepResult:
    """One E-step.

    Attributes:
        p_static: (M,) float32, e = P(c = 1); NaN: unusable, the prior at maximum range.
        likelihood: at the map it was made from.
        occupied: cells it knows more of than alpha / (alpha + beta) says.
        learned: what was learned from the recording, JSON-able.
        no_return: how far beams without a return are believed; None: all of their way.
        ground: how high the ground is, where the estimator knows; None in the plane.
        changed: cells that tell of something that came or left; None in the plane, where the
            last E-step finds them.
    """

    p_static: NDArray[np.float32]
    likelihood: Likelihood
    occupied: CellProbabilities | None = None
    learned: dict[str, object] = field(default_factory=dict)
    no_return: NoReturnModel | None = None
    changed_cells: "ChangedCells | None" = None
    ground: "GroundMap | None" = None


def fill_beams(
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    values: NDArray[np.float32],
    prior: float,
) -> NDArray[np.float32]:
    """(M,) `values` for the hits, the prior at maximum range, NaN for unusable beams."""
    e = np.where(hit, values, np.float32(prior)).astype(np.float32, copy=False)
    e[~finite_rows(points)] = np.nan
    return e
