"""`stillmap.LiveMapper`: scans in, poses, labels and map out, as they are known at the time."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from stillmap.core.array_types import Float, Float32
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.core.parallel import resolve_threads
from stillmap.core.profiling import Progress, no_progress
from stillmap.em import CellProbabilities
from stillmap.io.from_arrays import poses_to_matrices
from stillmap.live.global_localization import PlanarLocalizer
from stillmap.live.history import History
from stillmap.live.known_cloud import KnownCloud
from stillmap.live.known_map import KnownMap
from stillmap.live.online_slam import OnlineSlam
from stillmap.live.robot_finder import Localizer
from stillmap.live.saving import Snapshot
from stillmap.live.scan import Scan, ScanBeams, drop_cover, to_beams
from stillmap.live.sweep_localization import SweepLocalizer
from stillmap.live.sweep_view import empty_map, project_obstacles
from stillmap.live.update import Update
from stillmap.pipeline.options import Options, adopt_cells, resolve_resolution
from stillmap.prepare.plausibility import mapped_range, shorten_far_beams
from stillmap.results.result import Result, to_options

Mode = Literal["localise", "extend"]

_MIN_SCRATCH = 100_000  # bytes: some scans at least


class LiveMapper:
    """Maps scan by scan.

    Args:
        options: `Options`, or the options to change, as of `stillmap.build`.
        place: folder of a result or a place, in whose map the robot is localized; None: the map
            begins empty.
        mode: "localise": that map stays as it is; "extend": what is seen is added to it.
        background: close loops in a process of their own, so that no scan waits for them; else
            between two scans, the same to the bit every time.
        folder: a new one, in which the drive is written as a recording while it lasts: whatever
            happens, `stillmap.read` reads what is there; None: scans are kept in files without a
            name. Where the disk is full, poses go on, and the scans up to then are kept.
        scratch: folder of temporary files; None: the system's.
        max_scratch: bytes, about, that the beams may take which are kept, 17 each, in 3D 21:
            beyond, poses go on alone; None: all are kept.
        lag: s after which each scan is labelled once more, see `Update.hindsight`; None: it is not.

    Raises:
        InputError: the place has no map, an empty one, or in mode "extend" one of other cells.
            Likewise `push` of a first sweep of a lidar, if it is of a planar laser, or in mode
            "extend" has other voxels.

    Examples:
        >>> with stillmap.LiveMapper() as mapper:
        >>>     update = mapper.push(stillmap.Scan(stamp, ranges, angles), odometry=(x, y, theta))
        >>>     update.pose, update.p_static
        >>>     mapper.save("out")
    """

    def __init__(
        self,
        options: Options | Mapping[str, Any] | None = None,
        *,
        place: str | os.PathLike[str] | None = None,
        mode: Mode = "localise",
        background: bool = False,
        folder: str | os.PathLike[str] | None = None,
        scratch: str | os.PathLike[str] | None = None,
        max_scratch: int | None = None,
        lag: float | None = None,
    ) -> None:
        if max_scratch is not None and not max_scratch >= _MIN_SCRATCH:
            raise ValueError(f"max_scratch: expected {_MIN_SCRATCH} bytes or more: {max_scratch}")
        if lag is not None and not 0.0 < lag < np.inf:
            raise ValueError(f"lag: expected positive seconds, got {lag}")
        self.options = to_options(options)
        self._source, self._mode = place, mode
        self._known = None if place is None else KnownMap(place)
        if self._known is not None and mode == "extend":
            self.options = adopt_cells(self.options, "map", {"resolution": self._known.resolution})
        self._begin = partial(OnlineSlam, in_background=background, lag=lag)
        drive, temporary = (None if path is None else Path(path) for path in (folder, scratch))
        self._make_history = partial(
            History, folder=drive, scratch=temporary, max_bytes=max_scratch
        )
        self._mapping: OnlineSlam | None = None  # since the first scan
        self._last_ns = 0
        self._is_closed = False

    def push(self, scan: Scan | ScanBeams, odometry: ArrayLike | None = None) -> Update:
        """Register a scan, label its beams, and add it to the map.

        Args:
            scan: the next scan in time; the first one says whether mapping is in 2D or 3D.
            odometry: T_odom_base at its stamp, (3,) x, y, theta, or (3, 3), in 3D (4, 4); None:
                there is none.

        Raises:
            ValueError: names the argument, what was expected, and what it was; or the mapper is
                closed.
        """
        beams = self._to_usable_beams(scan)
        self._require_next(beams)
        T_odom_base = _to_matrix(odometry, beams.dimension)
        if self._mapping is None:
            localizer = self._make_localizer(beams.dimension)  # which may change the options
            history = self._make_history(beams.dimension)
            self._mapping = self._begin(self.options, history, localizer)
        self._last_ns = beams.stamp_ns
        return self._mapping.push(beams, T_odom_base)

    def update_map(self) -> None:
        """Add the last scan to the map and to what is kept.

        `push` answers before that; whatever is called next does it, with the same results. Called
        once an answer is on its way, the next one comes sooner.
        """
        if self._mapping is not None:
            self._mapping.update_map()

    def label(self, scan: Scan | ScanBeams, number: int) -> Float32:
        """(N,) P(static) of the beams of an earlier scan, by what is known now.

        Args:
            scan: as it was pushed.
            number: how many scans were pushed before it.

        Raises:
            InputError: no scan was pushed.
        """
        return self._pushed.label(self._to_usable_beams(scan), number)

    @property
    def poses(self) -> Float:
        """(T, D+1, D+1) T_map_base of the scans that are kept, as they are known now; NaN where the
        place in the map is not known: while the robot is lost, or if it was carried away before it
        was found."""
        if self._slam is None:
            return np.zeros((0, 3, 3))
        poses, submap = self._slam.placement()
        return np.where((submap == 0)[:, None, None], poses, np.nan)

    @property
    def path(self) -> Float:
        """(S, D+1, D+1) T_map_base of spaced scans, as they are known now: quicker than `poses`.
        Only those since the robot was found or lost."""
        return np.zeros((0, 3, 3)) if self._slam is None else self._slam.path()

    @property
    def map(self) -> GridMap:
        """The map of what stands, as it is known now; in 3D of the obstacles above the ground.
        NaN: unknown."""
        if self._slam is None:
            return empty_map(self.resolution)
        labels, output = self._slam.labels, self.options.output
        if self._slam.dimension == 2:
            grid = labels.to_map()
        else:
            band = output.min_obstacle_height, output.max_obstacle_height
            cells, route = labels.known_cells(), self._slam.route()
            grid = project_obstacles(cells, route, band, self.resolution)
        return self._slam.in_map_frame(grid)

    @property
    def cells(self) -> CellProbabilities:
        """P(static and occupied) of the cells, in 3D voxels, in which beams ended."""
        if self._slam is None:
            return CellProbabilities(np.zeros((0, 2), np.int64), np.zeros(0, np.float32), 0.0)
        return self._slam.in_map_frame(self._slam.labels.known_cells())

    @property
    def resolution(self) -> float:
        """m, edge of the cells in which `Update.changes` are, once a scan was pushed."""
        begun = self._mapping
        return self.options.slam.resolution if begun is None else begun.resolution

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the folder that `stillmap.build(...).save` writes, of what is known now.

        The poses are those known now, labels and map follow from all scans so far. `live/` has what
        was answered at the time. Scans whose place in the map is not known are left out: see
        `Snapshot.save`.

        Raises:
            InputError: no scan was pushed, or the folder is taken or cannot be written to.
        """
        self.snapshot().save(path, overwrite=overwrite, progress=progress)

    def snapshot(self) -> Snapshot:
        """All scans so far and what is known of them: to save them while more are pushed.

        Raises:
            InputError: no scan was pushed.
        """
        slam = self._pushed
        history = slam.history
        if not history.kept:
            raise InputError("no scan could be kept: the disk was full")
        recording, p_static = history.recording(), history.labels()
        given, (poses, submap) = history.notes()["pose"].copy(), slam.placement()
        kept_map = slam.keep_map() if self._mode == "extend" else None
        return Snapshot(
            recording, given, p_static, poses, submap, self.options, history.folder, kept_map
        )

    def move_folder(self, folder: Path) -> None:
        """Move the recording of the drive, which goes on there.

        Raises:
            OSError: it cannot be moved.
        """
        self._pushed.history.move(folder)

    def finish(self, progress: Progress = no_progress) -> Result:
        """The result of `stillmap.build` on all scans: poses, labels and map refined.

        Raises:
            InputError: no scan was pushed.
        """
        return self.snapshot().refine(progress)

    def close(self) -> None:
        """Forget all scans, and end the process that closes loops, if there is one."""
        self._is_closed = True
        if self._mapping is not None:
            self._mapping.close()

    def __enter__(self) -> LiveMapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make_localizer(self, dimension: int) -> Localizer | None:
        known, extends = self._known, self._mode == "extend"
        if self._source is None or known is None:
            return None
        if dimension == 2:
            return PlanarLocalizer(known, extends)
        if extends:
            self.options = adopt_cells(self.options, "map", {"voxel_size": known.resolution})
        threads = resolve_threads(self.options.threads)
        return SweepLocalizer(KnownCloud(self._source, known), extends, self.options, threads)

    @property
    def _slam(self) -> OnlineSlam | None:
        """The mapping that began with the first scan, with all that the last one changes."""
        if self._is_closed:
            raise ValueError("mapper: expected one that is not closed")
        self.update_map()
        return self._mapping

    @property
    def _pushed(self) -> OnlineSlam:
        """The mapping that began with the first scan; an error before it."""
        slam = self._slam
        if slam is None:
            raise InputError("no scan was pushed yet")
        return slam

    def _require_next(self, beams: ScanBeams) -> None:
        """Check a scan against those before."""
        slam, D = self._slam, beams.dimension
        if slam is None:
            return
        if slam.dimension != D:
            raise ValueError(f"scan: expected {slam.dimension}D as before, got {D}D")
        if beams.stamp_ns < self._last_ns:
            late = 1e-9 * (self._last_ns - beams.stamp_ns)
            raise ValueError(f"stamp: expected none before the last scan, got {late:.6f} s earlier")

    def _to_usable_beams(self, scan: Scan | ScanBeams) -> ScanBeams:
        """The beams of a scan that can be mapped."""
        beams = drop_cover(scan if isinstance(scan, ScanBeams) else to_beams(scan))
        cell = resolve_resolution(self.options, beams.dimension).slam.resolution
        stated = scan.max_range if isinstance(scan, Scan) else None
        reach = mapped_range(beams.dimension, cell, stated or self.options.read.max_range)
        points, hit = shorten_far_beams(beams.points, beams.hit, reach)
        return beams if hit is beams.hit else dataclasses.replace(beams, points=points, hit=hit)


def _to_matrix(odometry: ArrayLike | None, dimension: int) -> Float | None:
    """(D+1, D+1) T_odom_base; None: there is none."""
    if odometry is None:
        return None
    given = np.asarray(odometry, np.float64)[None]
    return np.asarray(poses_to_matrices("odometry", given, 1, dimension)[0])
