"""Localization in a known map: global search while lost, then tracking."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import config
from stillmap.core.errors import InputError
from stillmap.live.causal_labels import CausalLabels, take_over
from stillmap.live.global_localization import GlobalLocalizer, Localization
from stillmap.live.known_map import KnownLocalMap, KnownMap
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


class PlaceTracker:
    """State of the localization in a known map: lost or localized, and the frames in between.

    Args:
        known: the map.
        mode: whether the map stays as it is, or is extended by what is seen.

    Attributes:
        known, extends: the map, and whether it is extended.
        is_lost: the robot is not found in it yet.
        is_ambiguous: several places fit about as well.
    """

    def __init__(self, known: KnownMap, mode: Mode) -> None:
        self.is_lost, self.is_ambiguous = True, False
        self.known, self.extends = known, mode == "extend"
        self._localizer = GlobalLocalizer(known)

    def lose(self) -> None:
        """The robot was carried elsewhere."""
        self.is_lost = True

    def localize(self, labels: CausalLabels, hits: Scan, pose: Float) -> Float | None:
        """(3, 3) of the frame of the labels in the known map, if the evidence is clear.

        Args:
            labels: of what was seen since the robot was lost.
            hits: of the last scan.
            pose: (3, 3) of the robot in the frame of the labels.
        """
        found: Localization = self._localizer.localize(labels.to_view(), hits, pose)
        self.is_ambiguous = found.is_ambiguous
        if found.T is None:
            return None
        self.is_lost = False
        return found.T

    def make_local_map(self) -> KnownLocalMap:
        """The map that scans are matched against from now on."""
        return KnownLocalMap(self.known, self.extends)

    def enter(self, labels: CausalLabels, T: Float) -> None:
        """Let labels go on from the known map, with what was seen since the robot was lost."""
        known, seen = labels.filter.sibling(), labels.filter
        assert isinstance(known, _core.OccupancyFilter2D)
        self.known.prime(known)
        tags = labels.tags
        take_over(known, seen, np.tile(T, (tags, 1, 1)), 0, seen.block_count)
        labels.filter = known
