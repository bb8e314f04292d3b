"""The likelihood of what was seen of each element under a two-state Markov chain in time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from reference.beam_counting import Beam, usable_beams
from reference.change_hmm import ChangeModel, course
from reference.no_return_beams import in_a_row
from reference.ray_traversal import cell_of, traverse
from reference.surfel_map import Element, SurfelMap

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Number = NDArray[np.int32]

HIT = -1.0  # instead of a reliability
SURE = 0.95  # what was met more probably than that was met
LEAST = 0.02  # what was met less probably than that nobody looked at
STEP = 0.5  # cells: who moves less stands, for it is never quite at the same place
SOLID = 10  # beams that end on an element of a surface that is there for sure, at least once


@dataclass(frozen=True)
class Reading:
    """How beams are read; lengths in metres.

    Attributes:
        lateral_std: standard deviation of how far a beam passes beside where it seems to.
        margin: how far behind an element a beam must end to have passed it.
        hit_radius: an element so near to one that was hit, mean from mean, is hit too.
        end_margin: how far before its end a maximum-range beam is no longer trusted.
        use_normals: whether surfaces face somewhere; else every element is round.
        open: how far to trust a beam without a return beyond the first solid element.
    """

    lateral_std: float
    margin: float
    hit_radius: float
    end_margin: float
    use_normals: bool = True
    open: float = 1.0

    def __post_init__(self) -> None:
        for name in ("lateral_std", "margin", "hit_radius", "end_margin"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a positive length")


def look_at(surface: SurfelMap, beams: Sequence[Beam], reading: Reading) -> dict[int, float]:
    """What the beams of one look say of each element: HIT, or how surely they saw through it.

    An element is hit where a beam ends in its cell or within `hit_radius` of one in whose cell
    a beam ends. The others whose cells beams cross before they end are seen through: R = 1 - the
    product over these beams of 1 - P(the beam met the surface). Beams without a return have to
    come in a row, and are trusted less from the first solid element on.
    """
    number = surface.numbers()
    missed: dict[int, float] = {}
    struck = set()
    told = in_a_row(beams)
    for beam in beams:
        if not beam.hit and beam.number not in told:
            continue
        trust = 1.0
        for k, met in _met(surface, number, beam, reading):
            if not beam.hit and is_solid(surface.list[k], reading):
                trust = reading.open
            missed[k] = missed.get(k, 1.0) * (1.0 - trust * met)
        end = number.get(tuple(cell_of(beam.end, surface.resolution).tolist()))
        if beam.hit and end is not None:
            struck.add(end)
    means = np.array([element.mean for element in surface.list])
    hit: set[int] = set()
    for s in struck:
        apart = np.linalg.norm(means - means[s], axis=1)
        hit.update(np.flatnonzero(apart <= reading.hit_radius).tolist())
    seen = {k: 1.0 - m for k, m in missed.items() if 1.0 - m > LEAST}
    through = {k: 1.0 if p > SURE else p for k, p in seen.items()}
    return through | dict.fromkeys(hit, HIT)


def is_solid(element: Element, reading: Reading) -> bool:
    """Whether an element is one of a surface on which many beams ended."""
    return reading.use_normals and element.patch is not None and element.beams >= SOLID


def _met(
    surface: SurfelMap, number: dict[tuple[int, ...], int], beam: Beam, reading: Reading
) -> list[tuple[int, float]]:
    """(element, P(met)) of all elements whose cells the beam passes through before it ends."""
    way = beam.end - beam.start
    length = float(np.linalg.norm(way))
    usable = length if beam.hit else length - reading.end_margin
    if usable <= 0:
        return []
    end = beam.start + way * (usable / length)
    cells, _ = traverse(beam.start, end, surface.resolution)
    passed = [number.get(tuple(cell)) for cell in cells[:-1].tolist()]
    struck = beam.end if beam.hit else None
    line = 0.5 * surface.resolution, beam.start, way / length, struck, reading
    return [(k, _probability_met(surface.list[k], *line)) for k in passed if k is not None]


def _probability_met(
    element: Element,
    half_round: float,
    start: Float,
    direction: Float,
    end: Float | None,
    reading: Reading,
) -> float:
    """P(a beam crosses the element within its extent), with Gaussian noise beside the beam.

    `end` is that of a beam that was hit; what is no surface extends `half_round` from its mean.

    The element is seen under the angle at which the beam meets it, so it looks |n . d| times as
    wide as it is. A beam that is hit less than `margin` behind it may have been hit by it.
    """
    patch = element.patch if reading.use_normals else None
    if end is not None:
        behind = end - (patch.centre if patch else element.mean)
        distance = abs(patch.normal @ behind) if patch else np.linalg.norm(behind)
        if distance < reading.margin:
            return 0.0
    off = (patch.centre if patch else element.mean) - start
    aside = float(np.linalg.norm(off - (off @ direction) * direction))
    half = patch.half * abs(float(patch.normal @ direction)) if patch else half_round
    met = ndtr((half - aside) / reading.lateral_std) - ndtr((-half - aside) / reading.lateral_std)
    return float(met)


def view_turned(before: Float, now: Float, place: Float, resolution: float) -> float:
    """How far a robot moved (D,) against its distance from a place (D,): about an angle.

    Nearer than a cell nothing is seen of it.
    """
    moved, away = float(np.linalg.norm(now - before)), float(np.linalg.norm(now - place))
    return moved / max(resolution, away)


def chain_log_likelihood(
    seen: Sequence[tuple[float, float, float]],
    rho: float,
    tau: float,
    detection: float,
    turn: float = inf,
) -> float:
    """ln P(all looks) by the forward algorithm over the two states (empty, occupied).

    Args:
        seen: (time in seconds, HIT or reliability, turn of the view in radians since the look
            before) of each look, in the order of time.
        rho: share of the time, or of the views, in which it is occupied.
        tau: seconds, correlation exp(-dt / tau - dv / turn).
        detection: probability that a sure look at an occupied cell sees that it is.
        turn: radians.
    """
    state = np.array([1.0 - rho, rho])
    total, before = 0.0, None
    for time, reliability, turned in seen:
        if before is not None:
            kept = exp(-(time - before) / tau - turned / turn)
            stay = kept * np.eye(2) + (1.0 - kept) * np.array([[1.0 - rho, rho]] * 2)
            state = state @ stay
        if reliability == HIT:
            state = state * [0.0, detection]
        else:
            state = state * [1.0, 1.0 - detection * reliability]
        total += log(state.sum())
        state, before = state / state.sum(), time
    return total


class OccupancyHmm:
    """Looks at the elements of a surface, and what they say under classes of chains.

    Args:
        surfel_map: fitted.
        rho, tau, view_angle: (C,) of the classes; no view_angle: inf for all.
        p_detection: see `chain_log_likelihood`.
        bin_seconds: between successive looks.
        lateral_std, margin, hit_radius, end_margin, use_normals: see Reading.
    """

    def __init__(
        self,
        surfel_map: SurfelMap,
        *,
        rho: Sequence[float],
        tau: Sequence[float],
        view_angle: Sequence[float] = (),
        p_detection: float,
        bin_seconds: float,
        lateral_std: float,
        margin: float,
        hit_radius: float,
        end_margin: float,
        use_normals: bool = True,
    ) -> None:
        if len(surfel_map.list) != surfel_map.size:
            raise ValueError("surfel_map: fit it first")
        self.surfel_map = surfel_map
        self.classes = list(zip(rho, tau, view_angle or [inf] * len(rho), strict=True))
        self.p_detection = p_detection
        self.bin_seconds = bin_seconds
        self.reading = Reading(lateral_std, margin, hit_radius, end_margin, use_normals)
        self.place: Float | None = None  # from where the last look was taken
        # time, HIT or reliability, place
        self.seen: list[list[tuple[float, float, Float]]] = [[] for _ in surfel_map.list]
        self.model: ChangeModel | None = None

    def add(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        time_bin: ArrayLike,
        threads: int = 1,  # noqa: ARG002  the core's signature
        positions: ArrayLike | None = None,
    ) -> None:
        """Adds scans with the numbers (T,) of their looks, which must not fall.

        positions (T, D) says where the robot stood; None: the sensors' places count.
        """
        number = np.asarray(time_bin, np.int64)
        if (np.diff(number) < 0).any():
            raise ValueError("time_bin: must not fall")
        looks: dict[int, list[Beam]] = {int(n): [] for n in number}
        for beam in usable_beams(self.surfel_map.dimension, points, hit, offset, T_map_sensor):
            looks[int(number[beam.scan])].append(beam)
        places = np.asarray(T_map_sensor, float)[:, :-1, -1] if positions is None else positions
        for n, beams in looks.items():
            at = self._moved_to(np.asarray(places, float)[number == n].mean(axis=0))
            for k, reliability in look_at(self.surfel_map, beams, self.reading).items():
                self.seen[k].append((n * self.bin_seconds, reliability, at))

    def _moved_to(self, place: Float) -> Float:
        if self.place is None or (
            np.linalg.norm(place - self.place) >= STEP * self.surfel_map.resolution
        ):
            self.place = place
        return self.place

    def count_no_return_beams(
        self, points: ArrayLike, hit: ArrayLike, offset: ArrayLike, T_map_sensor: ArrayLike
    ) -> tuple[int, int]:
        """Beams without a return that come in a row, and those of them through something solid."""
        number = self.surfel_map.numbers()
        beams = list(usable_beams(self.surfel_map.dimension, points, hit, offset, T_map_sensor))
        told = in_a_row(beams)
        through = [
            any(
                is_solid(self.surfel_map.list[k], self.reading)
                for k, _ in _met(self.surfel_map, number, beam, self.reading)
            )
            for beam in beams
            if beam.number in told
        ]
        return len(through), sum(through)

    def solid_cells(self) -> NDArray[np.int64]:
        """(S, D) cells of surfaces on which many beams ended."""
        cells = [e.cell for e in self.surfel_map.list if is_solid(e, self.reading)]
        return np.array(cells, np.int64).reshape(-1, self.surfel_map.dimension)

    def set_trust_beyond_solid(self, trust: float) -> None:
        """How far to trust beams without a return beyond the first solid thing in their way."""
        self.reading = replace(self.reading, open=trust)

    def track_changes(
        self, *, tau: float, passer_by_rho: float, passer_by_tau: float, p_detection: float
    ) -> None:
        """Asks which elements are of things that come to stay or leave; see ChangeModel."""
        if any(self.seen):
            raise ValueError("track_changes: expected before the first observation")
        self.model = ChangeModel(tau, passer_by_rho, passer_by_tau, p_detection)

    def changes(
        self,
    ) -> tuple[
        Float, NDArray[np.float32], NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]
    ]:
        """(E,) log likelihood, (E,) occupied share, (E, 2), (E, 2), (E, 2, 2, 2); see Course."""
        if self.model is None:
            raise ValueError("changes: expected track_changes before")
        courses = [
            course(
                [(round(t / self.bin_seconds), None if r == HIT else r) for t, r, _ in seen],
                self.bin_seconds,
                self.model,
            )
            for seen in self.seen
        ]
        return (
            np.array([one.log_likelihood for one in courses]),
            np.array([one.occupied_share for one in courses], np.float32),
            np.array([one.p_last for one in courses], np.float32).reshape(-1, 2),
            np.array([one.count for one in courses], np.int32).reshape(-1, 2),
            np.array([one.between for one in courses], np.int32).reshape(-1, 2, 2, 2),
        )

    def likelihood(self, classes: ArrayLike | None = None) -> tuple[NDArray[np.float32], Float]:
        """(E, C) relative to the best class, (E,) logarithm of the best; of some classes (bool).

        Of everything else that was seen of the cell, given that a beam ended in it: divided by
        rho * p_detection, the probability of that.
        """
        chosen = self.classes
        if classes is not None:
            chosen = [
                one for one, wanted in zip(chosen, np.asarray(classes), strict=True) if wanted
            ]
        values = np.array(
            [
                [
                    chain_log_likelihood(seen, rho, tau, self.p_detection, turn)
                    - log(rho * self.p_detection)
                    for rho, tau, turn in chosen
                ]
                for seen in map(self._with_turns, self.surfel_map.list, self.seen)
            ]
        ).reshape(len(self.seen), len(chosen))
        best = values.max(axis=1)
        return np.exp(values - best[:, None]).astype(np.float32), best

    def _with_turns(
        self, element: Element, seen: list[tuple[float, float, Float]]
    ) -> list[tuple[float, float, float]]:
        """The looks at an element, each with the turn of the view since the one before."""
        before = [place for _, _, place in seen[:1] + seen[:-1]]
        return [
            (time, reliability, view_turned(b, place, element.mean, self.surfel_map.resolution))
            for b, (time, reliability, place) in zip(before, seen, strict=True)
        ]


OccupancyHmm2D = OccupancyHmm
OccupancyHmm3D = OccupancyHmm
