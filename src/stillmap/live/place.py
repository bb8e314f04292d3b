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
from stillmap.live.known_map import KeptMap, KnownLocalMap, KnownMap
from stillmap.live.sweep_localization import SweepLocalizer
from stillmap.pipeline.options import DEFAULTS, Options
from stillmap.slam.scan_hits import Scan

Float = NDArray[np.float64]
Mode = Literal["localise", "extend"]


def adopt_resolution(options: Options, known: KnownMap, dimension: int = 2) -> Options:
    """The options with the edge of the cells of a map that is extended, in 3D of its voxels.

    Raises:
        InputError: they ask for another one.
    """
    name = "resolution" if dimension == 2 else "voxel_size"
    edge, wanted, default = (
        known.resolution,
        getattr(options.slam, name),
        getattr(DEFAULTS.slam, name),
    )
    if wanted != default and not np.isclose(wanted, edge):
        hint = f"it is extended with slam.{name}={edge:g}"
        raise InputError(f"the map has cells of {edge:g} m", hint=hint)
    return config.override(options, {"slam": {name: edge}})


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
        InputError: scans in 3D, and the place is of a planar laser.
    """
    extends = mode == "extend"
    if dimension == 2:
        return PlaceTracker(PlanarLocalizer(known, extends), known.frame)
    threads = resolve_threads(options.threads)
    localizer = SweepLocalizer(KnownCloud(source, known), extends, options, threads)
    return PlaceTracker(localizer, known.frame)


class Localizer(Protocol):
    """A known map in 2D or 3D, and the search in it: `PlanarLocalizer`, `SweepLocalizer`."""

    @property
    def route(self) -> Float:
        """(T, D) from where it was mapped; empty in 2D, where nobody asks."""

    def localize(self, labels: CausalLabels, scan: Any, pose: Float, /) -> Localization:
        """The frame of the labels in the known map, by the last scan at its pose there."""

    def forget(self, labels: CausalLabels, was_lost: bool, /) -> None:
        """The robot was carried: the labels, of what was seen so far, begin anew.

        Args:
            labels: of the map; where the robot was lost already, of elsewhere.
            was_lost: that it was.
        """

    def make_local_map(self) -> Any:
        """The map that scans are matched against once the robot is found."""

    def known_filter(self, empty: OccupancyFilter, /) -> OccupancyFilter:
        """Filters of cells with what the map knows; `empty`: such of the same kind."""

    def keep(self, labels: CausalLabels, is_lost: bool, /) -> KeptMap:
        """The part of a known map that an extended one keeps now; arguments: see `forget`."""


class PlanarLocalizer:
    """A planar map, and the search in it.

    Args:
        known: the map.
        extends: whether scans are added to it.
    """

    def __init__(self, known: KnownMap, extends: bool) -> None:
        self._known, self._extends = known, extends
        self._search = GlobalLocalizer(known, sure_agree=MIN_AGREE_ANYWHERE)

    @property
    def route(self) -> Float:
        """(0, 2)."""
        return np.zeros((0, 2))

    def localize(self, labels: CausalLabels, scan: Scan, pose: Float) -> Localization:
        """(3, 3) of the frame of the labels in the known map, if the evidence is clear."""
        return self._search.localize(labels.to_view(), scan, pose)

    def forget(self, labels: CausalLabels, _was_lost: bool) -> None:
        """The robot was carried: the labels begin anew."""
        self._search.forget()
        labels.clear()

    def make_local_map(self) -> KnownLocalMap:
        """The map that scans are matched against from now on."""
        return KnownLocalMap(self._known, self._extends)

    def known_filter(self, empty: OccupancyFilter) -> OccupancyFilter:
        """The filters of cells with what the map knows."""
        assert isinstance(empty, _core.OccupancyFilter2D)
        self._known.prime(empty)
        return empty

    def keep(self, _labels: CausalLabels, _is_lost: bool) -> KeptMap:
        """The map as it was."""
        return KeptMap(self._known.in_map_frame, self._known.hits)


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

    def lose(self, labels: CausalLabels) -> None:
        """The robot was carried elsewhere: the labels begin anew."""
        self._localizer.forget(labels, self.is_lost)
        self.is_lost = True

    def keep(self, labels: CausalLabels) -> KeptMap:
        """The part of a known map that an extended one keeps, as of now.

        Args:
            labels: of what was seen so far.
        """
        return self._localizer.keep(labels, self.is_lost)

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
        seen = labels.filter
        known = self._localizer.known_filter(seen.sibling())
        tags = labels.tags
        take_over(known, seen, np.tile(T, (tags, 1, 1)), 0, seen.block_count)
        labels.filter = known
