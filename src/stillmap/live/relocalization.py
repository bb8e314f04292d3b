"""Relocalization of a robot that was carried while it maps: it is searched in its own map."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.live.causal_labels import CausalLabels, take_over
from stillmap.live.global_localization import MIN_AGREE_ANYWHERE, GlobalLocalizer
from stillmap.live.known_map import KnownMap
from stillmap.live.local_map import LocalMap, MatchMap
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]

_COVARIANCE = np.diag(np.square([0.1, 0.1, 0.02]))  # m, m, rad: of a pose that was found


class Relocalizer:
    """The map that a robot was carried out of, or to another place in.

    Args:
        labels: of that map; from now on they are those of what is seen elsewhere.
        local_map: likewise.
        T_map_local: (3, 3) of the frame of the odometry by scans.
    """

    covariance = _COVARIANCE

    def __init__(self, labels: CausalLabels, local_map: MatchMap, T_map_local: Float) -> None:
        self._filter, self._local_map = labels.filter, local_map
        self._T_map_local = T_map_local
        try:
            known = KnownMap(labels.to_map())
            # it may be where it has never been; the map is that of a moment ago
            localizer = GlobalLocalizer(known, MIN_AGREE_ANYWHERE)
            self._localizer: GlobalLocalizer | None = localizer
        except InputError:  # an empty map
            self._localizer = None
        self.is_ambiguous = False
        self.begin(labels)

    def begin(self, labels: CausalLabels) -> None:
        """Forget what was seen since the robot was carried: it was carried again."""
        labels.filter = self._filter.sibling()

    def localize(self, labels: CausalLabels, hits: Scan, pose: Float) -> Float | None:
        """(3, 3) by which all since then moves in the frame of the odometry by scans, if the
        evidence is clear.

        Args:
            labels: of what was seen since the robot was carried.
            hits: of the last scan.
            pose: (3, 3) of the robot in the frame of the labels.
        """
        if self._localizer is None:
            return None
        found = self._localizer.localize(labels.to_view(), hits, pose)
        self.is_ambiguous = found.is_ambiguous
        if found.T is None:
            return None
        out: Float = se2.inverse(self._T_map_local) @ found.T @ self._T_map_local
        return out

    def join(self, labels: CausalLabels, local_map: MatchMap, T: Float) -> MatchMap:
        """The map of before with what was seen since, moved by T (3, 3) of `localize`: the labels
        become those of both, and the local map of both is returned."""
        motion = self._T_map_local @ T @ se2.inverse(self._T_map_local)
        seen = labels.filter
        take_over(self._filter, seen, np.tile(motion, (labels.tags, 1, 1)), 0, seen.block_count)
        labels.filter = self._filter
        if isinstance(self._local_map, LocalMap) and isinstance(local_map, LocalMap):
            self._local_map.join(local_map, T)
        return self._local_map
