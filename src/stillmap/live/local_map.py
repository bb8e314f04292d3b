"""The local map that scans are matched against, and the spaced scans of the whole run."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.short_repr import ShortRepr
from stillmap.live.history import GrowingRecording
from stillmap.live.scan import ScanBeams, take_beams
from stillmap.slam import loop_closure, loop_closure_3d, scan_hits
from stillmap.slam.local_map import is_spaced
from stillmap.slam.options import SlamOptions
from stillmap.slam.types import LoopContext

_LABELLED_AFTER_NS = 10**9  # after which scans are labelled again
_MAX_TRAVEL = 25.0  # m after which scans leave
_MAX_DELAY_NS, _MAX_DELAY = 250_000_000, 1.0  # ns and m by which both may be late


@dataclass(frozen=True, eq=False)
class MappedScan(ShortRepr):
    """A scan in a map.

    Attributes:
        beams: of the scan, as if all had been taken at its stamp.
        e: (N,) float32, P(static) with which it was added.
        T_map_base: (D+1, D+1).
        travelled: m up to it.
    """

    beams: ScanBeams
    e: Float32
    T_map_base: Float
    travelled: float


def thin_scan(scan: MappedScan, max_beams: int) -> MappedScan:
    """Every k-th beam of a scan, as many as are wanted at most."""
    every = slice(None, None, max(-(-len(scan.e) // max_beams), 1))
    return replace(scan, beams=take_beams(scan.beams, every), e=scan.e[every].copy())


Labeller = Callable[[MappedScan], Float32]  # P(static) (N,) of a scan


class LocalMap:
    """A map of spaced scans.

    Args:
        resolution: m, edge of a cell.
    """

    def __init__(self, resolution: float) -> None:
        self.grid = _core.OccupancyGrid2D(resolution, scan_hits.FREE_SPACE_MARGIN)
        self._scans = deque[MappedScan]()  # by travel
        self._last: dict[str | int, MappedScan] = {}  # of each sensor
        self._recent = deque[MappedScan]()  # that are to be labelled again

    def extend(self, scans: Iterable[MappedScan]) -> None:
        """Add scans, however close, in the order of travel."""
        for scan in scans:
            self._insert(scan)

    def join(self, later: "LocalMap", T: Float) -> None:
        """Add the scans of another map, which were taken later, moved by T (3, 3)."""
        self.extend(replace(scan, T_map_base=T @ scan.T_map_base) for scan in later._scans)

    def add(self, scan: MappedScan) -> bool:
        """Add a scan unless it is too close to the last one of its sensor; True if it was added."""
        last = self._last.get(scan.beams.sensor)
        if last is not None:
            step_ns = scan.beams.stamp_ns - last.beams.stamp_ns
            if not is_spaced(last.T_map_base, scan.T_map_base, step_ns):
                return False
        self._insert(scan)
        self._recent.append(scan)
        return True

    def tend(self, stamp_ns: int, travelled: float, label: Labeller, most: float) -> None:
        """Label scans again after a second, each once, and remove those of long ago.

        Args:
            stamp_ns: now.
            travelled: m of travel so far.
            label: labels an earlier scan by what is known by now.
            most: scans for which this is done now, unless it is overdue.
        """
        due_ns, before = stamp_ns - _LABELLED_AFTER_NS, travelled - _MAX_TRAVEL
        while self._recent and self._recent[0].beams.stamp_ns <= due_ns:
            if most <= 0 and self._recent[0].beams.stamp_ns > due_ns - _MAX_DELAY_NS:
                break
            self._relabel(self._recent.popleft(), label)
            most -= 1
        while self._scans and self._scans[0].travelled < before:
            if most <= 0 and self._scans[0].travelled >= before - _MAX_DELAY:
                break
            add_scan(self.grid, self._scans.popleft(), remove=True)
            most -= 1

    def _relabel(self, scan: MappedScan, label: Labeller) -> None:
        at = next((k for k, mapped in enumerate(self._scans) if mapped is scan), None)
        if at is not None:
            self._scans[at] = relabel_scan(self.grid, scan, label)

    def remove_since(self, stamp_ns: int) -> None:
        """Remove the scans taken since."""
        while self._scans and self._scans[-1].beams.stamp_ns >= stamp_ns:
            add_scan(self.grid, self._scans.pop(), remove=True)
        left = reversed(self._scans)
        self._last = {}
        for scan in left:
            self._last.setdefault(scan.beams.sensor, scan)

    def has_sensor(self, sensor: str | int, /) -> bool:
        """True if it holds a scan of a sensor."""
        return sensor in self._last

    def _insert(self, scan: MappedScan) -> None:
        add_scan(self.grid, scan)
        self._scans.append(scan)
        last = self._last.get(scan.beams.sensor)
        if last is None or last.beams.stamp_ns <= scan.beams.stamp_ns:
            self._last[scan.beams.sensor] = scan


def relabel_scan(grid: _core.OccupancyGrid2D, scan: MappedScan, label: Labeller) -> MappedScan:
    """Replace the labels of a scan in a map for registration."""
    relabelled, beams = replace(scan, e=label(scan)), scan.beams
    T = scan.T_map_base @ beams.T_base_sensor
    scan_hits.replace_weights(grid, beams.points, beams.hit, scan.e, relabelled.e, T)
    return relabelled


def add_scan(grid: _core.OccupancyGrid2D, scan: MappedScan, *, remove: bool = False) -> None:
    """Add a scan to a map for registration, or remove it."""
    beams = scan.beams
    scan_hits.add_hits(
        grid, beams.points, beams.hit, scan.e, scan.T_map_base @ beams.T_base_sensor, remove=remove
    )


class SpacedScans(GrowingRecording):
    """Spaced scans, appended.

    Args:
        dimension: 2 or 3.
        options: see SlamOptions.
        folder: of the temporary files; None: the system's.

    Attributes:
        keyframe_distance: m of travel between keyframes.
    """

    def __init__(self, dimension: int, options: SlamOptions, folder: Path | None = None) -> None:
        pose = (dimension + 1,) * 2
        shapes = {"poses": pose, "travelled": (), "explained": (), "drift": (3, 3)}
        notes = np.dtype([(name, np.float64, shape) for name, shape in shapes.items()])
        super().__init__(dimension, notes, scratch=folder)
        defaults = loop_closure if dimension == 2 else loop_closure_3d
        search = options.loop_search_distance
        self._search_distance = defaults.SEARCH_DISTANCE if search is None else search
        self._resolution = options.resolution
        self.keyframe_distance = options.keyframe_distance or defaults.KEYFRAME_DISTANCE

    def add(self, scan: MappedScan, explained: float, drift: Float) -> None:
        """Append a scan.

        Args:
            scan: at its pose in the frame of the odometry by scans.
            explained: share of it that the local map explained.
            drift: (3, 3) covariance that the steps since the last one add, where scans say nothing.

        Raises:
            OSError: the disk is full.
        """
        notes: dict[str, Any] = {"poses": scan.T_map_base, "travelled": scan.travelled}
        self.append(scan.beams, scan.e, **notes, explained=explained, drift=drift)

    def context(self, keyframes: Index) -> LoopContext:
        """All scans so far, of which some are keyframes."""
        notes = self.notes()
        assert notes.dtype.names is not None
        return LoopContext(
            self.recording(),
            self.labels(),
            keyframes=keyframes,
            resolution=self._resolution,
            keyframe_distance=self.keyframe_distance,
            search_distance=self._search_distance,
            **{name: notes[name].copy() for name in notes.dtype.names},
        )

    def scan(self, context: LoopContext, number: int) -> MappedScan:
        """One of the scans of a context."""
        recording = context.recording
        sensor = list(self._mounts)[recording.sensor[number]]
        beams = ScanBeams.of(recording, number, sensor)
        e = np.array(context.e[recording.beams_of(number)])
        return MappedScan(beams, e, context.poses[number], float(context.travelled[number]))
