"""The default E-step: what stands still is what never leaves. `docs/estimator.md` derives it.

The E-step in 3D: the default one, to which what came to stay, or left, is dynamic as well.

A recording of streets lasts for minutes, and a car that waits at a light for half of them, then
goes on, is no wall. Whoever removes what moves from a cloud wants the car out, and its place free.

The last E-step, at the poses that are kept: labels, and things that came to stay or left.

It knows more classes than the loop does, and each of the two questions has its own ones of them.
In the loop, what is met from some places only would explain walls that are drawn twice, and hold
the scans to them.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em.changepoints import (
    CellHistories,
    decode_histories,
    label_cells,
    select_changed_cells,
    track_changes,
)
from stillmap.em.ground import ground_from_surfels
from stillmap.em.mixture import MixtureWeights, fit_weights, posterior_static
from stillmap.em.observations import (
    HALF_TIME_RHO,
    LOOP_CLASSES,
    ClassLikelihoods,
    Float,
    HmmClasses,
    Observations,
    OccupancyHmm,
    SurfelMap,
    collect_observations,
    iter_chunks,
    probability_in_cell,
    surfel_cells,
)
from stillmap.em.options import EmOptions
from stillmap.em.spatial_prior import (
    GroundContact,
    make_ground_contact,
    pool_clusters,
    select_obstacles,
    smooth_mean_field,
)
from stillmap.em.types import CellProbabilities, EStepResult, Likelihood, NoReturnModel, fill_beams

_UNSEEN = 0.2  # probability that a cell is occupied in which no beam ended and none passed

_BELIEVED = 0.5  # trust in beams without a return from which on they show free space


def e_step(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    threads: int = 1,
    classes: HmmClasses = LOOP_CLASSES,
) -> EStepResult:
    """P(c = 1) of every beam: of its end cell being occupied by something that stays.

    Args:
        recording: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        resolution: m, edge of a cell.
        options: see EmOptions.
        threads: same result with any number.
        classes: see Classes.
    """
    looks = collect_observations(recording, poses, resolution, options, threads, classes)
    return label_beams(looks, None, recording, poses, options, threads)


def label_beams(
    looks: Observations,
    kept: NDArray[np.bool_] | None,
    recording: Recording,
    poses: Float,
    options: EmOptions,
    threads: int,
    static: NDArray[np.float32] | None = None,
    feet: GroundContact | None = None,
) -> EStepResult:
    """What the looks say of every cell, and with that of every beam that ended in it.

    kept (C,): under which of the classes; None: all. static (E,) is what is known better of each
    cell than these say, and with that of all cells. feet: what is known of beams that end on the
    ground below something that moves.
    """
    some = looks.under(kept, looks.sample())
    shares = fit_weights(some.likelihood, some.n_static, options.prior)
    found, likelihood = _of_elements(looks, kept, shares)
    share = shares.static if static is None else _mean(static, shares.static)
    static = found if static is None else static
    surface, T_map_sensor = looks.surface, recording.T_map_sensor(poses)
    beyond = options.dwell.beyond if looks.trust >= _BELIEVED else float("inf")
    return EStepResult(
        p_static=_of_beams(recording, T_map_sensor, surface, static, share, threads, feet),
        likelihood=likelihood,
        occupied=CellProbabilities(
            surfel_cells(surface), static * probability_in_cell(surface), _UNSEEN
        ),
        learned=_learned(looks, some, shares) | {"p_static": share},
        no_return=NoReturnModel(looks.dwell.solid(), beyond),
    )


def _mean(static: NDArray[np.float32], of_none: float) -> float:
    return float(np.mean(static, dtype=np.float64)) if len(static) else of_none


def _of_beams(
    recording: Recording,
    T_map_sensor: Float,
    surface: SurfelMap,
    static: NDArray[np.float32],
    prior: float,
    threads: int,
    feet: GroundContact | None,
) -> NDArray[np.float32]:
    """(M,) what is known (E,) of the element that each beam ended in."""
    found = np.append(static, np.float32(prior))  # -1: no element
    e = recording.allocate_per_beam(np.float32)
    for scans, beams, offset in iter_chunks(recording, release=[e]):
        points, hit = recording.points[beams], recording.hit[beams]
        element = surface.elements_of(points, hit, offset, T_map_sensor[scans], threads)
        known = fill_beams(points, hit, found.take(element), prior)
        if feet is not None:
            over = feet.of(points, hit, offset, T_map_sensor[scans], element, threads)
            known = np.where(np.isnan(over), known, over)
        e[beams] = known
    return e


def _of_elements(
    looks: Observations, kept: NDArray[np.bool_] | None, shares: MixtureWeights
) -> tuple[NDArray[np.float32], Likelihood]:
    """(E,) P(static) by the classes alone, and the bound."""
    static, bound, entropy = np.empty(looks.surface.size, np.float32), 0.0, 0.0
    for rows in looks.blocks():
        table = looks.under(kept, rows)
        static[slice(*rows)] = posterior_static(table.likelihood, shares.classes, table.n_static)
        joint = table.likelihood * shares.classes
        evidence = joint.sum(axis=1)
        r = joint / evidence[:, None]
        entropy -= float(np.sum(r * np.log(np.maximum(r, 1e-30))))
        bound += float(np.sum(np.log(evidence) + table.log_best))
    return static, Likelihood(expected=bound - entropy, bound=bound)


def _learned(
    looks: Observations, table: ClassLikelihoods, shares: MixtureWeights
) -> dict[str, object]:
    static, movers = slice(None, table.n_static), slice(table.n_static, None)
    return {
        "scatter": looks.surface.scatter,
        "p_static": shares.static,
        "no_return_trusted": round(looks.trust, 6),
        "static_occupied": _shares_of(table.rho[static], shares.classes[static]),
        "mover_occupied": _shares_of(table.rho[movers], shares.classes[movers]),
        "mover_seconds": _shares_of(table.tau[movers], shares.classes[movers]),
    }


def _shares_of(values: Float, shares: Float) -> list[dict[str, float]]:
    """The share of each value among these classes."""
    of = shares / shares.sum()
    return [
        {"value": float(v), "share": round(float(of[values == v].sum()), 6)}
        for v in dict.fromkeys(values.tolist())
    ]


_CLASSES_3D = HmmClasses(mover_seconds=(0.5, 3.0, 6.0, 12.0), often_seconds=(8.0, 24.0))


def e_step_3d(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> EStepResult:
    """P(c = 1) of every beam: of its end cell being occupied by something that was never away.

    Args: see `dwell.e_step`. Without `changes.enabled` it is that one. With `changes.in_space`
    it also says where things came or left.
    """
    if not options.changes.enabled:
        return e_step(recording, poses, resolution, options, threads)

    listed = options.changes.in_space

    def prepare(dwell: OccupancyHmm) -> None:
        track_changes(dwell, recording, options, courses=listed)

    looks = collect_observations(
        recording, poses, resolution, options, threads, _CLASSES_3D, prepare
    )
    told = label_cells(looks, options)
    static = smooth_mean_field(told.p_static, looks.surface, options.beside, threads)
    T_map_sensor = recording.T_map_sensor(poses)
    ground = ground_from_surfels(looks.surface, static, T_map_sensor[:, :3, 3])
    standing = select_obstacles(ground, looks.surface, options.bodies)
    static = pool_clusters(
        static, told.change, standing, recording, T_map_sensor, options.bodies, threads
    )
    feet = make_ground_contact(standing, static, options.bodies)
    found = label_beams(looks, None, recording, poses, options, threads, static, feet)
    return replace(
        found,
        learned={**found.learned, "changing": round(told.share, 6)},
        changed_cells=select_changed_cells(decode_histories(looks, options)) if listed else None,
        ground=ground,
    )


_CROWDED = 0.15  # share of the time in which somebody is where many pass

_SECONDS = 3.0

_WAITING = 6.0  # s, of no use for labels

_FINAL_CLASSES = HmmClasses(
    views_occupied=(0.65,),
    mover_occupied=(0.01, 0.04, _CROWDED),
    mover_seconds=(0.5, _SECONDS, _WAITING, 12.0, 45.0),
    often_seconds=(8.0, 24.0),
)


def final_e_step(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int = 1
) -> tuple[EStepResult | None, CellHistories | None]:
    """Labels with what is met from some places only, and what became of each cell.

    Args: see `dwell.e_step`.

    Returns:
        what is static, None without `dwell.views`; the courses of the same cells, None without
        `changes.enabled`.
    """

    def prepare(dwell: OccupancyHmm) -> None:
        if options.changes.enabled:
            track_changes(dwell, recording, options)

    views = options.dwell.views
    classes = _FINAL_CLASSES if views else replace(_FINAL_CLASSES, views_occupied=())
    looks = collect_observations(recording, poses, resolution, options, threads, classes, prepare)
    found = None
    if views:
        found = label_beams(looks, _for_labels(looks), recording, poses, options, threads)
    return found, decode_histories(looks, options) if options.changes.enabled else None


def _for_labels(looks: Observations) -> NDArray[np.bool_]:
    """(C,) without crowds of some seconds: these are what a chair is that a robot passes."""
    crowds = (looks.rho == _CROWDED) & (looks.tau == _SECONDS)
    kept = ~crowds & (looks.tau != _WAITING) & (looks.rho != HALF_TIME_RHO)
    kept[: looks.n_static] = True
    return np.asarray(kept)
