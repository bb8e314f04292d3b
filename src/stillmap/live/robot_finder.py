"""A robot that is lost: in a known map, or carried elsewhere while it maps."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.live.causal_labels import CausalLabels
from stillmap.live.front_end import FrontEnd
from stillmap.live.map_frame import MapFrame
from stillmap.live.place import PlaceTracker
from stillmap.live.relocalization import Relocalizer
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]


class RobotFinder:
    """Searches the robot while it is lost.

    Args:
        place: localization in a known map; None: the robot maps.
        dimension: 2 or 3; in 3D a robot that was carried is not searched, the map begins anew.
    """

    def __init__(self, place: PlaceTracker | None, dimension: int) -> None:
        self._place, self._dimension = place, dimension
        self._carried: Relocalizer | None = None
        self._last_agreed = -1  # scan that agreed with the map
        self._lost_since = 0  # scan
        # scans that were found later: first, last + 1, motion in the frame of the odometry by scans
        self._moves = list[tuple[int, int, Float]]()

    @property
    def is_carried(self) -> bool:
        """True if the robot was carried while it maps and is not localized yet."""
        return self._carried is not None

    @property
    def is_lost(self) -> bool:
        """True if the robot is not localized in the map."""
        return self._carried is not None or (self._place is not None and self._place.is_lost)

    @property
    def is_ambiguous(self) -> bool:
        """True if several poses in the map fit about equally well."""
        searches = (self._carried, self._place)
        return any(one is not None and one.is_ambiguous for one in searches)

    def agree(self, scan: int) -> None:
        """A scan agrees with the map."""
        if self._carried is None:
            self._last_agreed = scan

    def lose(self, labels: CausalLabels, frame: MapFrame, odometry: FrontEnd) -> None:
        """The robot was carried: the labels begin anew, until it is found."""
        if self._carried is not None:
            self._carried.begin(labels)
            return
        self._lost_since = self._last_agreed + 1
        frame.finish_correction(labels, odometry)
        if self._place is not None:
            self._place.lose()
            labels.clear()
        elif self._dimension == 3:
            labels.clear()
        else:
            self._carried = Relocalizer(labels, odometry.left_behind, frame.T_map_local)

    def find(
        self,
        labels: CausalLabels,
        hits: Scan,
        pose: Float,
        scans: int,
        frame: MapFrame,
        odometry: FrontEnd,
    ) -> tuple[Float, Float] | None:
        """Search the robot in the map, in which labels and odometry then go on.

        Args:
            labels: of what was seen since it was lost.
            hits: of the last scan.
            pose: (3, 3) of the robot in the frame of the labels.
            scans: number of scans so far.
            frame: of the map.
            odometry: by scans.

        Returns:
            (3, 3) by which its frame moves, and by which poses in the map do; None: not found.
        """
        if self._carried is not None:
            carried = self._carried
            T = carried.localize(labels, hits, pose)
            if T is None:
                return None
            odometry.enter(carried.join(labels, odometry.local_map, T), T)
            self._moves.append((self._lost_since, scans, T))
            frame.enter(carried.covariance)
            self._carried = None
            return T, frame.T_map_local @ T @ se2.inverse(frame.T_map_local)
        place = self._place
        T = None if place is None else place.localize(labels, hits, pose)
        if T is None or place is None:
            return None
        self._moves.append((self._lost_since, scans, T))
        odometry.enter(place.make_local_map(), T)
        place.enter(labels, T)
        return T, T

    def move(self, local: Float, scan: int) -> Float:
        """(3, 3) a pose in the frame of the odometry by scans, as it is known now."""
        for first, last, T in self._moves:
            local = T @ local if first <= scan < last else local
        return local

    def move_all(self, local: Float) -> Float:
        """(T, 3, 3) the same of all scans."""
        out = local.copy()
        for first, last, T in self._moves:
            out[first:last] = T @ out[first:last]
        return out
