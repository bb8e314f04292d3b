"""Change points of cells: Viterbi paths of the change HMM.

Its three states are object, empty and passer-by. `docs/estimator.md` has the
three-state HMM.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.core.square_box import connected_components, neighbor_pairs
from stillmap.em.mixture import fit_weights, posterior
from stillmap.em.observations import (
    HALF_TIME_RHO,
    P_DETECTION,
    Observations,
    Rows,
    SurfelMap,
    iter_surfel_rows,
    probability_in_cell,
    surfel_cells,
)
from stillmap.em.options import EmOptions, MapState
from stillmap.em.types import MIN_PROBABILITY, ChangedCells

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
class CellHistories(ChangedCells):
    """Most probable state paths of all E cells in which beams ended, changed or not.

    Attributes, besides those of ChangedCells (p_object given that the cell changed):
        p_static: (E,) float32, probability of surface that never left and is seen from all sides.
        p_view_dependent: (E,) float32, of surface that never left and is seen from some sides.
        p_changing: (E,) float32, P(changing): objects arrived, left, or come and go.
        occupied_share: (E,) float32, share of the time between the first and the last observation
            in which the cell was not empty.
        p_in_cell: (E,) float32, probability that the surface runs through the cell itself.
        changing_weight: weight of the change HMM in the mixture.
        surfel_map: the cells as surfels.
    """

    p_static: Float32
    p_view_dependent: Float32
    p_changing: Float32
    occupied_share: Float32
    p_in_cell: Float32
    changing_weight: float
    surfel_map: SurfelMap

    @property
    def p_unchanged(self) -> Float32:
        """(E,) probability of surface that never left."""
        return self.p_static + self.p_view_dependent

    @property
    def unchanged_cells(self) -> Int64:
        """(U, 2) those that more probably than not hold surface that never left."""
        return self.cells[self.p_unchanged > 0.5]

    def share_there(self, state: MapState) -> Float32:
        """(E,) probability that an object is in the cell at last, or its share of the time.

        Of states of doors, the last one.

        In the last state, what comes and goes is absent: its present state is unknown.
        """
        if state == "majority":
            return self.occupied_share
        return np.where(self.n_changes < MIN_RECURRING_CHANGES, self.p_object, np.float32(0.0))

    def p_in_map(self, state: MapState, share: Float32 | None = None) -> Float32:
        """(E,) probability that a map of changed places in that state has something in the cell.

        Args:
            state: state that the map shows.
            share: (E,) in place of `share_there`.
        """
        share = self.share_there(state) if share is None else share
        there = (share > 0.5).astype(np.float32) if state == "majority" else share
        # conditional on the cell not being view-dependent
        visible = np.maximum(1.0 - self.p_view_dependent, _MIN_P_CHANGED)
        p = (self.p_static + self.p_changing * there) / visible
        return np.asarray(np.minimum(p, 1.0), np.float32)


def change_parameters(recording: Recording, with_paths: bool = True) -> dict[str, Any]:
    """Parameters of the change HMM; see `collect_observations`.

    Without paths only its likelihood is computed, which `label_surfels` needs.
    """
    seconds = 1e-9 * float(np.ptp(recording.stamp_ns))
    duration = float(np.clip(_STATE_DURATION * seconds, 1.0, _MAX_STATE_DURATION))
    return {
        "tau": 0.5 * duration,  # the mean duration of a state is 2 tau
        "passer_by_rho": _PASSER_BY_RHO,
        "passer_by_tau": _PASSER_BY_TAU,
        "p_detection": P_DETECTION,
        "with_paths": with_paths,
    }


def _arrange_classes(
    view: Bool, half_time: Bool, n_static: int, with_surroundings: bool
) -> tuple[int, Index, tuple[Bool, Bool, Bool, Bool]]:
    """The N classes of `ChangeMixture`: static ones first, the change HMM last.

    With surroundings there are two of each of the C classes of HMMs and the change HMM, in
    surroundings that last and in those that empty. What comes and goes, or changes, while its
    surroundings last is static: it was hit or passed by chance, by view or by an error of the pose.

    Args:
        view, half_time: (C,) masks of the classes of HMMs.
        n_static: number of static ones, which come first.
        with_surroundings: see above.

    Returns:
        number of static ones among the N; (N,) index among the 2 C + 2 columns of classes in
        lasting and in emptied surroundings; (N,) masks of static, view-dependent, half-time and
        changing classes, none of which overlap.
    """
    n = len(view) + 1
    columns, view, half_time = np.arange(n), np.append(view, False), np.append(half_time, False)
    if with_surroundings:
        fixed, changing = columns < n_static, columns == n - 1
        is_static = np.concatenate([fixed | half_time | changing, fixed])
        columns, n_static = np.argsort(~is_static, kind="stable"), int(is_static.sum())
    of, number = columns % n, np.arange(len(columns))
    static, view = number < n_static, view[of]
    return n_static, columns, (static & ~view, view, half_time[of] & ~static, number == len(of) - 1)


class ChangeMixture:
    """Mixture of classes with the change HMM as the last one, its weights fitted to observations.

    Args:
        observations: of E surfels, collected with the change HMM.
        options: see EmOptions.

    Attributes:
        changing_weight: weight of the change HMM.
    """

    def __init__(self, observations: Observations, options: EmOptions) -> None:
        rho, n_static = observations.rho, observations.n_static
        # dynamic classes that stay as long as objects are left to the change HMM
        kept = (observations.tau <= _MAX_DYNAMIC_TAU) | (rho == HALF_TIME_RHO)
        kept[:n_static] = True
        self._observations, self._kept = observations, kept
        n_static, self._columns, self._groups = _arrange_classes(
            np.isfinite(observations.view_angle[kept]),
            rho[kept] == HALF_TIME_RHO,
            n_static,
            observations.has_surroundings,
        )
        sample = self._likelihood(observations.sample_rows())
        self._weights = fit_weights(sample, n_static, options.prior)
        self.changing_weight = float(self._weights[-1])

    def _likelihood(self, rows: Rows) -> Float32:
        """(K, N) of some surfels, relative to the best class; the change HMM is bounded."""
        hmm = self._observations.hmm
        likelihood, log_best = self._observations.likelihood(self._kept, rows)
        log_ratio = np.minimum(hmm.change_log_likelihood(rows) - log_best, _MAX_LOG_RATIO)
        table = np.column_stack([likelihood, np.exp(log_ratio).astype(np.float32)])
        table /= np.exp(np.maximum(log_ratio, 0.0)).astype(np.float32)[:, None]
        if not self._observations.has_surroundings:
            return table
        lasting, empty = self._observations.likelihood_of_surroundings(rows).T
        both = np.concatenate([table * lasting[:, None], table * empty[:, None]], axis=1)
        return np.asarray(both[:, self._columns])

    def label_surfels(self) -> tuple[Float32, Float32]:
        """Labels of each surfel.

        Returns:
            p_static (E,), see CellHistories; log likelihood ratio (E,) of changed to static, in
            nats within +-4.
        """
        surfel_map = self._observations.surfel_map
        p_static, change = np.empty((2, surfel_map.size), np.float32)

        def process(rows: Rows) -> None:
            likelihood = self._likelihood(rows)
            p_static[slice(*rows)] = posterior(likelihood, self._weights, self._groups[0])
            log_changed, log_static = (
                np.log(np.maximum(_mean_likelihood(likelihood, self._weights, of), _MIN_LIKELIHOOD))
                for of in (self._groups[-1], self._groups[0])
            )
            change[slice(*rows)] = np.clip(log_changed - log_static, -_MAX_CHANGE, _MAX_CHANGE)

        blocks = map_ordered(process, iter_surfel_rows(surfel_map), self._observations.threads)
        for _ in blocks:
            pass
        return p_static, change

    def decode_histories(self) -> CellHistories:
        """The most probable path of each cell."""
        surfel_map = self._observations.surfel_map
        blocks = [self._decode_rows(rows) for rows in iter_surfel_rows(surfel_map)]
        columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
        return _group_cells(
            CellHistories(
                cells=surfel_cells(surfel_map),
                **columns,
                p_in_cell=probability_in_cell(surfel_map),
                changing_weight=self.changing_weight,
                surfel_map=surfel_map,
            )
        )

    def _decode_rows(self, rows: Rows) -> dict[str, NDArray[Any]]:
        """Columns of CellHistories for some surfels."""
        likelihood = self._likelihood(rows)
        static, view, half_time, changing = (
            posterior(likelihood, self._weights, of) for of in self._groups
        )
        _, occupied_share, p_last, n_changes, change_bins = self._observations.hmm.changes(rows)
        # index 0: changes of objects only; 1: of occupancy, passers-by included. In half-time cells
        # objects stay too briefly for the object state
        each, of = np.arange(len(static)), (half_time > changing).astype(np.intp)
        return {
            "p_static": static,
            "p_view_dependent": view,
            "p_changing": np.minimum(changing + half_time, np.float32(1.0)),
            "p_object": p_last[each, of],
            "occupied_share": occupied_share,
            "n_changes": n_changes[each, of],
            "change_bins": change_bins[each, of],
        }


def _mean_likelihood(likelihood: Float32, weights: Float, among: Bool) -> Float32:
    """(K,) likelihood under some classes (C,), averaged by their weights."""
    w = np.where(among, weights, 0.0) / max(float(weights[among].sum()), _MIN_LIKELIHOOD)
    return np.asarray(np.einsum("kc,c->k", likelihood, w.astype(np.float32)), np.float32)


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
    is_single = (cells.n_changes > 0) & (cells.n_changes < MIN_RECURRING_CHANGES)
    return cells.select(is_single & (odds > _MIN_LOG_RATIO))


def _log_odds(p: NDArray[np.floating]) -> Float:
    kept = np.clip(p.astype(np.float64), MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    return np.asarray(np.log(kept / (1.0 - kept)))
