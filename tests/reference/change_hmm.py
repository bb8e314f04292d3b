"""Change HMM: a three-state Markov chain (object, empty, passer-by) per cell."""

from dataclasses import dataclass
from itertools import pairwise
from math import exp, log

import numpy as np

Bins = tuple[int, int]

OBJECT, EMPTY, PASSER_BY = range(3)
NO_CHANGE = (-1, -1)


@dataclass(frozen=True)
class ChangeModel:
    """Transition and observation model of objects and passers-by.

    Attributes:
        tau: seconds; presence of objects has correlation exp(-dt / tau) and probability 1/2.
        passer_by_rho: stationary probability of a passer-by where there is no object.
        passer_by_tau: seconds, correlation time of passers-by.
        p_detection: probability that a reliable observation of an occupied cell is a hit.
    """

    tau: float
    passer_by_rho: float
    passer_by_tau: float
    p_detection: float

    @property
    def prior(self):
        """(3,) stationary distribution."""
        rho = self.passer_by_rho
        return np.array([0.5, 0.5 * (1.0 - rho), 0.5 * rho])

    def transition(self, dt):
        """(3, 3) from, to. Where an object leaves, passers-by are stationary."""
        rho = self.passer_by_rho
        stays = 0.5 + 0.5 * exp(-dt / self.tau)
        kept = exp(-dt / self.passer_by_tau)
        stationary = np.array([1.0 - rho, rho])
        passing = kept * np.eye(2) + (1.0 - kept) * np.stack([stationary, stationary])
        p = np.empty((3, 3))
        p[OBJECT] = [stays, *((1.0 - stays) * stationary)]
        p[1:, OBJECT] = 1.0 - stays
        p[1:, 1:] = stays * passing
        return p

    def likelihood(self, reliability):
        """(3,) likelihood of a hit (None), or of a miss of some reliability."""
        if reliability is None:
            return np.array([self.p_detection, 0.0, self.p_detection])
        missed = 1.0 - self.p_detection * reliability
        return np.array([missed, 1.0, missed])


@dataclass(frozen=True)
class ChangeSummary:
    """Changes of a cell; pairs hold values for objects alone, and for anything present.

    Attributes:
        log_likelihood: of the observations, given one hit.
        occupied_share: fraction of the time from first to last observation in which the Viterbi
            path is not empty; changes count at half the time between two observations.
        p_last: probability of presence at the last observation.
        count: number of changes on the Viterbi path.
        change_bins: time bins before and after the first and the last change, or NO_CHANGE.
    """

    log_likelihood: float
    occupied_share: float
    p_last: tuple[float, float]
    count: tuple[int, int]
    change_bins: tuple[tuple[Bins, Bins], tuple[Bins, Bins]]


def summarise_changes(observations, seconds, model):
    """Forward algorithm and Viterbi path over all observations.

    Args:
        observations: time bin, ascending, and reliability of each; None for a hit.
        seconds: width of a time bin.
        model: see ChangeModel.
    """
    with np.errstate(divide="ignore"):
        weight, best = model.prior, np.log(model.prior)
        total, before, came_from = 0.0, observations[0][0] if observations else 0, []
        for number, reliability in observations:
            p = model.transition((number - before) * seconds)
            likelihood = model.likelihood(reliability)
            weight = (weight @ p) * likelihood
            total += log(weight.sum())
            weight = weight / weight.sum()
            to = best[:, None] + np.log(p)
            came_from.append(to.argmax(axis=0))
            best = to.max(axis=0) + np.log(likelihood)
            before = number
    path = [int(best.argmax())]
    for back in reversed(came_from):
        path.append(int(back[path[-1]]))
    states, numbers = path[::-1][1:], [number for number, _ in observations]
    hit = (0.5 + 0.5 * model.passer_by_rho) * model.p_detection
    of_objects = _changes([state == OBJECT for state in states], numbers)
    of_any = _changes([state != EMPTY for state in states], numbers)
    return ChangeSummary(
        log_likelihood=total - log(hit),
        occupied_share=_share([state != EMPTY for state in (states or path)], numbers),
        p_last=(float(weight[OBJECT]), float(1.0 - weight[EMPTY])),
        count=(len(of_objects), len(of_any)),
        change_bins=(_ends(of_objects), _ends(of_any)),
    )


def _changes(there, numbers):
    return [
        (numbers[k - 1], numbers[k]) for k in range(1, len(numbers)) if there[k] != there[k - 1]
    ]


def _ends(turns):
    return (turns[0], turns[-1]) if turns else (NO_CHANGE, NO_CHANGE)


def _share(there, numbers):
    if len(numbers) < 2:
        return float(there[-1])
    halves = [0.5 * (a + b) for a, b in pairwise(there)]
    return float(np.sum(np.diff(numbers) * halves) / (numbers[-1] - numbers[0]))
