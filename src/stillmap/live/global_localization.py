"""Global localization: the pose of the robot in a map, without a prior."""

from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter
from stillmap.live.known_map import KeptMap, KnownLocalMap, KnownMap, to_surface_map
from stillmap.live.local_map import LocalMap
from stillmap.places.alignment import search_alignments
from stillmap.places.surface_map import CONFLICT_WEIGHT, SurfaceMap, compare_surfaces
from stillmap.results.reader import OCCUPIED_THRESH
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.scan_hits import Scan

_MIN_SURFACE = 40  # squares of surface that a view needs
# share of the surfaces of the view that the map shows, others may be people or new; and where the
# robot may be anywhere, as well as in the map
MIN_AGREE, MIN_AGREE_ANYWHERE = 0.35, 0.7
# of a surface of the view where the map is free: somebody may stand there; one of the map where the
# view is free weighs much
_FREE_WEIGHT = 0.5
# share of the best alignment's evidence that a rival may have, by how many times in a row that one
# is the best: the robot sees more from one search to the next
_MAX_RIVAL = {1: 0.4, 2: 0.7, 5: 0.85}
# Of a view of which the map shows less than `sure_agree`: squares that came into view since
# the place was the best for the first time, and the share of them that the map shows. What was in
# view before fits in part anywhere, for the place that fits best was chosen; those were not.
_MIN_FRESH, _MIN_FRESH_AGREE = 80, 0.5
_APART = 1.0, 0.5  # m and rad from which another alignment is a rival
_STD = 0.15, 0.04  # m, rad: of an alignment that the search finds
_MAX_CANDIDATES = 20


class _Alignment(NamedTuple):
    """A pose of the view, its evidence, and how many of its surfaces the map shows."""

    evidence: float
    agree: int
    T: Float


class GlobalLocalizer:
    """Searches a known map.

    Args:
        known: the map.
        min_agree: share of the surfaces of a view that the map shows, at least.
        gone_weight: weight of a surface of the map where the view is free, against one that both
            show.
        sure_agree: share of them below which the robot may as well be elsewhere: then the map must
            show what comes into view later, too.

    Attributes:
        is_ambiguous: several places fit the last view about as well.
    """

    def __init__(
        self,
        known: KnownMap,
        min_agree: float = MIN_AGREE,
        gone_weight: float = CONFLICT_WEIGHT,
        sure_agree: float = -np.inf,
    ) -> None:
        self.is_ambiguous = False
        self._min_agree, self._sure_agree = min_agree, sure_agree
        self._gone_weight = gone_weight
        self._known, self._surface = known, to_surface_map(known.grid)
        self._last: Float | None = None
        self._times = 0  # that the last one was the best in a row
        self._first: SurfaceMap | None = None  # the view when it was for the first time

    def forget(self) -> None:
        """The view begins anew, in another frame."""
        self._last = None

    def search(self, view: GridMap, refine: Callable[[Float], Float]) -> Float | None:
        """(3, 3) of a view in the known map; None: the evidence is not clear.

        Args:
            view: what was seen since the robot was lost, as a map in a frame of its own.
            refine: a better alignment (3, 3) near the one given, which the search found.
        """
        self.is_ambiguous = False
        if np.count_nonzero(view.p_occupied > OCCUPIED_THRESH) < _MIN_SURFACE:  # maybe none at all
            return None
        session = to_surface_map(view)
        if len(session.surface) < _MIN_SURFACE:
            return None
        proposed = search_alignments(self._surface, session, _FREE_WEIGHT, self._gone_weight)
        alignments = [self._weigh(session, refine(T)) for T in proposed[:_MAX_CANDIDATES]]
        return self._choose(sorted(alignments, key=lambda alignment: -alignment.evidence), session)

    def _choose(self, alignments: list[_Alignment], session: SurfaceMap) -> Float | None:
        """The best alignment, if the evidence is clear."""
        last, self._last = self._last, None
        squares = len(session.surface)
        if (
            not alignments
            or alignments[0].agree < self._min_agree * squares
            or alignments[0].evidence <= 0.0
        ):
            return None
        best = alignments[0]
        rivals = [rival.evidence for rival in alignments[1:] if _is_apart(best.T, rival.T)]
        share = max(rivals, default=0.0) / best.evidence
        if share <= max(_MAX_RIVAL.values()):
            is_same = last is not None and not _is_apart(last, best.T)
            self._last, self._times = best.T, self._times + 1 if is_same else 1
            if self._first is None or not is_same:
                self._first = session
        if not any(self._times >= n and share <= most for n, most in _MAX_RIVAL.items()):
            self.is_ambiguous = True
            return None
        # in walls that the map shows and the robot does not see, too
        is_sure = min(best.agree, best.evidence) >= self._sure_agree * squares
        return best.T if is_sure or self._predicts(session, best.T) else None

    def _predicts(self, session: SurfaceMap, T: Float) -> bool:
        """True if under an alignment the map shows what came into view since it was the best."""
        assert self._first is not None
        fresh = ~self._first.is_near(session.surface)
        points = session.surface[fresh] @ T[:2, :2].T + T[:2, 2]
        shown = self._surface.look_up(points, session.surface_sides[fresh] @ T[:2, :2].T)
        count = int(fresh.sum())
        return count >= _MIN_FRESH and shown.agree >= _MIN_FRESH_AGREE * count

    def _weigh(self, session: SurfaceMap, T: Float) -> _Alignment:
        forth, back = compare_surfaces(self._surface, session, T)
        evidence = forth.agree - _FREE_WEIGHT * forth.conflict
        evidence += back.agree - self._gone_weight * back.conflict
        return _Alignment(evidence, forth.agree, T)

    @cached_property
    def _grid(self) -> _core.OccupancyGrid2D:
        return self._known.make_grid()

    def register(self, scan: Scan, pose: Float) -> Float:
        """(3, 3) T_map_base of a scan near a pose (3, 3)."""
        prior = motion_model.gaussian_prior(pose, *_STD)
        window = [2.0 * std for std in _STD]
        return scan_matching.search_pose(self._grid, scan, prior, *window).T_map_base


def _is_apart(first: Float, second: Float) -> bool:
    x, y, theta = se2.parameters(se2.inverse(first) @ second)
    return bool(np.hypot(x, y) > _APART[0] or abs(theta) > _APART[1])


class PlanarLocalizer:
    """A planar map of an earlier run in which a robot that is lost is searched.

    Args:
        known: the map.
        extends: whether scans are added to it.

    Attributes:
        origin: (3,) m, of the frame of the search, in the map frame.
        is_lost: the robot is not found in it yet.
        is_ambiguous: several places fit about as well.
        route: (T, D) from where the map was made, in 3D, once the robot is found in it.
    """

    is_lost, is_ambiguous = True, False
    origin, route = np.zeros(3), np.zeros((0, 2))

    def __init__(self, known: KnownMap, extends: bool) -> None:
        self.origin, self._known, self._extends = known.origin, known, extends
        self._global: GlobalLocalizer | None
        self._global = GlobalLocalizer(known, sure_agree=MIN_AGREE_ANYWHERE)

    def localize(self, labels: CausalLabels, scan: Scan, pose: Float) -> Float | None:
        """(D+1, D+1) of the frame of the labels in the map, if the evidence is clear.

        Args:
            labels: of what was seen since the robot was lost.
            scan: the last one; in 2D its hits.
            pose: (D+1, D+1) of the robot in the frame of the labels.
        """
        known = self._global
        if known is None:
            return None

        def refine(T: Float) -> Float:
            return np.asarray(known.register(scan, T @ pose) @ se2.inverse(pose))

        T = known.search(labels.to_map(is_seen_alone=True), refine)
        self.is_ambiguous = known.is_ambiguous
        return T

    def forget(self, labels: CausalLabels) -> None:
        """The robot was carried: begin anew, with labels of the map, or of elsewhere where it was
        lost already."""
        if self._global is not None:
            self._global.forget()
        labels.clear()

    def known_filter(self, empty: OccupancyFilter) -> OccupancyFilter:
        """Filters of cells with what the map knows; `empty`: such of the same kind."""
        self._known.prime(empty)
        return empty

    def make_local_map(self, _local_map: Any, _T: Float) -> LocalMap:
        """The map that scans are matched against from now on.

        Args:
            _local_map: that of what was seen since the robot was lost.
            _T: (D+1, D+1) by which that moves in its frame.
        """
        return KnownLocalMap(self._known, self._extends)

    def keep(self, _labels: CausalLabels) -> KeptMap:
        """The part of the map that an extended one keeps, as of now: all of it."""
        return KeptMap(self._known.grid, self._known.hits)


class OwnMap(PlanarLocalizer):
    """The planar map so far, which a robot was carried out of, or to another place in.

    Args:
        labels: of that map; from now on they are those of what is seen elsewhere.
        local_map: likewise.
    """

    def __init__(self, labels: CausalLabels, local_map: Any) -> None:
        self._filter = labels.filter
        self._local_map: LocalMap = local_map
        self._global = None
        with suppress(InputError):  # an empty map
            # it may be where it has never been; the map is that of a moment ago
            self._global = GlobalLocalizer(KnownMap(labels.to_map()), MIN_AGREE_ANYWHERE)
        self.forget(labels)

    def forget(self, labels: CausalLabels) -> None:
        """It was carried again: begin anew."""
        labels.filter = self._filter.sibling()

    def known_filter(self, _empty: OccupancyFilter) -> OccupancyFilter:
        """Those of the map."""
        return self._filter

    def make_local_map(self, local_map: Any, T: Float) -> LocalMap:
        """The local map of before with that of what was seen since."""
        self._local_map.join(local_map, T)
        return self._local_map
