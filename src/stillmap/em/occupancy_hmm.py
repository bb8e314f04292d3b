"""E-step of the occupancy HMM: a forward filter per cell under several classes.

In 3D, objects that arrived or left are dynamic as well, and neighbouring voxels are labelled
jointly. `docs/estimator.md` derives the equations.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.chunks import iter_beams
from stillmap.core.parallel import map_ordered, work_beside
from stillmap.core.recording import Recording
from stillmap.em import spatial_coupling
from stillmap.em.change_hmm import ChangeMixture, change_parameters, select_changed_cells
from stillmap.em.ground import ground_from_surfels
from stillmap.em.mixture import fit_weights, posterior, posterior_static
from stillmap.em.observations import (
    MAX_RANGE_MARGIN,
    MIN_TRUST,
    HmmClasses,
    Observations,
    Rows,
    collect_observations,
    iter_surfel_rows,
    probability_in_cell,
    surfel_cells,
)
from stillmap.em.options import EmOptions
from stillmap.em.spatial_coupling import ObstacleSurfels
from stillmap.em.types import CellProbabilities, EStepResult, Likelihood, NoReturnModel, fill_beams

_FREE_PRIOR = 0.2  # occupancy probability of a cell in which no beam ended and none passed
_LONG_TAU = 12.0  # s, from which on a mover resembles a wall that two visits put in two places

_CLASSES_3D = HmmClasses(dynamic_tau=(0.5, 3.0, 6.0, 12.0), half_time_tau=(8.0, 24.0))


def e_step(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> EStepResult:
    """P(c = 1) of every beam: the probability that the surface in its end cell is static.

    Args:
        recording: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        resolution: edge of a cell, metres.
        options: see EmOptions.
        threads: does not change the result.
    """
    observations = collect_observations(recording, poses, resolution, options, threads)
    fit = fit_classes(observations, None, options)
    return label_beams(observations, None, fit, recording, poses)


def e_step_3d(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> EStepResult:
    """P(c = 1) of every beam of a 3D recording; what arrived or left is dynamic.

    Args: see `e_step`, which it is without `change_detection`. With `change_detection_3d` the
    result lists the cells that changed.
    """
    if not options.change_detection:
        return e_step(recording, poses, resolution, options, threads)

    changes = change_parameters(recording, with_paths=options.change_detection_3d)
    observations = collect_observations(
        recording, poses, resolution, options, threads, _CLASSES_3D, changes, with_surroundings=True
    )
    surfel_map = observations.surfel_map
    assert isinstance(surfel_map, _core.SurfelMap3D)
    with work_beside(lambda: fit_classes(observations, None, options), threads) as fitted:
        mixture = ChangeMixture(observations, options)
        own_p_static, change = mixture.label_surfels()
        p_static = spatial_coupling.smooth_mean_field(own_p_static, surfel_map, threads)
        fit = fitted()
    ground = ground_from_surfels(surfel_map, p_static, recording.T_map_sensor(poses)[:, :3, 3])
    obstacles = spatial_coupling.select_obstacles(ground, surfel_map)
    if obstacles is not None:
        p_static = spatial_coupling.pool_clusters(
            p_static, change, obstacles, recording, poses, threads
        )
        p_static, obstacles = spatial_coupling.label_far_ground(p_static, obstacles)
    labelled = label_beams(observations, None, fit, recording, poses, p_static, obstacles)
    changed_cells = None
    if options.change_detection_3d:
        changed_cells = select_changed_cells(mixture.decode_histories())
    return replace(
        labelled,
        learned={**labelled.learned, "changing": round(mixture.changing_weight, 6)},
        changed_cells=changed_cells,
        ground=ground,
    )


class ClassFit(NamedTuple):
    """Mixture of classes, fitted to all observations.

    Attributes:
        weights: (C,) of the classes.
        p_static: (E,) posterior of the static classes for each surfel.
        p_view_dependent: (E,) of those among them that are view-dependent.
        likelihood: of the observations.
    """

    weights: Float
    p_static: Float32
    p_view_dependent: Float32
    likelihood: Likelihood


def fit_classes(
    observations: Observations,
    classes: Bool | None,
    options: EmOptions,
    shapes: Float32 | None = None,
) -> ClassFit:
    """Fits the weights of some classes; None: all.

    shapes: (E, 2) factors of the likelihood of view-dependent and of dynamic classes; None: 1.
    """
    sample, _ = _likelihood_with_shapes(observations, classes, observations.sample_rows(), shapes)
    long = _long_movers(observations, classes)
    weights = fit_weights(sample, observations.n_static, options.prior, rare=long)
    return ClassFit(weights, *_surfel_posterior(observations, classes, weights, shapes))


def label_beams(
    observations: Observations,
    classes: Bool | None,
    fit: ClassFit,
    recording: Recording,
    poses: Float,
    p_static: Float32 | None = None,
    obstacles: ObstacleSurfels | None = None,
) -> EStepResult:
    """Labels each beam by the cell in which it ended.

    Args:
        observations: E surfels with their observations.
        classes: (C,) classes that were fitted; None: all.
        fit: of these classes.
        recording, poses: see `e_step`.
        p_static: (E,) P(static) of each surfel to use instead of the posterior.
        obstacles: relabel beams that end on the ground below something that moves.
    """
    prior = float(fit.weights[: observations.n_static].sum())
    if p_static is None:
        p_static = fit.p_static
    elif len(p_static):
        prior = float(np.mean(p_static, dtype=np.float64))
    surfel_map, threads = observations.surfel_map, observations.threads
    with_prior = np.append(p_static, np.float32(prior))  # surfel -1: none
    e = recording.allocate_per_beam(np.float32)
    for _, beams, data in iter_beams(recording, poses, release=[e]):
        surfel = surfel_map.associate_beams(*data, threads)
        labels = fill_beams(data.points, data.hit, with_prior.take(surfel), prior)
        if obstacles is not None:
            above = obstacles.label_ground_contact(p_static, data, surfel, threads)
            labels = np.where(np.isnan(above), labels, above)
        e[beams] = labels
    p_occupied = p_static * probability_in_cell(surfel_map)
    end_margin = MAX_RANGE_MARGIN if observations.trust >= MIN_TRUST else float("inf")
    return EStepResult(
        p_static=e,
        likelihood=fit.likelihood,
        occupied=CellProbabilities(surfel_cells(surfel_map), p_occupied, _FREE_PRIOR),
        learned=_parameter_record(observations, classes, fit.weights, prior),
        no_return=NoReturnModel(observations.hmm.solid_cells(), end_margin),
    )


def _long_movers(observations: Observations, classes: Bool | None) -> Bool:
    """Select those of the used classes that are movers that stay for long.

    Poses that disagree by decimetres let a wall appear in two places, each hit during one visit and
    missed during another, which is what these classes describe. Without a bound on their weight
    they would take over the mixture, and all cells that say little, which follow the weights.
    """
    of = slice(None) if classes is None else classes
    long = observations.tau >= _LONG_TAU
    long[: observations.n_static] = False
    return np.asarray(long[of])


def _likelihood_with_shapes(
    observations: Observations, classes: Bool | None, rows: Rows, shapes: Float32 | None
) -> tuple[Float32, Float]:
    """Likelihood (K, C) of some surfels, times the factors of their shapes (E, 2).

    Relative to the best class without them, whose logarithm (K,) comes second.
    """
    table, log_best = observations.likelihood(classes, rows)
    if shapes is not None:
        of_rows = shapes[slice(*rows)]
        table[:, _view_dependent(observations, classes)] *= of_rows[:, :1]
        table[:, observations.n_static :] *= of_rows[:, 1:]
    return table, log_best


def _view_dependent(observations: Observations, classes: Bool | None) -> Bool:
    """Select those of the used classes that are view-dependent."""
    of = slice(None) if classes is None else classes
    return np.asarray(np.isfinite(observations.view_angle[of]))


def _surfel_posterior(
    observations: Observations, classes: Bool | None, weights: Float, shapes: Float32 | None
) -> tuple[Float32, Float32, Likelihood]:
    """(E,) P(static) and P(view-dependent) of each surfel, and the bound sum ln sum_c w_c L_c."""
    p_static, p_view = np.zeros((2, observations.surfel_map.size), np.float32)
    bound, entropy = 0.0, 0.0
    view = _view_dependent(observations, classes)

    def process(rows: Rows) -> tuple[float, float]:
        table, log_best = _likelihood_with_shapes(observations, classes, rows, shapes)
        p_static[slice(*rows)] = posterior_static(table, weights, observations.n_static)
        if view.any():
            p_view[slice(*rows)] = posterior(table, weights, view)
        joint = table * weights
        evidence = joint.sum(axis=1)  # sum_c w_c L_c
        r = joint / evidence[:, None]  # responsibilities of the classes
        negative_entropy = float(np.sum(r * np.log(np.maximum(r, 1e-30))))
        return float(np.sum(np.log(evidence) + log_best)), -negative_entropy

    blocks = map_ordered(process, iter_surfel_rows(observations.surfel_map), observations.threads)
    for evidence_of_rows, entropy_of_rows in blocks:
        bound += evidence_of_rows
        entropy += entropy_of_rows
    return p_static, p_view, Likelihood(expected=bound - entropy, bound=bound)


def _parameter_record(
    observations: Observations, classes: Bool | None, weights: Float, p_static: float
) -> dict[str, object]:
    """The fitted parameters, as `run.json` lists them."""
    n, of = observations.n_static, slice(None) if classes is None else classes
    rho, tau = observations.rho[of], observations.tau[of]
    return {
        "scatter": observations.surfel_map.noise_std,
        "p_static": p_static,
        "no_return_trusted": round(observations.trust, 6),
        "static_occupied": _weight_by_value(rho[:n], weights[:n]),
        "mover_occupied": _weight_by_value(rho[n:], weights[n:]),
        "mover_seconds": _weight_by_value(tau[n:], weights[n:]),
    }


def _weight_by_value(values: Float, weights: Float) -> list[dict[str, float]]:
    """Share of each value among some classes."""
    shares = weights / weights.sum()
    return [
        {"value": float(v), "share": round(float(shares[values == v].sum()), 6)}
        for v in dict.fromkeys(values.tolist())
    ]
