"""Change points of cells: Viterbi paths of the change HMM.

Its three states are object, empty and passer-by. `docs/estimator/changes.md` has the
three-state HMM.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em.mixture import fit_weights, posterior
from stillmap.em.observations import (
    HALF_TIME_RHO,
    Observations,
    OccupancyHmm,
    Rows,
    SurfelMap,
    iter_surfel_rows,
    probability_in_cell,
    surfel_cells,
)
from stillmap.em.options import EmOptions, MapState
from stillmap.em.spatial_prior import connected_components, neighbor_pairs
from stillmap.em.types import MIN_PROBABILITY, ChangedCells, Float

_STATE_DURATION = 2.0  # mean duration of a state, in units of the recording's length
_MAX_STATE_DURATION = 3600.0  # s
_PASSER_BY_RHO, _PASSER_BY_TAU = 0.05, 12.0  # share of the time, and correlation time in s

_MAX_DYNAMIC_TAU = 12.0  # s, of the dynamic classes: what stays longer is an object
_MAX_LOG_RATIO = 60.0  # nats, upper bound of the log likelihood ratio of change HMM to best class
_MAX_CHANGE = 4.0  # nats, bound of one surfel's log likelihood ratio of changed to static
_MIN_LIKELIHOOD = 1e-30
_MIN_P_CHANGED = 0.02  # cells below are not grouped

_GROUP_RADIUS = 3.0  # cells between cells of one object
_GROUP_BINS = 4  # maximum difference, in time bins, of the change times of cells of one object
_MIN_GROUP = 4  # cells
_DECIDING_SHARE = 1.0 / 3.0  # a group takes the P(changing) that this share of its cells reaches

_MIN_LOG_RATIO = 1.0  # nats, minimum gain in log odds of a listed 3D cell over the prior

MIN_RECURRING_CHANGES = 3  # changes from which on something comes and goes, as doors do


@dataclass(frozen=True, eq=False)
class CellHistories:
    """Most probable state paths of E cells in which beams ended.

    Attributes:
        cells: (E, D) int64.
        p_static: (E,) float32, probability of surface that never left and is seen from all sides.
        p_view_dependent: (E,) float32, of surface that never left and is seen from some sides.
        p_changing: (E,) float32, P(changing): objects arrived, left, or come and go.
        p_object: (E,) float32, P(an object is present at the last observation | changing).
        occupied_share: (E,) float32, share of the time between the first and the last observation
            in which the cell was not empty.
        n_changes: (E,) int32, number of arrivals and departures.
        change_bins: (E, 2, 2) int32, time bins of the observations before and after the first and
            the last change; -1: there was none.
        p_in_cell: (E,) float32, probability that the surface runs through the cell itself.
        changing_weight: weight of the change HMM in the mixture.
        surfel_map: the cells as surfels.
    """

    cells: NDArray[np.int64]
    p_static: NDArray[np.float32]
    p_view_dependent: NDArray[np.float32]
    p_changing: NDArray[np.float32]
    p_object: NDArray[np.float32]
    occupied_share: NDArray[np.float32]
    n_changes: NDArray[np.int32]
    change_bins: NDArray[np.int32]
    p_in_cell: NDArray[np.float32]
    changing_weight: float
    surfel_map: SurfelMap

    @property
    def p_unchanged(self) -> NDArray[np.float32]:
        """(E,) probability of surface that never left."""
        return self.p_static + self.p_view_dependent

    def p_in_map(self, state: MapState) -> NDArray[np.float32]:
        """(E,) probability that a map of changed places in that state has something in the cell.

        In the last state, what comes and goes is absent: its present state is unknown.
        """
        last = np.where(self.n_changes < MIN_RECURRING_CHANGES, self.p_object, np.float32(0.0))
        there = last if state == "last" else (self.occupied_share > 0.5).astype(np.float32)
        # conditional on the cell not being view-dependent
        seen = np.maximum(1.0 - self.p_view_dependent, _MIN_P_CHANGED)
        p = (self.p_static + self.p_changing * there) / seen
        return np.asarray(np.minimum(p, 1.0), np.float32)


def track_changes(
    hmm: OccupancyHmm, recording: Recording, options: EmOptions, with_paths: bool = True
) -> None:
    """Adds the change HMM to the filters, before the first observation.

    Without paths only its likelihood is computed, which `label_cells` needs.
    """
    seconds = 1e-9 * float(np.ptp(recording.stamp_ns))
    duration = float(np.clip(_STATE_DURATION * seconds, 1.0, _MAX_STATE_DURATION))
    hmm.track_changes(
        tau=0.5 * duration,  # the mean duration of a state is 2 tau
        passer_by_rho=_PASSER_BY_RHO,
        passer_by_tau=_PASSER_BY_TAU,
        p_detection=options.p_detection,
        with_paths=with_paths,
    )


def decode_histories(seen: Observations, options: EmOptions) -> CellHistories:
    """The most probable path of each cell; `track_changes` was called before the observations."""
    groups, weights = _class_groups(seen), _fit_weights(seen, options)
    blocks = [
        _decode_rows(seen, rows, groups, weights) for rows in iter_surfel_rows(seen.surfel_map)
    ]
    columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    return _group_cells(
        CellHistories(
            cells=surfel_cells(seen.surfel_map),
            **columns,
            p_in_cell=probability_in_cell(seen.surfel_map),
            changing_weight=float(weights[-1]),
            surfel_map=seen.surfel_map,
        )
    )


class CellLabels(NamedTuple):
    """Labels of E surfels with the change HMM among the classes.

    Attributes:
        p_static: (E,) float32, see CellHistories.
        change: (E,) float32 nats, log likelihood ratio of changed to static, within +-4.
        changing_weight: see CellHistories.
    """

    p_static: NDArray[np.float32]
    change: NDArray[np.float32]
    changing_weight: float


def label_cells(seen: Observations, options: EmOptions) -> CellLabels:
    """Labels of each surfel; `track_changes` was called before the observations."""
    (static, *_, changing), weights = _class_groups(seen), _fit_weights(seen, options)
    p_static, change = np.empty((2, seen.surfel_map.size), np.float32)
    for rows in iter_surfel_rows(seen.surfel_map):
        likelihood = _likelihood(seen, rows)
        p_static[slice(*rows)] = posterior(likelihood, weights, static)
        log_changed, log_static = (
            np.log(np.maximum(_mean_likelihood(likelihood, weights, of), _MIN_LIKELIHOOD))
            for of in (changing, static)
        )
        change[slice(*rows)] = np.clip(log_changed - log_static, -_MAX_CHANGE, _MAX_CHANGE)
    return CellLabels(p_static, change, float(weights[-1]))


def _mean_likelihood(
    likelihood: NDArray[np.float32], weights: Float, among: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """(K,) likelihood under some classes (C,), averaged by their weights."""
    w = np.where(among, weights, 0.0) / max(float(weights[among].sum()), _MIN_LIKELIHOOD)
    return np.asarray(np.einsum("kc,c->k", likelihood, w.astype(np.float32)), np.float32)


def _classes(seen: Observations) -> NDArray[np.bool_]:
    """(C,) classes beside the change HMM: without dynamic ones that stay as long as objects."""
    kept = (seen.tau <= _MAX_DYNAMIC_TAU) | (seen.rho == HALF_TIME_RHO)
    kept[: seen.n_static] = True
    return np.asarray(kept)


def _class_groups(seen: Observations) -> tuple[NDArray[np.bool_], ...]:
    """(C + 1,) masks: static, view-dependent, half-time classes, and the change HMM."""
    kept = _classes(seen)
    view = np.append(np.isfinite(seen.view_angle[kept]), False)
    static = np.arange(len(view)) < seen.n_static
    half_time = np.append(seen.rho[kept] == HALF_TIME_RHO, False)
    return static & ~view, view, half_time, np.arange(len(view)) == len(view) - 1


def _likelihood(seen: Observations, rows: Rows) -> NDArray[np.float32]:
    """(E, C + 1) of some surfels under these classes and the change HMM, relative to the best."""
    likelihood, log_best = seen.likelihood(_classes(seen), rows)
    log_ratio = np.minimum(seen.hmm.change_log_likelihood(rows) - log_best, _MAX_LOG_RATIO)
    table = np.column_stack([likelihood, np.exp(log_ratio).astype(np.float32)])
    table /= np.exp(np.maximum(log_ratio, 0.0)).astype(np.float32)[:, None]
    return table


def _fit_weights(seen: Observations, options: EmOptions) -> Float:
    """(C + 1,) weights of these classes and the change HMM."""
    likelihood = _likelihood(seen, seen.sample_rows())
    return fit_weights(likelihood, seen.n_static, options.prior).classes


def _decode_rows(
    seen: Observations, rows: Rows, groups: tuple[NDArray[np.bool_], ...], weights: Float
) -> dict[str, NDArray[Any]]:
    """Columns of CellHistories for some surfels."""
    likelihood = _likelihood(seen, rows)
    _, occupied_share, p_last, n_changes, change_bins = seen.hmm.changes(rows)
    static, view, half_time, changing = (posterior(likelihood, weights, of) for of in groups)
    # index 0: changes of objects only; 1: of occupancy, passers-by included. In half-time cells
    # objects stay too briefly for the object state
    of = (half_time > changing).astype(np.intp)
    each = np.arange(len(of))
    return {
        "p_static": static,
        "p_view_dependent": view,
        "p_changing": np.minimum(changing + half_time, np.float32(1.0)),
        "p_object": p_last[each, of],
        "occupied_share": occupied_share,
        "n_changes": n_changes[each, of],
        "change_bins": change_bins[each, of],
    }


def _group_cells(cells: CellHistories) -> CellHistories:
    """Gives neighbouring cells with the same change one P(changing): the upper-third quantile."""
    of = np.flatnonzero(
        (cells.n_changes > 0)
        & (cells.n_changes < MIN_RECURRING_CHANGES)
        & (cells.p_changing > _MIN_P_CHANGED)
        & (cells.p_unchanged < 0.5)
    )
    pairs = neighbor_pairs(cells.cells[of], _GROUP_RADIUS)
    i, j = pairs.T
    before, after = cells.change_bins[of, 1].T
    arrived = cells.p_object[of] > 0.5
    at_once = np.maximum(before[i], before[j]) < np.minimum(after[i], after[j]) + _GROUP_BINS
    p_changing = cells.p_changing.copy()
    for members in connected_components(pairs[at_once & (arrived[i] == arrived[j])], len(of)):
        if len(members) >= _MIN_GROUP:
            group = of[members]
            decided = np.quantile(p_changing[group], 1.0 - _DECIDING_SHARE, method="lower")
            p_changing[group] = np.minimum(decided, 1.0 - cells.p_unchanged[group])
    return dataclasses.replace(cells, p_changing=p_changing)


def select_changed_cells(cells: CellHistories) -> ChangedCells:
    """The cells that a change explains better, relative to the weight of changes among all cells.

    A car that parks and leaves is some hundred cells in a million: each alone is more probably
    static surface that was missed for a while.
    """
    odds = _log_odds(cells.p_changing) - _log_odds(np.array([cells.changing_weight]))
    of = np.flatnonzero(
        (cells.n_changes > 0) & (cells.n_changes < MIN_RECURRING_CHANGES) & (odds > _MIN_LOG_RATIO)
    )
    return ChangedCells(
        cells.cells[of], cells.p_object[of], cells.n_changes[of], cells.change_bins[of]
    )


def _log_odds(p: NDArray[np.floating]) -> NDArray[np.float64]:
    kept = np.clip(p.astype(np.float64), MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    return np.asarray(np.log(kept / (1.0 - kept)))
