"""Localization in a known map: global search while lost, then tracking."""

import os
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import config
from stillmap.core.errors import InputError
from stillmap.core.local_frame import LocalFrame
from stillmap.core.parallel import resolve_threads
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter, take_over
from stillmap.live.global_localization import MIN_AGREE_ANYWHERE, GlobalLocalizer, Localization
from stillmap.live.known_cloud import KnownCloud
from stillmap.live.known_map import KnownLocalMap, KnownMap
from stillmap.live.sweep_localization import SweepLocalizer
from stillmap.pipeline.options import DEFAULTS, Options
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]
Mode = Literal["localise", "extend"]


def adopt_resolution(options: Options, known: KnownMap) -> Options:
    """The options with the edge of the cells of a map that is extended.

    Raises:
        InputError: they ask for another one.
    """
    edge, wanted = known.resolution, options.slam.resolution
    if not np.isclose(wanted, [edge, DEFAULTS.slam.resolution]).any():
        hint = f"it is extended with slam.resolution={edge:g}"
        raise InputError(f"the map has cells of {edge:g} m", hint=hint)
    return config.override(options, {"slam": {"resolution": edge}})


def make_tracker(
    source: str | os.PathLike[str], known: KnownMap, mode: Mode, dimension: int, options: Options
) -> "PlaceTracker":
    """Make the tracker of a robot in a known map.

    Args:
        source: folder of a result or a place.
        known: its planar map.
        mode: whether the map stays as it is, or is extended by what is seen.
        dimension: of the scans.
        options: see Options.

    Raises:
        InputError: scans in 3D, and the place is of a planar laser, or is to be extended.
    """
    if dimension == 2:
        return PlaceTracker(PlanarLocalizer(known, mode == "extend"), known.frame)
    if mode == "extend":
        hint = 'mode "localise" takes sweeps'
        raise InputError("only planar maps can be extended", where=str(source), hint=hint)
    threads = resolve_threads(options.threads)
    localizer = SweepLocalizer(KnownCloud(source, known), options, threads)
    return PlaceTracker(localizer, known.frame)


class Localizer(Protocol):
    """A known map in 2D or 3D, and the search in it: `PlanarLocalizer`, `SweepLocalizer`."""

    route: Float  # (T, D) from where it was mapped; empty in 2D, where nobody asks

    def localize(self, labels: CausalLabels, scan: Any, pose: Float, /) -> Localization:
        """The frame of the labels in the known map, by the last scan at its pose there."""

    def forget(self) -> None:
        """The robot was carried: what it saw before was elsewhere."""

    def make_local_map(self) -> Any:
        """The map that scans are matched against once the robot is found."""

    def prime(self, labels: OccupancyFilter, /) -> None:
        """Tell the filters of cells what the map knows."""


class PlanarLocalizer:
    """A planar map, and the search in it.

    Args:
        known: the map.
        extends: whether scans are added to it.
    """

    def __init__(self, known: KnownMap, extends: bool) -> None:
        self.route = np.zeros((0, 2))
        self._known, self._extends = known, extends
        self._search = GlobalLocalizer(known, sure_agree=MIN_AGREE_ANYWHERE)

    def localize(self, labels: CausalLabels, scan: Scan, pose: Float) -> Localization:
        """(3, 3) of the frame of the labels in the known map, if the evidence is clear."""
        return self._search.localize(labels.to_view(), scan, pose)

    def forget(self) -> None:
        """The robot was carried: the labels begin anew."""
        self._search.forget()

    def make_local_map(self) -> KnownLocalMap:
        """The map that scans are matched against from now on."""
        return KnownLocalMap(self._known, self._extends)

    def prime(self, labels: OccupancyFilter) -> None:
        """Tell the filters of cells what the map knows."""
        assert isinstance(labels, _core.OccupancyFilter2D)
        self._known.prime(labels)


class PlaceTracker:
    """State of the localization in a known map: lost or localized, and the frames in between.

    Args:
        localizer: the map, and the search in it.
        frame: of the localizer, in the map frame.

    Attributes:
        frame: the same.
        is_lost: the robot is not found in it yet.
        is_ambiguous: several places fit about as well.
    """

    def __init__(self, localizer: Localizer, frame: LocalFrame) -> None:
        self.frame = frame
        self.is_lost, self.is_ambiguous = True, False
        self._localizer = localizer

    @property
    def route(self) -> Float:
        """(T, D) from where the map was made, in 3D, once the robot is found in it."""
        return self._localizer.route[:0] if self.is_lost else self._localizer.route

    def lose(self) -> None:
        """The robot was carried elsewhere."""
        self.is_lost = True
        self._localizer.forget()

    def localize(self, labels: CausalLabels, scan: Any, pose: Float) -> Float | None:
        """(D+1, D+1) of the frame of the labels in the known map, if the evidence is clear.

        Args:
            labels: of what was seen since the robot was lost.
            scan: the last one; in 2D its hits.
            pose: (D+1, D+1) of the robot in the frame of the labels.
        """
        found = self._localizer.localize(labels, scan, pose)
        self.is_ambiguous = found.is_ambiguous
        if found.T is None:
            return None
        self.is_lost = False
        return found.T

    def make_local_map(self) -> Any:
        """The map that scans are matched against from now on."""
        return self._localizer.make_local_map()

    def enter(self, labels: CausalLabels, T: Float) -> None:
        """Let labels go on from the known map, with what was seen since the robot was lost."""
        known, seen = labels.filter.sibling(), labels.filter
        self._localizer.prime(known)
        tags = labels.tags
        take_over(known, seen, np.tile(T, (tags, 1, 1)), 0, seen.block_count)
        labels.filter = known
