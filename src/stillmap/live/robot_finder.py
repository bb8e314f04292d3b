"""A robot that is lost: in a known map, or carried elsewhere while it maps."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.front_end import FrontEnd
from stillmap.live.global_localization import MIN_AGREE_ANYWHERE, GlobalLocalizer
from stillmap.live.known_map import KnownMap
from stillmap.live.local_map import LocalMap
from stillmap.live.map_frame import MapFrame
from stillmap.live.place import Localizer
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]

_COVARIANCE = np.diag(np.square([0.1, 0.1, 0.02]))  # m, m, rad: of a pose that was found
# of the scans that agreed with the map before others contradicted it, the last ones: somewhere else
# the first scans may agree by chance
_DOUBTED = 5


class Relocalizer:
    """The map that a robot was carried out of, or to another place in.

    Args:
        labels: of that map; from now on they are those of what is seen elsewhere.
        local_map: likewise.
        T_map_local: (3, 3) of the frame of the odometry by scans.
    """

    def __init__(self, labels: CausalLabels, local_map: LocalMap, T_map_local: Float) -> None:
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
        localization = self._localizer.localize(labels.to_view(), hits, pose)
        self.is_ambiguous = localization.is_ambiguous
        if localization.T is None:
            return None
        return np.asarray(se2.inverse(self._T_map_local) @ localization.T @ self._T_map_local)

    def join(self, labels: CausalLabels, local_map: LocalMap, T: Float) -> LocalMap:
        """The map of before with what was seen since, moved by T (3, 3) of `localize`: the labels
        become those of both, and the local map of both is returned."""
        motion = self._T_map_local @ T @ se2.inverse(self._T_map_local)
        seen = labels.filter
        take_over(self._filter, seen, np.tile(motion, (labels.tags, 1, 1)), 0, seen.block_count)
        labels.filter = self._filter
        self._local_map.join(local_map, T)
        return self._local_map


@dataclass
class _Stretch:
    """Scans since the robot was lost, in one frame.

    Attributes:
        first, last: the first one, and the one after the last; None: it goes on.
        T: (D+1, D+1) by which they move in the frame of the odometry by scans; None: it was not
            found.
        is_tied: loops show where they are in the map.
    """

    first: int
    last: int | None = None
    T: Float | None = None
    is_tied: bool = False

    def slice(self) -> slice:
        return slice(self.first, self.last)


class RobotFinder:
    """Searches the robot while it is lost.

    Args:
        place: localization in a known map; None: the robot maps.
        dimension: 2 or 3; in 3D a robot that was carried while it maps is not searched, but lost
            until loops are closed with the map.
    """

    def __init__(self, place: Localizer | None, dimension: int) -> None:
        self._place, self._dimension = place, dimension
        self._carried: Relocalizer | None = None
        # in 3D before it was carried: cells of the labels, and poses of the spaced scans
        self._left: tuple[OccupancyFilter, Float] | None = None
        self._last_agreed = -1  # scan that agreed with the map
        self._stretches = [] if place is None else [_Stretch(0)]
        # scans that contradicted the map until it was known why: first, last + 1
        self._contradicted = list[tuple[int, int]]()

    @property
    def is_carried(self) -> bool:
        """True if the robot was carried while it maps and is not localized yet."""
        return self._carried is not None

    @property
    def is_lost(self) -> bool:
        """True if the robot is not localized in the map."""
        is_away = self._carried is not None or self._left is not None
        return is_away or (self._place is not None and self._place.is_lost)

    @property
    def is_ambiguous(self) -> bool:
        """True if several poses in the map fit about equally well."""
        searches = (self._carried, self._place)
        return any(search is not None and search.is_ambiguous for search in searches)

    def agree(self, scan: int) -> None:
        """A scan agrees with what is seen since the robot was lost, or with the map."""
        self._last_agreed = scan

    def lose(self, scan: int, labels: CausalLabels, frame: MapFrame, odometry: FrontEnd) -> None:
        """The robot was carried before a scan: the labels begin anew, until it is found."""
        self._begin_stretch(scan)
        if self._carried is not None:
            self._carried.begin(labels)
            return
        frame.finish_correction(labels, odometry)
        if self._place is not None:
            self._place.lose(labels)
        elif self._dimension == 3:
            if self._left is None:
                self._left = labels.filter, frame.spaced_poses()
            labels.filter = labels.filter.sibling()
        else:
            self._carried = Relocalizer(labels, odometry.left_behind, frame.T_map_local)

    def _begin_stretch(self, scan: int) -> None:
        agreed = max(self._last_agreed + 1 - _DOUBTED, 0)
        if self._stretches and self._stretches[-1].last is None:
            self._stretches[-1].last = max(agreed, self._stretches[-1].first)
        self._stretches.append(_Stretch(scan))
        self._contradicted.append((agreed, scan))

    def find(
        self,
        labels: CausalLabels,
        scan: Any,
        pose: Float,
        scans: int,
        frame: MapFrame,
        odometry: FrontEnd,
    ) -> tuple[Float, Float] | None:
        """Search the robot in the map, in which labels and odometry then go on.

        Args:
            labels: of what was seen since it was lost.
            scan: the last one, see `Localizer.localize`.
            pose: (D+1, D+1) of the robot in the frame of the labels.
            scans: number of scans so far.
            frame: of the map.
            odometry: by scans.

        Returns:
            (D+1, D+1) by which its frame moves, and by which poses in the map do; None: not found.
        """
        if self._carried is not None:
            carried = self._carried
            T = carried.localize(labels, scan, pose)
            if T is None:
                return None
            odometry.enter(carried.join(labels, odometry.local_map, T), T)
            frame.enter(_COVARIANCE)
            self._carried = None
            self._stretches[-1].last, self._stretches[-1].T = scans, T
            return T, frame.T_map_local @ T @ se2.inverse(frame.T_map_local)
        place = self._place
        T = None if place is None else place.localize(labels, scan, pose)
        if T is None or place is None:
            return None
        odometry.enter(place.make_local_map(), T)
        place.enter(labels, T)
        self._stretches[-1].last, self._stretches[-1].T = scans, T
        return T, T

    def tie(self, frame: MapFrame, labels: CausalLabels) -> bool:
        """While it maps in 3D, the robot is found once loops show where it is; True if they do now.

        Args:
            frame: of the map.
            labels: of what was seen since it was lost; they become those of the map with it.
        """
        if self._place is not None:
            return False
        untied = frame.untied
        for stretch in self._stretches:
            stretch.is_tied = stretch.first not in untied
        if self._left is None or not self._stretches[-1].is_tied:
            return False
        (left, poses), seen = self._left, labels.filter
        self._left, labels.filter = None, left.sibling()
        # in the background loops from before may have been closed since; what was seen has moved
        for source, motion in ((left, frame.motion_since(poses)), (seen, np.zeros((0, 4, 4)))):
            take_over(labels.filter, source, motion, 0, source.block_count)
        return True

    def move(self, local: Float, scan: int) -> Float:
        """(D+1, D+1) a pose in the frame of the odometry by scans, as it is known now."""
        for stretch in self._stretches:
            if stretch.T is not None and stretch.first <= scan < (stretch.last or 0):
                return np.asarray(stretch.T @ local)
        return local

    def move_all(self, local: Float) -> Float:
        """(T, D+1, D+1) the same of all scans."""
        out = local.copy()
        for stretch in self._stretches:
            if stretch.T is not None:
                out[stretch.slice()] = stretch.T @ out[stretch.slice()]
        return out

    def submaps(self, scans: int) -> NDArray[np.int64]:
        """(T,) of all scans so far, see `Placement`."""
        out = np.zeros(scans, np.int64)
        for number, stretch in enumerate(self._stretches, 1):
            if stretch.T is None and not stretch.is_tied:
                out[stretch.slice()] = number
        for first, last in self._contradicted:
            out[first:last] = -1
        return out
