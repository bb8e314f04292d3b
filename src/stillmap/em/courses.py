"""The last E-step: things that came to stay, or left, while others passed."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillmap.em.dwell import Classes, Dwell, Float, Looks, expectations, looked_at
from stillmap.em.expectations import Expectations
from stillmap.em.mixture import fit_shares, posterior_static
from stillmap.em.options import ChangeOptions, EmOptions
from stillmap.recording.model import Recording

MapState = Literal["last", "majority"]

# who stays for longer than these came to stay: what is there for minutes is told by its course
_CLASSES = Classes(mover_occupied=(0.01, 0.04, 0.15, 0.5), mover_seconds=(0.5, 3.0, 8.0, 24.0))
_OFTEN_THERE = 0.5  # of these shares: what is there so often is a thing that comes and goes
_MOST_NATS = 60.0  # by which one likelihood may exceed another: more is the same
OFTEN = 3  # changes from which on a place is one that comes and goes, as doors do


@dataclass(frozen=True, eq=False)
class Courses:
    """What became of E cells in which beams ended, each by its most probable course.

    Attributes:
        cells: (E, D) int64.
        p_static: (E,) float32, probability that what is there never left.
        p_changing: (E,) float32, that things came to stay, left, or come and go.
        p_thing: (E,) float32, that one stood there at the last look, if so.
        occupied_share: (E,) float32, share of the time in which the cell was not empty, from its
            first look to the last.
        count: (E,) int32, how often a thing came or left.
        between: (E, 2, 2) int32, looks before and after the first and the last of these changes;
            -1: there was none.
    """

    cells: NDArray[np.int64]
    p_static: NDArray[np.float32]
    p_changing: NDArray[np.float32]
    p_thing: NDArray[np.float32]
    occupied_share: NDArray[np.float32]
    count: NDArray[np.int32]
    between: NDArray[np.int32]

    def shown(self, state: MapState) -> NDArray[np.float32]:
        """(E,) probability that the map has something there.

        In its last state, what comes and goes is not there: nobody knows for how long.
        """
        last = np.where(self.count < OFTEN, self.p_thing, np.float32(0.0))
        there = last if state == "last" else (self.occupied_share > 0.5).astype(np.float32)
        return np.asarray(np.minimum(self.p_static + self.p_changing * there, 1.0), np.float32)


def last_e_step(
    recording: Recording,
    poses: Float,
    resolution: float,
    options: EmOptions,
    state: MapState,
    threads: int = 1,
) -> tuple[Expectations, Courses]:
    """The E-step once more, with one more class: what came to stay or left.

    A beam's p_static is the probability that the map in this state shows what it met, so labels
    follow from the map.

    Args: see `dwell.e_step`; `state` says which state of places that changed is the map's.
    """
    T_map_sensor = recording.T_map_sensor(poses)

    def watch(dwell: Dwell) -> None:
        dwell.watch(**_model(options))

    looks = looked_at(recording, T_map_sensor, resolution, options, threads, _CLASSES, watch)
    log_changing, occupied_share, p_last, count, between = looks.dwell.changes()
    looks = _with_changing(looks, log_changing)
    n = looks.classes.n_static
    shares = fit_shares(looks.likelihood, n, options.prior)
    weights = shares.classes.astype(np.float32)
    often = [k for k, rho in enumerate(looks.classes.grid()[0]) if rho == _OFTEN_THERE]
    stays = looks.likelihood[:, -1] * weights[-1]
    goes = np.einsum("kc,c->k", looks.likelihood[:, often], weights[often])
    of = (goes > stays).astype(np.intp)  # what comes and goes does not stay long enough for a thing
    each = np.arange(len(of))
    courses = Courses(
        cells=looks.surface.elements()[0],
        p_static=posterior_static(looks.likelihood, shares.classes, n),
        p_changing=(stays + goes) / np.einsum("kc,c->k", looks.likelihood, weights),
        p_thing=p_last[each, of],
        occupied_share=occupied_share,
        count=count[each, of],
        between=between[each, of],
    )
    found = expectations(
        recording, T_map_sensor, looks, shares, courses.shown(state), options, threads
    )
    found.learned["changing"] = round(float(shares.classes[-1]), 6)
    return found, courses


def _model(options: EmOptions) -> dict[str, float]:
    changes: ChangeOptions = options.changes
    return {
        # a thing stays for 2 tau on average, and its place is free as long
        "tau": 0.5 * changes.stays,
        "passing_occupied": changes.passing_occupied,
        "passing_tau": changes.passing_seconds,
        "detection": options.dwell.detection,
    }


def _with_changing(looks: Looks, log_changing: Float) -> Looks:
    """The likelihoods with that of the changing class as their last column, relative as before."""
    above = np.minimum(log_changing - looks.log_best, _MOST_NATS)
    best = np.maximum(above, 0.0)
    table = np.column_stack([looks.likelihood, np.exp(above).astype(np.float32)])
    table /= np.exp(best).astype(np.float32)[:, None]
    return Looks(
        looks.surface, looks.dwell, looks.trust, table, looks.log_best + best, looks.classes
    )
