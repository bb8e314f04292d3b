"""Global alignment: where a session lies in a place, without a prior.

Views of the session (the surfaces around one of its keyframes) are searched in the whole map of
the place over all positions and headings, by correlative scan matching with branch and bound. Views
that agree on one alignment of the session make a hypothesis.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.places.keyframes import Keyframes
from stillmap.places.surface_map import Comparison, SurfaceMap, compare_maps
from stillmap.slam import motion_model
from stillmap.slam.local_map import travelled_distance

Float = NDArray[np.float64]
Points = NDArray[np.float32]
Index = NDArray[np.intp]

MAX_VIEWS = 40  # of a session that are searched in the place
# m of travel to either side whose scans make a view, m around the keyframe: the small view fits
# where only a part of the session overlaps the place
_VIEWS = ((8.0, 20.0), (4.0, 8.0))
_VIEW_RANGE = 20.0
_SEARCH_CELL = 0.1  # m, of the map that is searched, and between the points of a view
_SEARCHED_POINTS = 300  # of a view, evenly spread: all of them refine what the search finds
_REFINED_POINTS = 2000  # of the session, by which an alignment is refined
_MIN_POINTS = 60  # of a view: fewer fit anywhere
_MAX_CANDIDATES = 5  # optima of a view
_MIN_P_STATIC = 0.5  # of a point of a view
# likelihood field: std (m) around surfaces, radius in cells, floor; information of one point
_FIELD: dict[str, Any] = {"sigma": 0.1, "radius": 2, "floor": 0.05, "unknown": 0.2}
_SCALE, _NO_PRIOR = 0.2, 1e3  # m, rad: std of a prior that says nothing
_MIN_SCORE = 0.4  # of the highest possible: poses below are not looked at
_MIN_EXPLAINED = 0.45  # share of a view's points; a view elsewhere reaches as much by chance
# m and rad between the alignments of two views of one hypothesis
_SAME_DISTANCE, _SAME_ANGLE = 0.8, 0.1
_RIVAL_DISTANCE, _RIVAL_ANGLE = 1.0, 0.1  # m, rad: alignments nearer to a better one are that one
# views after which hypotheses are compared; the search ends when so many views agree on one, under
# which so many squares agree, and no other has more than this share of its score
_VIEWS_AT_ONCE, _CLEAR_VIEWS, _CLEAR_AGREEING, _CLEAR_RIVAL = 10, 6, 1000, 0.15
_MAX_HYPOTHESES = 6


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An alignment of a session with a place.

    Attributes:
        T: (3, 3) T_place_session.
        views: number of views that agree on it.
        comparison: of both maps under it.
    """

    T: Float
    views: int
    comparison: Comparison


class _ViewMatch(NamedTuple):
    """One place of one view.

    Attributes:
        T: (3, 3) T_place_session that it asks for.
        explained: share of the view that the place explains there.
        pose: (3, 3) T_session_base of the view.
    """

    T: Float
    explained: float
    pose: Float


def propose_alignments(
    place: SurfaceMap, session: SurfaceMap, keyframes: Keyframes
) -> list[Hypothesis]:
    """Alignments of a session, the one under which both maps agree most first.

    Args:
        place: its static surfaces.
        session: those of the session, in its own frame.
        keyframes: of the session, in the plane.
    """
    if not len(place.surface):
        return []
    search = _Search(place, session, keyframes)
    views = _spread_order(len(keyframes), MAX_VIEWS)
    out = list[Hypothesis]()
    for first in range(0, len(views), _VIEWS_AT_ONCE):
        for k in views[first : first + _VIEWS_AT_ONCE]:
            search.search_view(k)
        out = _remove_duplicates(search.compare(), session)
        if _is_clear(out):
            break
    return out[:_MAX_HYPOTHESES]


class _Search:
    """Views of a session searched in the map of a place."""

    def __init__(self, place: SurfaceMap, session: SurfaceMap, keyframes: Keyframes) -> None:
        self._place, self._session, self._keyframes = place, session, keyframes
        self._grid, self._centre, self._half = _make_search_map(place.surface)
        self._travelled = travelled_distance(keyframes.poses)
        self._points = session.surface[spread_evenly(len(session.surface), _REFINED_POINTS)]
        self._found = list[_ViewMatch]()

    def search_view(self, k: int) -> None:
        """Search the views around keyframe k."""
        for metres, radius in _VIEWS:
            points = collect_view(self._keyframes, self._travelled, k, metres, radius)
            if len(points) < _MIN_POINTS:
                continue
            pose = self._keyframes.poses[k]
            for T, share in _search_view(self._grid, points, self._centre, self._half):
                if share >= _MIN_EXPLAINED:
                    self._found.append(_ViewMatch(T @ se2.inverse(pose), share, pose))

    def compare(self) -> list[Hypothesis]:
        """The alignments found so far, refined by the whole session, the best one first."""
        out = []
        for T, views in _group(self._found):
            refined, *_ = _register(self._grid, self._points, T, 0.0)
            comparison = compare_maps(self._place, self._session, refined)
            out.append(Hypothesis(refined, views, comparison))
        return sorted(out, key=lambda one: -one.comparison.score)


def _spread_order(count: int, max_chosen: int) -> list[int]:
    """At most so many of `count` indices, evenly spread, neighbours far apart in the order."""
    chosen = spread_evenly(count, max_chosen)
    steps = [step for step in (8, 4, 2, 1) if step <= len(chosen)]
    order = [k for step in steps for k in range(0, len(chosen), step)]
    return [chosen[k] for k in dict.fromkeys(order)]


def _is_clear(hypotheses: list[Hypothesis]) -> bool:
    """Whether further views would not change which alignment is the best."""
    if not hypotheses or hypotheses[0].views < _CLEAR_VIEWS:
        return False
    best = hypotheses[0].comparison
    rival = hypotheses[1].comparison.score if len(hypotheses) > 1 else 0.0
    return best.agree >= _CLEAR_AGREEING and rival <= _CLEAR_RIVAL * best.score


def _remove_duplicates(hypotheses: list[Hypothesis], session: SurfaceMap) -> list[Hypothesis]:
    """Those that put the session elsewhere than all better ones."""
    middle = np.append(session.surface.mean(axis=0), 1.0)
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


def _make_search_map(surface: Points) -> tuple[_core.OccupancyGrid2D, Float, float]:
    """The map that is searched, the centre (2,) of the search window, and its half width in m."""
    grid = _core.OccupancyGrid2D(_SEARCH_CELL, 0.0)
    n = len(surface)
    _core.add_end_points(
        grid,
        np.ascontiguousarray(surface, np.float32),
        np.ones(n, np.bool_),
        np.ones(n, np.float32),
        np.array([0, n]),
        np.eye(3)[None],
    )
    low, high = surface.min(axis=0), surface.max(axis=0)
    return grid, 0.5 * (low + high).astype(np.float64), float(0.5 * (high - low).max()) + 1.0


def collect_view(
    session: Keyframes, travelled: Float, k: int, metres: float, radius: float
) -> Points:
    """(N, 2) static end points around keyframe k, in its base frame, one per cell of 0.1 m.

    metres: of travel to either side whose scans make the view. radius: m around the keyframe.
    """
    first, last = np.searchsorted(travelled, [travelled[k] - metres, travelled[k] + metres])
    recording = session.recording
    beams = slice(int(recording.offset[first]), int(recording.offset[max(last, k + 1)]))
    kept = beams.start + np.flatnonzero(recording.hit[beams] & (session.e[beams] >= _MIN_P_STATIC))
    to_k = se2.inverse(session.poses[k]) @ session.poses
    points = recording.end_points(kept, to_k)
    points = points[np.linalg.norm(points, axis=1) <= radius]
    cells = np.floor(points / _SEARCH_CELL).astype(np.int64)
    _, at = np.unique(cells, axis=0, return_index=True)
    return np.ascontiguousarray(points[np.sort(at)], np.float32)


def _search_view(
    grid: _core.OccupancyGrid2D, points: Points, centre: Float, half: float
) -> list[tuple[Float, float]]:
    """Poses (3, 3) of a view in the map, and the share of it that the map explains at each."""
    few = points[spread_evenly(len(points), _SEARCHED_POINTS)]
    best, _, alternatives = _register(grid, few, se2.matrix(centre[0], centre[1], 0.0), half)
    x = se2.parameters(best)
    dx, dy, turn = (x + alternatives[:, :3]).T
    starts = se2.matrix(dx, dy, turn)
    return [_register(grid, points, start, 0.0)[:2] for start in starts]


def _register(
    grid: _core.OccupancyGrid2D, points: Points, start: Float, half: float
) -> tuple[Float, float, Float]:
    """Best pose (3, 3), explained share, and offsets and costs (R, 4) of all optima.

    half: m, half width of the window that is searched over all headings; 0: only refine.
    """
    prior = motion_model.gaussian_prior(start, _NO_PRIOR, _NO_PRIOR)
    T, _, _, explained, _, _, alternatives = _core.register_scan(
        grid,
        points,
        np.ones(len(points), np.float32),
        prior.T_map_base,
        prior.information,
        **_FIELD,
        information_scale=_SCALE,
        max_iterations=20,
        window_translation=half,
        window_rotation=np.pi,
        search_range=_VIEW_RANGE,
        max_candidates=_MAX_CANDIDATES,
        min_score=_MIN_SCORE,
        T_start=None if half else start,
    )
    return T, explained, alternatives


def _group(found: list[_ViewMatch]) -> list[tuple[Float, int]]:
    """Alignments (3, 3) of matches that agree where their views are, and how many agree on each.

    Each group takes that of the match with the highest explained share.
    """
    free = sorted(found, key=lambda match: -match.explained)
    out = []
    while free:
        members = [other for other in free if _agree(free[0], other)]
        out.append((free[0].T, len(members)))
        kept = {id(match) for match in members}
        free = [match for match in free if id(match) not in kept]
    return out


def _agree(one: _ViewMatch, other: _ViewMatch) -> bool:
    """Whether the alignment of one match puts the view of another where that is."""
    d = se2.parameters(se2.inverse(other.T @ other.pose) @ one.T @ other.pose)
    return bool(np.hypot(d[0], d[1]) < _SAME_DISTANCE and abs(d[2]) < _SAME_ANGLE)
