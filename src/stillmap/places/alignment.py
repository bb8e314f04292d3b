"""Global alignment: where a session lies in a place, without a prior.

Whole maps are compared over all positions and headings; the best alignments are refined, and
compared again square by square.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.places.map_refinement import MapRefiner
from stillmap.places.map_search import middle_of, search_alignments
from stillmap.places.surface_map import Comparison, SurfaceMap, compare_maps
from stillmap.slam import motion_model

Float = NDArray[np.float64]

_MAX_HYPOTHESES = 6
_RIVAL_DISTANCE, _RIVAL_ANGLE = 1.0, 0.1  # m, rad: alignments nearer to a better one are that one
_REGISTERED_POINTS = 2000  # of the session, evenly spread
_GRID_CELL = 0.1  # m
# likelihood field: std (m) around surfaces, radius in cells, floor; weight of a point, Newton steps
_FIELD: dict[str, Any] = {"sigma": 0.1, "radius": 2, "floor": 0.05, "unknown": 0.2}
_SCALE, _MAX_ITERATIONS = 0.2, 20
_NO_PRIOR = 1e3  # m, rad: std of a prior that says nothing
_MIN_KEPT = 0.95  # share of the score that registration, which knows no free space, must keep


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An alignment of a session with a place.

    Attributes:
        T: (3, 3) T_place_session.
        comparison: of both maps under it.
    """

    T: Float
    comparison: Comparison


def propose_alignments(place: SurfaceMap, session: SurfaceMap) -> list[Hypothesis]:
    """Alignments of a session, the one under which both maps agree most first.

    Args:
        place: its surfaces and free space.
        session: those of the session, in its own frame.
    """
    found = search_alignments(place, session)
    if not found:
        return []
    refiner = MapRefiner(place, session)
    refined = _sort([_compare(place, session, refiner.refine(T)) for T in found])
    best = _remove_duplicates(refined, session)[:_MAX_HYPOTHESES]
    registration = _Registration(place, session)
    return _remove_duplicates(_sort([registration.refine(one) for one in best]), session)


class _Registration:
    """The surfaces of a session registered to those of a place, finer than squares."""

    def __init__(self, place: SurfaceMap, session: SurfaceMap) -> None:
        self._place, self._session = place, session
        self._grid = _make_grid(place)
        chosen = spread_evenly(len(session.surface), _REGISTERED_POINTS)
        self._points = np.ascontiguousarray(session.surface[chosen], np.float32)

    def refine(self, start: Hypothesis) -> Hypothesis:
        """A hypothesis registered, unless the maps then agree less."""
        prior = motion_model.gaussian_prior(start.T, _NO_PRIOR, _NO_PRIOR)
        T, *_ = _core.register_scan(
            self._grid,
            self._points,
            np.ones(len(self._points), np.float32),
            prior.T_map_base,
            prior.information,
            **_FIELD,
            information_scale=_SCALE,
            max_iterations=_MAX_ITERATIONS,
            window_translation=0.0,
            window_rotation=0.0,
            search_range=0.0,
            max_candidates=1,
            T_start=start.T,
        )
        found = _compare(self._place, self._session, T)
        kept = found.comparison.score >= _MIN_KEPT * start.comparison.score
        return found if kept else start


def _compare(place: SurfaceMap, session: SurfaceMap, T: Float) -> Hypothesis:
    return Hypothesis(T, compare_maps(place, session, T))


def _sort(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    return sorted(hypotheses, key=lambda one: -one.comparison.score)


def _remove_duplicates(hypotheses: list[Hypothesis], session: SurfaceMap) -> list[Hypothesis]:
    """Those that put the session elsewhere than all better ones."""
    middle = np.append(middle_of(session), 1.0)
    out = list[Hypothesis]()
    for one in hypotheses:
        distance = [float(np.linalg.norm((one.T - other.T) @ middle)) for other in out]
        turn = [abs(_turn_between(one.T, other.T)) for other in out]
        if not any(
            d < _RIVAL_DISTANCE and a < _RIVAL_ANGLE for d, a in zip(distance, turn, strict=True)
        ):
            out.append(one)
    return out


def _turn_between(one: Float, other: Float) -> float:
    return float(se2.parameters(se2.inverse(one) @ other)[2])


def spread_evenly(count: int, max_chosen: int) -> list[int]:
    """At most so many of `count` indices, evenly spread."""
    chosen = np.unique(np.linspace(0, count - 1, min(count, max_chosen)).round().astype(np.intp))
    out: list[int] = chosen.tolist()
    return out


def _make_grid(place: SurfaceMap) -> _core.OccupancyGrid2D:
    """The surfaces of a place as end points."""
    grid = _core.OccupancyGrid2D(_GRID_CELL, 0.0)
    n = len(place.surface)
    _core.add_end_points(
        grid,
        np.ascontiguousarray(place.surface, np.float32),
        np.ones(n, np.bool_),
        np.ones(n, np.float32),
        np.array([0, n]),
        np.eye(3)[None],
    )
    return grid
