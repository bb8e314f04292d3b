"""E-step of the occupancy HMM: a forward filter per cell under several classes.

In 3D, objects that arrived or left are dynamic as well, and neighbouring voxels are labelled
jointly. The final E-step, at the final poses, has additional classes. Within the loop a
view-dependent class would explain walls duplicated by pose error, and preserve that error.
`docs/estimator.md` derives the equations.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.em import changepoints, spatial_prior
from stillmap.em.changepoints import CellHistories
from stillmap.em.ground import ground_from_surfels
from stillmap.em.mixture import MixtureWeights, fit_weights, posterior_static
from stillmap.em.observations import (
    HALF_TIME_RHO,
    LOOP_CLASSES,
    MAX_RANGE_MARGIN,
    HmmClasses,
    Observations,
    SurfelMap,
    collect_observations,
    iter_surfel_rows,
    probability_in_cell,
    surfel_cells,
)
from stillmap.em.options import EmOptions
from stillmap.em.spatial_prior import GroundContact
from stillmap.em.types import (
    CellProbabilities,
    EStepResult,
    Float,
    Likelihood,
    NoReturnModel,
    fill_beams,
)

_FREE_PRIOR = 0.2  # occupancy probability of a cell in which no beam ended and none passed
_MIN_TRUST = 0.5  # in beams without a return, above which they clear free space
_VIEW_CLASSES = True  # the final E-step has view-dependent static classes

_CLASSES_3D = HmmClasses(dynamic_tau=(0.5, 3.0, 6.0, 12.0), half_time_tau=(8.0, 24.0))

_CROWD_RHO, _CROWD_TAU = 0.15, 3.0  # rho and tau (s) of places crossed by many people
_WAITING_TAU = 6.0  # s; used for change detection only, not for labels
_FINAL_CLASSES = HmmClasses(
    view_rho=(0.65,),
    dynamic_rho=(0.01, 0.04, _CROWD_RHO),
    dynamic_tau=(0.5, _CROWD_TAU, _WAITING_TAU, 12.0, 45.0),
    half_time_tau=(8.0, 24.0),
)


def e_step(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    threads: int = 1,
    classes: HmmClasses = LOOP_CLASSES,
) -> EStepResult:
    """P(c = 1) of every beam: the probability that the surface in its end cell is static.

    Args:
        recording: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        resolution: edge of a cell, metres.
        options: see EmOptions.
        threads: does not change the result.
        classes: of the HMM.
    """
    seen = collect_observations(recording, poses, resolution, options, threads, classes)
    return label_beams(seen, None, recording, poses, options)


def e_step_3d(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> EStepResult:
    """P(c = 1) of every beam of a 3D recording; what arrived or left is dynamic.

    Args: see `e_step`, which it is without `change_detection`. With `change_detection_3d` the
    result lists the cells that changed.
    """
    if not options.change_detection:
        return e_step(recording, poses, resolution, options, threads)

    prepare = partial(
        changepoints.track_changes,
        recording=recording,
        options=options,
        with_paths=options.change_detection_3d,
    )
    seen = collect_observations(
        recording, poses, resolution, options, threads, _CLASSES_3D, prepare
    )
    cells = changepoints.label_cells(seen, options)
    p_static = spatial_prior.smooth_mean_field(cells.p_static, seen.surfel_map, threads)
    positions = recording.T_map_sensor(poses)[:, :3, 3]
    ground = ground_from_surfels(seen.surfel_map, p_static, positions)
    obstacles = spatial_prior.select_obstacles(ground, seen.surfel_map)
    contact = None
    if obstacles is not None:
        p_static = spatial_prior.pool_clusters(
            p_static, cells.change, obstacles, recording, poses, threads
        )
        contact = spatial_prior.make_ground_contact(obstacles, p_static)
    found = label_beams(seen, None, recording, poses, options, p_static, contact)
    changed_cells = None
    if options.change_detection_3d:
        changed_cells = changepoints.select_changed_cells(
            changepoints.decode_histories(seen, options)
        )
    return replace(
        found,
        learned={**found.learned, "changing": round(cells.changing_weight, 6)},
        changed_cells=changed_cells,
        ground=ground,
    )


def has_final_e_step(options: EmOptions) -> bool:
    """Whether labels or changes need a final E-step in 2D."""
    return _VIEW_CLASSES or options.change_detection


def final_e_step(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> tuple[EStepResult | None, CellHistories | None]:
    """E-step at the final poses, with view-dependent and half-time classes.

    Args: see `e_step`.

    Returns:
        labels, None without view classes; histories of the same cells, None without
        `change_detection`.
    """
    prepare = None
    if options.change_detection:
        prepare = partial(changepoints.track_changes, recording=recording, options=options)
    classes = _FINAL_CLASSES if _VIEW_CLASSES else replace(_FINAL_CLASSES, view_rho=())
    seen = collect_observations(recording, poses, resolution, options, threads, classes, prepare)
    labels = None
    if _VIEW_CLASSES:
        labels = label_beams(seen, _label_classes(seen), recording, poses, options)
    return labels, changepoints.decode_histories(
        seen, options
    ) if options.change_detection else None


def _label_classes(seen: Observations) -> NDArray[np.bool_]:
    """(C,) classes used for labels; without the crowd class, which explains chairs as well."""
    crowds = (seen.rho == _CROWD_RHO) & (seen.tau == _CROWD_TAU)
    kept = ~crowds & (seen.tau != _WAITING_TAU) & (seen.rho != HALF_TIME_RHO)
    kept[: seen.n_static] = True
    return np.asarray(kept)


def label_beams(
    seen: Observations,
    classes: NDArray[np.bool_] | None,
    recording: Recording,
    poses: Float,
    options: EmOptions,
    p_static: NDArray[np.float32] | None = None,
    contact: GroundContact | None = None,
) -> EStepResult:
    """Fits the mixture weights and labels each beam by the cell in which it ended.

    Args:
        seen: E surfels with their observations.
        classes: (C,) classes to use; None: all.
        recording, poses, options: see `e_step`.
        p_static: (E,) P(static) of each surfel to use instead of the posterior.
        contact: relabels beams that end on the ground below something that moves.
    """
    sample, _ = seen.likelihood(classes, seen.sample_rows())
    weights = fit_weights(sample, seen.n_static, options.prior)
    posterior, likelihood = _surfel_posterior(seen, classes, weights)
    prior = weights.static
    if p_static is None:
        p_static = posterior
    elif len(p_static):
        prior = float(np.mean(p_static, dtype=np.float64))
    surfel_map = seen.surfel_map
    end_margin = MAX_RANGE_MARGIN if seen.trust >= _MIN_TRUST else float("inf")
    return EStepResult(
        p_static=_beam_labels(recording, poses, surfel_map, p_static, prior, seen.threads, contact),
        likelihood=likelihood,
        occupied=CellProbabilities(
            surfel_cells(surfel_map), p_static * probability_in_cell(surfel_map), _FREE_PRIOR
        ),
        learned=_learned(seen, classes, weights) | {"p_static": prior},
        no_return=NoReturnModel(seen.hmm.solid_cells(), end_margin),
    )


def _beam_labels(
    recording: Recording,
    poses: Float,
    surfel_map: SurfelMap,
    p_static: NDArray[np.float32],
    prior: float,
    threads: int,
    contact: GroundContact | None,
) -> NDArray[np.float32]:
    """(M,) P(static) of the surfel (E,) in which each beam ended."""
    with_prior = np.append(p_static, np.float32(prior))  # surfel -1: none
    e = recording.allocate_per_beam(np.float32)
    for _, beams, data in iter_beams(recording, poses, release=[e]):
        surfel = surfel_map.associate_beams(*data, threads)
        labels = fill_beams(data.points, data.hit, with_prior.take(surfel), prior)
        if contact is not None:
            above = contact.label_above(data, surfel, threads)
            labels = np.where(np.isnan(above), labels, above)
        e[beams] = labels
    return e


def _surfel_posterior(
    seen: Observations, classes: NDArray[np.bool_] | None, weights: MixtureWeights
) -> tuple[NDArray[np.float32], Likelihood]:
    """(E,) P(static) of each surfel, and the bound sum ln sum_c w_c L_c."""
    p_static, bound, entropy = np.empty(seen.surfel_map.size, np.float32), 0.0, 0.0
    for rows in iter_surfel_rows(seen.surfel_map):
        table, log_best = seen.likelihood(classes, rows)
        p_static[slice(*rows)] = posterior_static(table, weights.classes, seen.n_static)
        joint = table * weights.classes
        evidence = joint.sum(axis=1)  # sum_c w_c L_c
        r = joint / evidence[:, None]  # responsibilities of the classes
        entropy -= float(np.sum(r * np.log(np.maximum(r, 1e-30))))
        bound += float(np.sum(np.log(evidence) + log_best))
    return p_static, Likelihood(expected=bound - entropy, bound=bound)


def _learned(
    seen: Observations, classes: NDArray[np.bool_] | None, weights: MixtureWeights
) -> dict[str, object]:
    """The fitted parameters, as `run.json` lists them."""
    static, dynamic = slice(None, seen.n_static), slice(seen.n_static, None)
    rho, tau = (values if classes is None else values[classes] for values in (seen.rho, seen.tau))
    return {
        "scatter": seen.surfel_map.noise_std,
        "p_static": weights.static,
        "no_return_trusted": round(seen.trust, 6),
        "static_occupied": _weight_by_value(rho[static], weights.classes[static]),
        "mover_occupied": _weight_by_value(rho[dynamic], weights.classes[dynamic]),
        "mover_seconds": _weight_by_value(tau[dynamic], weights.classes[dynamic]),
    }


def _weight_by_value(values: Float, weights: Float) -> list[dict[str, float]]:
    """Share of each value among some classes."""
    shares = weights / weights.sum()
    return [
        {"value": float(v), "share": round(float(shares[values == v].sum()), 6)}
        for v in dict.fromkeys(values.tolist())
    ]
