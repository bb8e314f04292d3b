"""The E-step at the final poses: additional classes, and in 2D the shapes of what is hit.

Within the loop a view-dependent class would explain walls duplicated by pose error, and preserve
that error. `docs/estimator.md` has the equations.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.recording import Recording
from stillmap.em.change_hmm import CellHistories, ChangeMixture, change_parameters
from stillmap.em.observations import (
    HALF_TIME_RHO,
    HmmClasses,
    Observations,
    collect_observations,
)
from stillmap.em.occupancy_hmm import ClassFit, fit_classes, label_beams
from stillmap.em.options import EmOptions
from stillmap.em.shape_evidence import ShapeEvidence
from stillmap.em.types import EStepResult, Float

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


def _label_classes(observations: Observations) -> NDArray[np.bool_]:
    """(C,) classes used for labels; without the crowd class, which explains chairs as well."""
    crowds = (observations.rho == _CROWD_RHO) & (observations.tau == _CROWD_TAU)
    kept = ~crowds & (observations.tau != _WAITING_TAU) & (observations.rho != HALF_TIME_RHO)
    kept[: observations.n_static] = True
    return np.asarray(kept)


def _fit_with_shapes(
    observations: Observations,
    classes: NDArray[np.bool_],
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
