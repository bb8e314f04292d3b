"""Localization in a known map: global search while lost, then tracking."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.local_frame import LocalFrame
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.global_localization import MIN_AGREE_ANYWHERE, GlobalLocalizer, Localization
from stillmap.live.known_map import KeptMap, KnownLocalMap, KnownMap
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]


class Localizer(ABC):
    """A known map in 2D or 3D, and the search in it.

    Args:
        known: the map.
        extends: whether scans are added to it.

    Attributes:
        frame: of the search, in the map frame.
        is_lost: the robot is not found in the map yet.
        is_ambiguous: several places fit about as well.
    """

    def __init__(self, known: KnownMap, extends: bool) -> None:
        self.frame: LocalFrame = known.frame
        self.is_lost, self.is_ambiguous = True, False
        self._extends = extends

    @property
    def route(self) -> Float:
        """(T, D) from where the map was made, in 3D, once the robot is found in it."""
        return np.zeros((0, 2))

    def lose(self, labels: CausalLabels) -> None:
        """The robot was carried elsewhere: the labels begin anew."""
        self._forget(labels)
        self.is_lost = True

    def localize(self, labels: CausalLabels, scan: Any, pose: Float) -> Float | None:
        """(D+1, D+1) of the frame of the labels in the known map, if the evidence is clear.

        Args:
            labels: of what was seen since the robot was lost.
            scan: the last one; in 2D its hits.
            pose: (D+1, D+1) of the robot in the frame of the labels.
        """
        localization = self._search(labels, scan, pose)
        self.is_ambiguous = localization.is_ambiguous
        self.is_lost = self.is_lost and localization.T is None
        return localization.T

    def enter(self, labels: CausalLabels, T: Float) -> None:
        """Let labels go on from the known map, with what was seen since the robot was lost."""
        seen = labels.filter
        known = self._known_filter(seen.sibling())
        take_over(known, seen, np.tile(T, (labels.tags, 1, 1)), 0, seen.block_count)
        labels.filter = known

    @abstractmethod
    def make_local_map(self) -> Any:
        """The map that scans are matched against once the robot is found."""

    @abstractmethod
    def keep(self, labels: CausalLabels) -> KeptMap:
        """The part of the known map that an extended one keeps, as of now; `labels`: so far."""

    @abstractmethod
    def _search(self, labels: CausalLabels, scan: Any, pose: Float) -> Localization: ...

    @abstractmethod
    def _forget(self, labels: CausalLabels) -> None:
        """Begin anew, with labels of the map, or of elsewhere where the robot was lost already."""

    @abstractmethod
    def _known_filter(self, empty: OccupancyFilter) -> OccupancyFilter:
        """Filters of cells with what the map knows; `empty`: such of the same kind."""


class PlanarLocalizer(Localizer):
    """A planar map, and the search in it; see `Localizer`."""

    def __init__(self, known: KnownMap, extends: bool) -> None:
        super().__init__(known, extends)
        self._known = known
        self._global = GlobalLocalizer(known, sure_agree=MIN_AGREE_ANYWHERE)

    def make_local_map(self) -> KnownLocalMap:
        """The map that scans are matched against from now on."""
        return KnownLocalMap(self._known, self._extends)

    def keep(self, _labels: CausalLabels) -> KeptMap:
        """The map as it was."""
        return KeptMap(self._known.in_map_frame, self._known.hits)

    def _search(self, labels: CausalLabels, scan: Scan, pose: Float) -> Localization:
        return self._global.localize(labels.to_view(), scan, pose)

    def _forget(self, labels: CausalLabels) -> None:
        self._global.forget()
        labels.clear()

    def _known_filter(self, empty: OccupancyFilter) -> OccupancyFilter:
        assert isinstance(empty, _core.OccupancyFilter2D)
        self._known.prime(empty)
        return empty
