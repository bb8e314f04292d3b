"""The E-step at the final poses: additional classes, and in 2D the shapes of what is hit.

Within the loop a view-dependent class would explain walls duplicated by pose error, and preserve
that error. `docs/estimator.md` has the equations.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.arrays import finite_rows
from stillmap.core.recording import Recording
from stillmap.em.change_hmm import CellHistories, ChangeMixture, change_parameters
from stillmap.em.observations import HALF_TIME_RHO, HmmClasses, Observations, collect_observations
from stillmap.em.occupancy_hmm import ClassFit, fit_classes, label_beams
from stillmap.em.options import EmOptions
from stillmap.em.shape_evidence import ShapeEvidence
from stillmap.em.types import DYNAMIC_BELOW, EStepResult

_CROWD_RHO, _CROWD_TAU = 0.15, 3.0  # rho and tau (s) of places crossed by many people
_WAITING_TAU = 6.0  # s; used for change detection only, not for labels
_LABEL_CLASSES = HmmClasses(
    view_rho=(0.65,),
    dynamic_rho=(0.01, 0.04, _CROWD_RHO),
    dynamic_tau=(0.5, _CROWD_TAU, 12.0, 45.0),
)
_CHANGE_CLASSES = replace(  # and those of labels
    _LABEL_CLASSES,
    dynamic_tau=(0.5, _CROWD_TAU, _WAITING_TAU, 12.0, 45.0),
    half_time_tau=(8.0, 24.0),
)
_SHAPE_ROUNDS = 3  # shapes are learned from labels, which follow from the shapes before


def final_e_step(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    threads: int = 1,
    *,
    with_shapes: bool = True,
) -> tuple[EStepResult, CellHistories | None]:
    """P(c = 1) of every beam at the final poses, and what happened in every cell.

    Args:
        recording, poses, resolution, options, threads: see `occupancy_hmm.e_step`.
        with_shapes: lower P(static) by the shapes of surfels, in 2D; in 3D there are none.

    Returns:
        labels; histories of the same cells, None without `change_detection`.
    """
    changes = change_parameters(recording) if options.change_detection else None
    computed = _LABEL_CLASSES if changes is None else _CHANGE_CLASSES
    observations = collect_observations(
        recording, poses, resolution, options, threads, computed, changes
    )
    classes = _label_classes(observations)
    fit = fit_classes(observations, classes, options)
    if with_shapes and isinstance(observations.surfel_map, _core.SurfelMap2D):
        shapes = ShapeEvidence(observations.surfel_map, recording, poses, threads)
        fit = _fit_with_shapes(observations, classes, options, fit, shapes)
    labels = label_beams(observations, classes, fit, recording, poses)
    if changes is None:
        return labels, None
    return labels, ChangeMixture(observations, options).decode_histories()


def _label_classes(observations: Observations) -> Bool:
    """(C,) classes used for labels; without the crowd class, which explains chairs as well."""
    crowds = (observations.rho == _CROWD_RHO) & (observations.tau == _CROWD_TAU)
    kept = ~crowds & (observations.tau != _WAITING_TAU) & (observations.rho != HALF_TIME_RHO)
    kept[: observations.n_static] = True
    return np.asarray(kept)


def _fit_with_shapes(
    observations: Observations,
    classes: Bool,
    options: EmOptions,
    fit: ClassFit,
    shapes: ShapeEvidence,
) -> ClassFit:
    """Weights of the classes and frequencies of the shapes, fitted by turns.

    P(static) is at most that by history: leaves of doors have the shape of walls.
    """
    by_history = fit.p_static
    for _ in range(_SHAPE_ROUNDS):
        shapes.fit(fit.p_static, fit.p_view_dependent)
        fit = fit_classes(observations, classes, options, shapes.factors)
    return fit._replace(p_static=np.minimum(fit.p_static, by_history))


_CELL = {2: 0.2, 3: 0.15}  # m, by dimension: the same for every recording, whatever its resolution
_MIN_DYNAMIC = 0.002  # share of the returns: with less, F1 is that of a few returns by chance
_OPTIONS = replace(EmOptions(), change_detection=False)


class ExpectedCounts(NamedTuple):
    """Expected numbers of returns.

    Attributes:
        returns: all.
        likely: more likely dynamic than static.
        both: dynamic and labelled dynamic.
        dynamic: dynamic.
        labelled: labelled dynamic.
    """

    returns: float
    likely: float
    both: float
    dynamic: float
    labelled: float


def count_expected(
    recording: Recording, candidates: Iterable[Float], p_static: Float32, threads: int = 1
) -> ExpectedCounts:
    """Expected counts of the labels of some scans.

    q_n = P(return n is of something dynamic) by the occupancy HMM in cells of a fixed size. A wrong
    pose makes what is static look dynamic, hardly the reverse: q_n is the lowest of all candidates.

    Args:
        recording: 2D or 3D, deskewed.
        candidates: poses (T, D+1, D+1) T_map_base, each on its own.
        p_static: (M,) labels of any estimator.
        threads: does not change the result.
    """
    hits = recording.hit & finite_rows(recording.points)
    q, cell = np.ones(int(hits.sum())), _CELL[recording.dimension]
    for poses in candidates:
        judged, _ = final_e_step(recording, poses, cell, _OPTIONS, threads, with_shapes=False)
        q = np.minimum(q, 1.0 - judged.p_static[hits].astype(np.float64))
    dynamic = p_static[hits] < DYNAMIC_BELOW
    sums = (float(q[dynamic].sum()), float(q.sum()), float(dynamic.sum()))
    return ExpectedCounts(float(len(q)), float(np.count_nonzero(q > 0.5)), *sums)


def expected_f1(counts: Iterable[ExpectedCounts]) -> float | None:
    """2 sum both / (sum dynamic + sum labelled); None where hardly anything is dynamic."""
    none = ExpectedCounts(*np.zeros(5))
    returns, likely, both, dynamic, labelled = np.sum([none, *counts], axis=0).tolist()
    is_rare = likely + labelled <= 2.0 * _MIN_DYNAMIC * returns
    return None if is_rare else 2.0 * both / (dynamic + labelled)
