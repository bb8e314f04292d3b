"""A robot that is lost: in a known map, or carried elsewhere while it maps."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Int64
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.global_localization import OwnMap, PlanarLocalizer
from stillmap.live.local_map import LocalMap
from stillmap.live.map_frame import LiveOdometry, MapFrame
from stillmap.live.sweep_localization import SweepLocalizer

Localizer = PlanarLocalizer | SweepLocalizer

_COVARIANCE = np.diag(np.square([0.1, 0.1, 0.02]))  # m, m, rad: of a pose that was found
# of the scans that agreed with the map before others contradicted it, the last ones: somewhere else
# the first scans may agree by chance
_DOUBTED = 5


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

    def slice(self, begin: int = 0) -> slice:
        """Its scans, counted from scan `begin` on."""
        last = None if self.last is None else max(self.last - begin, 0)
        return slice(max(self.first - begin, 0), last)


class RobotFinder:
    """Searches the robot while it is lost.

    Args:
        place: localization in a known map; None: the robot maps. In 3D it is then not searched if
            it was carried, but lost until loops are closed with the map.
        labels: of the map, or of what was seen since the robot was lost.
        odometry: by scans.
        frame: of it in the map.
    """

    def __init__(
        self, place: Localizer | None, labels: CausalLabels, odometry: LiveOdometry, frame: MapFrame
    ) -> None:
        self._place, self._labels, self._odometry, self._frame = place, labels, odometry, frame
        self._carried: OwnMap | None = None
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
        return self._left is not None or (self._search is not None and self._search.is_lost)

    @property
    def is_ambiguous(self) -> bool:
        """True if several poses in the map fit about equally well."""
        return self._search is not None and self._search.is_ambiguous

    @property
    def _search(self) -> Localizer | None:
        return self._carried or self._place

    def agree(self, scan: int) -> None:
        """A scan agrees with what is seen since the robot was lost, or with the map."""
        self._last_agreed = scan

    def lose(self, scan: int) -> None:
        """The robot was carried before a scan: the labels begin anew, until it is found."""
        self._begin_stretch(scan)
        if self._carried is None:
            self._frame.go_on(to_the_end=True)
        labels, left_behind = self._labels, self._odometry.left_behind
        if self._search is not None:
            self._search.forget(labels)
            self._search.is_lost = True
        elif isinstance(left_behind, LocalMap):
            self._carried = OwnMap(labels, left_behind)
        else:
            if self._left is None:
                self._left = labels.filter, self._frame.spaced_poses()
            labels.filter = labels.filter.sibling()

    def _begin_stretch(self, scan: int) -> None:
        agreed = max(self._last_agreed + 1 - _DOUBTED, 0)
        if self._stretches and self._stretches[-1].last is None:
            self._stretches[-1].last = max(agreed, self._stretches[-1].first)
        self._stretches.append(_Stretch(scan))
        self._contradicted.append((agreed, scan))

    def find(self, scan: Any, pose: Float, scans: int) -> tuple[Float, Float] | None:
        """Search the robot in the map, in which labels and odometry then go on.

        Args:
            scan: the last one, see `Localizer.localize`.
            pose: (D+1, D+1) of the robot in the frame of the labels.
            scans: number of scans so far.

        Returns:
            (D+1, D+1) by which its frame moves, and by which poses in the map do; None: not found.
        """
        search, labels, frame = self._search, self._labels, self._frame
        T = None if search is None else search.localize(labels, scan, pose)
        if search is None or T is None:
            return None
        motion = np.asarray(se2.inverse(frame.T_map_local) @ T @ frame.T_map_local)
        local_map = search.make_local_map(self._odometry.local_map, motion)
        self._odometry.enter(local_map, motion)
        seen = labels.filter
        known = search.known_filter(seen.sibling())
        take_over(known, seen, np.tile(T, (labels.tags, 1, 1)), 0, seen.block_count)
        labels.filter, search.is_lost = known, False
        frame.enter(_COVARIANCE)
        self._carried = None
        self._stretches[-1].last, self._stretches[-1].T = scans, motion
        return motion, T

    def tie(self) -> bool:
        """While it maps in 3D, the robot is found once loops show where it is; True if they do now:
        the labels are those of the map then, with what was seen since it was lost."""
        if self._place is not None:
            return False
        labels, frame = self._labels, self._frame
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

    def move(self, local: Float, first: int = 0) -> Float:
        """(K, D+1, D+1) poses in the frame of the odometry by scans, as they are known now, of the
        scans from the first one on."""
        out = local.copy()
        for stretch in self._stretches:
            if stretch.T is not None:
                moved = stretch.slice(first)
                out[moved] = stretch.T @ out[moved]
        return out

    def submaps(self, scans: int) -> Int64:
        """(T,) of all scans so far, see `Placement`."""
        out = np.zeros(scans, np.int64)
        for number, stretch in enumerate(self._stretches, 1):
            if stretch.T is None and not stretch.is_tied:
                out[stretch.slice()] = number
        for first, last in self._contradicted:
            out[first:last] = -1
        return out
