"""Global localization: the pose of the robot in a known map, without a prior."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.core.short_repr import ShortRepr
from stillmap.live.known_map import KnownMap, to_surface_map
from stillmap.places.alignment import search_alignments
from stillmap.places.surface_map import CONFLICT_WEIGHT, SurfaceMap, compare_surfaces
from stillmap.results.reader import OCCUPIED_THRESH
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]

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


@dataclass(frozen=True, eq=False)
class Localization(ShortRepr):
    """Result of global localization.

    Attributes:
        T: (D+1, D+1) of the searched view in the known map; None: not known.
        is_ambiguous: several places fit about as well.
    """

    T: Float | None
    is_ambiguous: bool = False


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
    """

    def __init__(
        self,
        known: KnownMap,
        min_agree: float = MIN_AGREE,
        gone_weight: float = CONFLICT_WEIGHT,
        sure_agree: float = -np.inf,
    ) -> None:
        self._min_agree, self._sure_agree = min_agree, sure_agree
        self._gone_weight = gone_weight
        self._known, self._surface = known, known.make_surface_map()
        self._last: Float | None = None
        self._times = 0  # that the last one was the best in a row
        self._first: SurfaceMap | None = None  # the view when it was for the first time

    def forget(self) -> None:
        """The view begins anew, in another frame."""
        self._last = None

    def localize(self, view: GridMap, scan: Scan, pose: Float) -> Localization:
        """Pose of a local map in the known map.

        Args:
            view: what was seen since the robot was lost, as a map in a frame of its own.
            scan: the last scan.
            pose: (3, 3) of the robot in the frame of the view.
        """
        return self.search(view, lambda T: self._refine(scan, T @ pose) @ se2.inverse(pose))

    def search(self, view: GridMap, refine: Callable[[Float], Float]) -> Localization:
        """Pose of a local map in the known map.

        Args:
            view: as of `localize`.
            refine: a better alignment (3, 3) near the one given, which the search found.
        """
        if np.count_nonzero(view.p_occupied > OCCUPIED_THRESH) < _MIN_SURFACE:  # maybe none at all
            return Localization(None)
        session = to_surface_map(view)
        if len(session.surface) < _MIN_SURFACE:
            return Localization(None)
        alignments = list[_Alignment]()
        proposed = search_alignments(self._surface, session, _FREE_WEIGHT, self._gone_weight)
        for T in proposed[:_MAX_CANDIDATES]:
            alignments.append(self._weigh(session, refine(T)))
        return self._choose(sorted(alignments, key=lambda alignment: -alignment.evidence), session)

    def _choose(self, alignments: list[_Alignment], session: SurfaceMap) -> Localization:
        """The best alignment, if the evidence is clear."""
        last, self._last = self._last, None
        squares = len(session.surface)
        if (
            not alignments
            or alignments[0].agree < self._min_agree * squares
            or alignments[0].evidence <= 0.0
        ):
            return Localization(None)
        best = alignments[0]
        rivals = [rival.evidence for rival in alignments[1:] if _is_apart(best.T, rival.T)]
        share = max(rivals, default=0.0) / best.evidence
        if share > max(_MAX_RIVAL.values()):
            return Localization(None, is_ambiguous=True)
        is_same = last is not None and not _is_apart(last, best.T)
        self._last, self._times = best.T, self._times + 1 if is_same else 1
        if self._first is None or not is_same:
            self._first = session
        if not any(self._times >= n and share <= most for n, most in _MAX_RIVAL.items()):
            return Localization(None, is_ambiguous=True)
        # in walls that the map shows and the robot does not see, too
        is_sure = min(best.agree, best.evidence) >= self._sure_agree * squares
        is_here = is_sure or self._predicts(session, best.T)
        return Localization(best.T if is_here else None)

    def _predicts(self, session: SurfaceMap, T: Float) -> bool:
        """True if under an alignment the map shows what came into view since it was the best."""
        assert self._first is not None
        fresh = ~self._first.is_near(session.surface)
        T = np.asarray(T)
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

    def _refine(self, scan: Scan, pose: Float) -> Float:
        prior = motion_model.gaussian_prior(pose, *_STD)
        window = [2.0 * std for std in _STD]
        return scan_matching.search_pose(self._grid, scan, prior, *window).T_map_base


def _is_apart(first: Float, second: Float) -> bool:
    x, y, theta = se2.parameters(se2.inverse(first) @ second)
    return bool(np.hypot(x, y) > _APART[0] or abs(theta) > _APART[1])
