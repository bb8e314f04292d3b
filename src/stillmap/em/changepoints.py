"""Things that came to stay, or left, while others passed: from the looks of the last E-step.

Cells of a recording in space that tell of something that came to stay, or left.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em.mixture import fit_weights
from stillmap.em.observations import (
    HALF_TIME_RHO,
    ClassLikelihoods,
    Float,
    Observations,
    OccupancyHmm,
    Rows,
    SurfelMap,
    probability_in_cell,
    surfel_cells,
)
from stillmap.em.options import ChangeOptions, EmOptions, MapState
from stillmap.em.spatial_prior import connected_components, neighbor_pairs
from stillmap.em.types import ChangedCells

_STAY = 12.0  # s, who stays for longer came to stay

_MOST_NATS = 60.0  # by which one likelihood may exceed another: more is the same

_MOST_TOLD = 4.0  # nats that the looks at one element tell of a change

_LEAST = 1e-30  # likelihood that is none

_POSSIBLE = 0.02  # probability of having changed below which a cell has no say

_BESIDE = 3.0  # cells

_LOOKS_APART = 4  # looks by which the cells of one thing may seem to change apart

_WHOLE = 4  # cells that make a thing

_DECIDE = 1.0 / 3.0  # share of its cells that decide whether it changed

MIN_RECURRING_CHANGES = 3  # changes from which on a place is one that comes and goes, as doors do


@dataclass(frozen=True, eq=False)
class CellHistories:
    """What became of E cells in which beams ended, each by its most probable course.

    Attributes:
        cells: (E, D) int64.
        p_static: (E,) float32, probability that what is there never left and is met all around.
        p_views: (E,) float32, that it never left and is met from some places only.
        p_changing: (E,) float32, that things came to stay, left, or come and go.
        p_thing: (E,) float32, that one stood there at the last look, if so.
        occupied_share: (E,) float32, share of the time in which the cell was not empty, from its
            first look to the last.
        count: (E,) int32, how often a thing came or left.
        between: (E, 2, 2) int32, looks before and after the first and the last of these changes;
            -1: there was none.
        covered: (E,) float32, probability that what is there runs through the cell itself.
        share: of the cells, in which things came to stay or left.
        surface: the cells as elements, for beams to be asked which they ended in.
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
        """(E,) probability that what is there never left."""
        return self.p_static + self.p_view_dependent

    def p_in_map(self, state: MapState) -> NDArray[np.float32]:
        """(E,) probability that the map has something there.

        In its last state, what comes and goes is not there: nobody knows for how long. It is asked
        of places that are known to have changed, where it was not the view that did.
        """
        last = np.where(self.n_changes < MIN_RECURRING_CHANGES, self.p_object, np.float32(0.0))
        there = last if state == "last" else (self.occupied_share > 0.5).astype(np.float32)
        p = (self.p_static + self.p_changing * there) / np.maximum(
            1.0 - self.p_view_dependent, _POSSIBLE
        )
        return np.asarray(np.minimum(p, 1.0), np.float32)


def track_changes(
    dwell: OccupancyHmm, recording: Recording, options: EmOptions, courses: bool = True
) -> None:
    """Asks, before the first look, for things that come to stay or leave.

    Without `courses` only for whether they do: `told_of` wants no more.
    """
    dwell.track_changes(**_model(recording, options), with_paths=courses)


def decode_histories(looks: Observations, options: EmOptions) -> CellHistories:
    """What became of each cell; `watch` was called before the looks."""
    groups, shares = _groups(looks), _shares(looks, options)
    found = [_of_rows(looks, rows, groups, shares) for rows in looks.blocks()]
    of_all = {name: np.concatenate([one[name] for one in found]) for name in found[0]}
    return _as_wholes(
        CellHistories(
            cells=surfel_cells(looks.surface),
            **of_all,
            p_in_cell=probability_in_cell(looks.surface),
            changing_weight=float(shares[-1]),
            surfel_map=looks.surface,
        )
    )


class CellLabels(NamedTuple):
    """What the looks at E elements say, each by itself.

    Attributes:
        p_static: (E,) float32, see Courses.
        change: (E,) float32 nats by which what was seen is likelier if a thing came to stay, or
            left, than if what is there never did; `_MOST_TOLD` at most, for or against.
        share: see Courses.
    """

    p_static: NDArray[np.float32]
    change: NDArray[np.float32]
    share: float


def label_cells(looks: Observations, options: EmOptions) -> CellLabels:
    """What of the courses a label follows from; `watch` was called before the looks."""
    (static, *_, changing), shares = _groups(looks), _shares(looks, options)
    p, change = np.empty((2, looks.surface.size), np.float32)
    for rows in looks.blocks():
        likelihood = _likelihood(looks, rows)
        p[slice(*rows)] = _posterior(likelihood, shares, static)
        known = (_under(likelihood, shares, of) for of in (changing, static))
        came, stayed = (np.log(np.maximum(one, _LEAST)) for one in known)
        change[slice(*rows)] = np.clip(came - stayed, -_MOST_TOLD, _MOST_TOLD)
    return CellLabels(p, change, float(shares[-1]))


def _under(
    likelihood: NDArray[np.float32], shares: Float, among: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """(K,) likelihood under some classes (C,), each by its share of these."""
    weights = np.where(among, shares, 0.0) / max(float(shares[among].sum()), _LEAST)
    return np.asarray(np.einsum("kc,c->k", likelihood, weights.astype(np.float32)), np.float32)


def _kept(looks: Observations) -> NDArray[np.bool_]:
    """(C,) classes that leave room for things that stay."""
    kept = (looks.tau <= _STAY) | (looks.rho == HALF_TIME_RHO)
    kept[: looks.n_static] = True
    return np.asarray(kept)


def _groups(looks: Observations) -> tuple[NDArray[np.bool_], ...]:
    """(C + 1,) of those and of the changing class: static, by views, often, changing."""
    kept = _kept(looks)
    views = np.append(np.isfinite(looks.turn[kept]), False)
    static = np.arange(len(views)) < looks.n_static
    often = np.append(looks.rho[kept] == HALF_TIME_RHO, False)
    return static & ~views, views, often, np.arange(len(views)) == len(views) - 1


def _likelihood(looks: Observations, rows: Rows) -> NDArray[np.float32]:
    """(n, C + 1) of some elements under each of these classes."""
    return _with_changing(looks.under(_kept(looks), rows), looks.dwell.change_log_likelihood(rows))


def _shares(looks: Observations, options: EmOptions) -> Float:
    """(C + 1,) of these classes."""
    return fit_weights(_likelihood(looks, looks.sample()), looks.n_static, options.prior).classes


def _of_rows(
    looks: Observations, rows: Rows, groups: tuple[NDArray[np.bool_], ...], shares: Float
) -> dict[str, NDArray[Any]]:
    """What Courses says of each of some elements."""
    likelihood = _likelihood(looks, rows)
    _, occupied_share, p_last, count, between = looks.dwell.changes(rows)
    static, views, goes, stays = (_posterior(likelihood, shares, some) for some in groups)
    of = (goes > stays).astype(np.intp)  # what comes and goes does not stay long enough for a thing
    each = np.arange(len(of))
    return {
        "p_static": static,
        "p_views": views,
        "p_changing": np.minimum(stays + goes, np.float32(1.0)),
        "p_thing": p_last[each, of],
        "occupied_share": occupied_share,
        "count": count[each, of],
        "between": between[each, of],
    }


def _posterior(
    likelihood: NDArray[np.float32], shares: Float, among: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """(K,) probability that each member belongs to one of some classes (C,)."""
    weights = shares.astype(np.float32)
    found, others = (
        np.einsum("kc,c->k", likelihood, np.where(some, weights, np.float32(0.0)))
        for some in (among, ~among)
    )
    return np.asarray(found / (found + others), np.float32)


def _as_wholes(courses: CellHistories) -> CellHistories:
    """Cells side by side that changed alike are of one thing: a third of them decides for all."""
    of = np.flatnonzero(
        (courses.n_changes > 0)
        & (courses.n_changes < MIN_RECURRING_CHANGES)
        & (courses.p_changing > _POSSIBLE)
        & (courses.p_unchanged < 0.5)
    )
    pairs = neighbor_pairs(courses.cells[of], _BESIDE)
    i, j = pairs.T
    before, after = courses.change_bins[of, 1].T
    came = courses.p_object[of] > 0.5
    at_once = np.maximum(before[i], before[j]) < np.minimum(after[i], after[j]) + _LOOKS_APART
    p_changing = courses.p_changing.copy()
    for one in connected_components(pairs[at_once & (came[i] == came[j])], len(of)):
        if len(one) >= _WHOLE:
            cells = of[one]
            decided = np.quantile(p_changing[cells], 1.0 - _DECIDE, method="lower")
            p_changing[cells] = np.minimum(decided, 1.0 - courses.p_unchanged[cells])
    return dataclasses.replace(courses, p_changing=p_changing)


def _model(recording: Recording, options: EmOptions) -> dict[str, float]:
    changes: ChangeOptions = options.changes
    seconds = 1e-9 * float(np.ptp(recording.stamp_ns))
    stays = float(np.clip(changes.stays * seconds, 1.0, changes.longest))
    return {
        # a thing stays for 2 tau on average, and its place is free as long
        "tau": 0.5 * stays,
        "passer_by_rho": changes.passing_occupied,
        "passer_by_tau": changes.passing_seconds,
        "p_detection": options.dwell.detection,
    }


def _with_changing(seen: ClassLikelihoods, change_log_likelihood: Float) -> NDArray[np.float32]:
    """(E, C + 1) the likelihoods with that of the changing class last, relative as before."""
    above = np.minimum(change_log_likelihood - seen.log_best, _MOST_NATS)
    table = np.column_stack([seen.likelihood, np.exp(above).astype(np.float32)])
    table /= np.exp(np.maximum(above, 0.0)).astype(np.float32)[:, None]
    return table


_TELLS = 1.0  # nats by which a change explains what was seen of a cell better than all else

_SURE = 1e-6  # probabilities keep so far from 0 and 1


def select_changed_cells(courses: CellHistories) -> ChangedCells:
    """The cells that a change explains better, whatever share of all cells changed.

    A car that parks and leaves is some hundred cells among a million: each of them alone is more
    probably something that stands still and was missed for a while.
    """
    odds = _log_odds(courses.p_changing) - _log_odds(np.array([courses.changing_weight]))
    of = np.flatnonzero(
        (courses.n_changes > 0) & (courses.n_changes < MIN_RECURRING_CHANGES) & (odds > _TELLS)
    )
    return ChangedCells(
        courses.cells[of], courses.p_object[of], courses.n_changes[of], courses.change_bins[of]
    )


def _log_odds(p: NDArray[np.floating]) -> NDArray[np.float64]:
    kept = np.clip(p.astype(np.float64), _SURE, 1.0 - _SURE)
    return np.asarray(np.log(kept / (1.0 - kept)))
