"""Things that are put somewhere or taken away while others pass: a chain of three states."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import exp, log

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Between = tuple[int, int]

THING, NOTHING, SOMEBODY = range(3)
NEVER = (-1, -1)


@dataclass(frozen=True)
class ChangeModel:
    """How things and passers-by come and leave.

    Attributes:
        tau: seconds, things are there or not with correlation exp(-dt / tau), half of the time.
        passer_by_rho: share of the time in which somebody passes where no thing stands.
        passer_by_tau: seconds, correlation of that.
        p_detection: probability that a sure look at an occupied cell sees that it is.
    """

    tau: float
    passer_by_rho: float
    passer_by_tau: float
    p_detection: float

    @property
    def prior(self) -> Float:
        """(3,) before the first look."""
        rho = self.passer_by_rho
        return np.array([0.5, 0.5 * (1.0 - rho), 0.5 * rho])

    def transition(self, dt: float) -> Float:
        """(3, 3) from, to. A thing leaves the cell as it would be without it."""
        rho = self.passer_by_rho
        stays = 0.5 + 0.5 * exp(-dt / self.tau)
        kept = exp(-dt / self.passer_by_tau)
        nobody, somebody = np.array([1.0 - rho, rho]), np.eye(2)
        passing = kept * somebody + (1.0 - kept) * np.stack([nobody, nobody])
        p = np.empty((3, 3))
        p[THING] = [stays, *((1.0 - stays) * nobody)]
        p[1:, THING] = 1.0 - stays
        p[1:, 1:] = stays * passing
        return p

    def seen(self, reliability: float | None) -> Float:
        """(3,) probability of a hit (None), or of seeing through with a reliability."""
        if reliability is None:
            return np.array([self.p_detection, 0.0, self.p_detection])
        missed = 1.0 - self.p_detection * reliability
        return np.array([missed, 1.0, missed])


@dataclass(frozen=True)
class Course:
    """What is asked of a cell; pairs are of things alone, and of anything that was there.

    Attributes:
        log_likelihood: of everything else that was seen, given one hit.
        occupied_share: share of the time from first to last look in which it was not empty, by the
            most probable course; a change counts as half way between two looks.
        p_last: probability of it at the last look.
        count: how often it came or left, by that course.
        between: looks before and after the first and the last time, or NEVER.
    """

    log_likelihood: float
    occupied_share: float
    p_last: tuple[float, float]
    count: tuple[int, int]
    between: tuple[tuple[Between, Between], tuple[Between, Between]]


def course(looks: Sequence[tuple[int, float | None]], seconds: float, model: ChangeModel) -> Course:
    """The forward algorithm and the most probable path, over all looks at once.

    Args:
        looks: number, rising, and reliability of each look; None for a hit.
        seconds: between successive looks.
        model: see ChangeModel.
    """
    with np.errstate(divide="ignore"):
        weight, best = model.prior, np.log(model.prior)
        total, before, came_from = 0.0, looks[0][0] if looks else 0, []
        for number, reliability in looks:
            p, seen = model.transition((number - before) * seconds), model.seen(reliability)
            weight = (weight @ p) * seen
            total += log(weight.sum())
            weight = weight / weight.sum()
            to = best[:, None] + np.log(p)
            came_from.append(to.argmax(axis=0))
            best = to.max(axis=0) + np.log(seen)
            before = number
    path = [int(best.argmax())]
    for back in reversed(came_from):
        path.append(int(back[path[-1]]))
    states, numbers = path[::-1][1:], [number for number, _ in looks]
    hit = (0.5 + 0.5 * model.passer_by_rho) * model.p_detection
    of_things = _turns([state == THING for state in states], numbers)
    of_any = _turns([state != NOTHING for state in states], numbers)
    return Course(
        log_likelihood=total - log(hit),
        occupied_share=_share([state != NOTHING for state in (states or path)], numbers),
        p_last=(float(weight[THING]), float(1.0 - weight[NOTHING])),
        count=(len(of_things), len(of_any)),
        between=(_ends(of_things), _ends(of_any)),
    )


def _turns(there: Sequence[bool], numbers: Sequence[int]) -> list[Between]:
    return [
        (numbers[k - 1], numbers[k]) for k in range(1, len(numbers)) if there[k] != there[k - 1]
    ]


def _ends(turns: list[Between]) -> tuple[Between, Between]:
    return (turns[0], turns[-1]) if turns else (NEVER, NEVER)


def _share(there: Sequence[bool], numbers: Sequence[int]) -> float:
    if len(numbers) < 2:
        return float(there[-1])
    halves = [0.5 * (a + b) for a, b in pairwise(there)]
    return float(np.sum(np.diff(numbers) * halves) / (numbers[-1] - numbers[0]))
