"""`stillmap.LiveMapper`: scans in, poses, labels and map out, as they are known at the time."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.core.parallel import resolve_threads
from stillmap.core.profiling import Progress, no_progress
from stillmap.em import CellProbabilities
from stillmap.io.array_checks import poses_to_matrices
from stillmap.live.causal_labels import CausalLabels, MapChange
from stillmap.live.front_end import FrontEnd, Registration
from stillmap.live.hindsight import Hindsight, LaterLabels
from stillmap.live.history import History
from stillmap.live.known_map import KnownMap
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_closer import NoLoops
from stillmap.live.loop_process import start_closer
from stillmap.live.map_correction import SPACED_PER_TAG, LabelledScan
from stillmap.live.map_frame import LoopClosing, MapFrame, rotate_covariance
from stillmap.live.map_view import project_obstacles
from stillmap.live.movers import MoverTracker
from stillmap.live.observation import BeamSelector, Observation, find_margins
from stillmap.live.place import Mode, PlaceTracker, adopt_resolution
from stillmap.live.robot_finder import RobotFinder
from stillmap.live.saving import Snapshot
from stillmap.live.scan import Scan, ScanBeams, deskew, drop_cover, to_beams
from stillmap.live.scan_hits import normals_of, thin
from stillmap.live.scan_odometry import ScanOdometry
from stillmap.live.sweep_odometry import SweepOdometry
from stillmap.live.update import Update
from stillmap.pipeline.options import Options, resolve_resolution
from stillmap.pipeline.result import map_recording
from stillmap.results.build import to_options
from stillmap.results.result import BuiltResult
from stillmap.slam.scan_hits import Scan as PlanarHits
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]

# weight of a scan in the running share of hits on what moves; share from which people may walk
# along with the robot, and what was only just seen counts little
_MOVING_RATE, _CROWDED = 0.3, 0.15
_MIN_SCRATCH = 100_000  # bytes: some scans at least
_CHANGES_EVERY_NS = 10**9  # between two updates that tell what changed in the map


class LiveMapper:
    """Maps scan by scan.

    Args:
        options: `Options`, or the options to change, as of `stillmap.build`.
        place: folder of a result or a place, in whose map the robot is localized; None: the map
            begins empty.
        mode: "localise": that map stays as it is; "extend": what is seen is added to it.
        background: close loops in a process of their own, so that no scan waits for them; else
            between two scans, the same to the bit every time.
        scratch: folder of the files in which all scans are kept for `save` and `finish`; None: the
            system's temporary folder. While its disk is full scans are kept in memory: beyond
            128 MB every second one is dropped.
        max_scratch: bytes, about, that their beams may take, 17 each, in 3D 21: beyond, every
            second one of the scans that lie most densely is dropped, the oldest first; None: all
            are kept.
        lag: s after which each scan is labelled once more, see `Update.hindsight`; None: it is not.

    Raises:
        InputError: the place has no map, an empty one, or in mode "extend" one of other cells.

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
        scratch: str | os.PathLike[str] | None = None,
        max_scratch: int | None = None,
        lag: float | None = None,
    ) -> None:
        if max_scratch is not None and not max_scratch >= _MIN_SCRATCH:
            raise ValueError(f"max_scratch: expected {_MIN_SCRATCH} bytes or more: {max_scratch}")
        if lag is not None and not 0.0 < lag < np.inf:
            raise ValueError(f"lag: expected positive seconds, got {lag}")
        self.options = to_options(options)
        self._place = None if place is None else PlaceTracker(KnownMap(place), mode)
        if self._place is not None and self._place.extends:
            self.options = adopt_resolution(self.options, self._place.known)
        self._in_background = background
        self._scratch = None if scratch is None else Path(scratch)
        self._max_scratch, self._hindsight = max_scratch, Hindsight(lag)
        self._T_odom_base: Float | None = None
        self._last_ns: int | None = None
        self._is_closed = False
        self._changes_due_ns = 0
        self._path_begin = 0  # the first spaced scan in the frame of the map
        self._moving = 0.0  # share of the hits, as the labels say a second later
        self._begin(2)

    def _begin(self, dimension: int) -> None:
        """Be ready for the first scan."""
        D, options = dimension, self.options
        slam = resolve_resolution(options, D).slam
        self._dimension, self._slam = D, slam
        self._odometry: FrontEnd = (
            ScanOdometry(slam) if D == 2 else SweepOdometry(slam, resolve_threads(options.threads))
        )
        self._labels = CausalLabels(D, slam.resolution, options.em)
        self._selector = BeamSelector(options.em.time_bin)
        self._movers = MoverTracker(D)
        self._history = History(D, self._scratch, self._max_scratch)
        self._frame = MapFrame(D, NoLoops(), self._in_background)
        self._finder = RobotFinder(self._place, D)

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
        beams = drop_cover(scan if isinstance(scan, ScanBeams) else to_beams(scan))
        self._require_next(beams)
        T_odom_base = self._to_matrix(odometry, beams.dimension)
        if self._last_ns is None:
            self._start(beams.dimension)
        increment = self._increment(T_odom_base)
        prior = self._odometry.predict(beams, increment)
        hits = self._weigh(self._odometry.select(beams, prior), prior)
        found = self._odometry.register(beams, hits, prior, increment)  # M-step: (9)
        if found.is_carried:
            self._lose()
        elif not found.is_contradicted:
            self._finder.agree(len(self._history))
        deskewed, anchor = deskew(beams, found.twist), self._frame.last
        labelled = LabelledScan(self._observe(deskewed, hits, anchor), found.T)
        pose = self._frame.T_map_local @ found.T
        if not found.is_contradicted:
            self._labels.add(labelled.observation, pose)
        p_static = self._labels.label(deskewed, pose)  # E-step: (8)
        self._movers.add(deskewed, found.T, p_static)
        self._history.append(beams, p_static, T_odom_base, pose, found.T, anchor, found.twist)
        self._hindsight.add(len(self._history) - 1, beams)
        self._T_odom_base, self._last_ns = T_odom_base, beams.stamp_ns
        update = self._to_update(beams.stamp_ns, found, p_static)
        is_spaced = self._add_to_maps(deskewed, labelled, np.nan_to_num(p_static), found)
        return self._find_robot(hits, update) if is_spaced and self._finder.is_lost else update

    def _observe(self, beams: ScanBeams, hits: Any, anchor: int) -> Observation:
        """The observation by which a scan updates the labels."""
        margin = None
        if isinstance(hits, PlanarHits):
            margin = find_margins(beams, normals_of(beams, hits), self._selector.select(beams))
        return Observation(beams, margin, max(anchor, 0) // SPACED_PER_TAG[beams.dimension])

    def _lose(self) -> None:
        """The robot was carried: labels, tracks and path begin anew."""
        self._movers.clear()
        self._path_begin = self._frame.last + 1
        self._finder.lose(self._labels, self._frame, self._odometry)

    def _find_robot(self, hits: PlanarHits, update: Update) -> Update:
        """Search the robot, which is lost; the update with its pose in the map, if it is found."""
        frame, scans = self._frame, len(self._history)
        found = self._finder.find(
            self._labels, thin(hits), update.pose, scans, frame, self._odometry
        )
        if found is None:
            return update
        T, motion = found
        self._path_begin = 0 if self._place is None else frame.last + 1
        self._movers.move(T)
        pose = motion @ update.pose
        return dataclasses.replace(
            update,
            pose=pose,
            covariance=rotate_covariance(update.covariance, motion),
            T_map_odom=self._to_map_odom(pose),
            doubts=tuple(name for name in update.doubts if name not in ("lost", "ambiguous")),
            movers=self._movers.movers(frame.T_map_local),
        )

    def label(self, scan: Scan | ScanBeams, number: int) -> NDArray[np.float32]:
        """(N,) P(static) of the beams of an earlier scan, by what is known now.

        Args:
            scan: as it was pushed.
            number: how many scans were pushed before it.
        """
        beams = drop_cover(scan if isinstance(scan, ScanBeams) else to_beams(scan))
        anchor, local = self._history.at(number)
        pose = self._frame.to_map(self._finder.move(local, number), anchor)
        return self._labels.label(deskew(beams, self._history.twist_at(number)), pose)

    @property
    def poses(self) -> Float:
        """(T, D+1, D+1) T_map_base of all scans, as they are known now."""
        _, local, anchor = self._history.poses()
        moved = self._finder.move_all(local)
        # in a known map that frame is the map's
        is_map = self._place is not None or not len(moved)
        return moved if is_map else self._frame.to_map_all(moved, anchor)

    @property
    def path(self) -> Float:
        """(S, D+1, D+1) T_map_base of spaced scans, as they are known now: quicker than `poses`.
        Only those since the robot was found or lost."""
        return self._frame.spaced_poses()[self._path_begin :]

    @property
    def map(self) -> GridMap:
        """The map of what stands, as it is known now; in 3D of the obstacles above the ground.
        NaN: unknown."""
        if self._dimension == 2:
            return self._labels.to_map()
        output, positions = self.options.output, self.path[:, :3, 3]
        band = output.min_obstacle_height, output.max_obstacle_height
        known, cell = self._labels.known_cells(), self._slam.resolution
        return project_obstacles(known, positions, band, cell)

    @property
    def cells(self) -> CellProbabilities:
        """P(static and occupied) of the cells, in 3D voxels, in which beams ended."""
        return self._labels.known_cells()

    @property
    def resolution(self) -> float:
        """m, edge of the cells in which `Update.changes` are, once a scan was pushed."""
        return self._labels.resolution

    @property
    def objects(self) -> list[MovingObject]:
        """Moving objects, from the labels and poses of all scans so far."""
        return self.snapshot().build().objects

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the folder that `stillmap.build(...).save` writes, of what is known now.

        The poses are those known now, labels and map follow from all scans so far. `live/` has what
        was answered at the time.

        Raises:
            InputError: no scan was pushed, or the folder is taken or cannot be written to.
        """
        self.snapshot().save(path, overwrite=overwrite, progress=progress)

    def snapshot(self) -> Snapshot:
        """All scans so far and what is known of them: to save them while more are pushed.

        Raises:
            InputError: no scan was pushed.
        """
        self._require_scans()
        kept, place = self._history.snapshot(), self._place
        poses = self.poses[kept.number]
        extended = place.known if place is not None and place.extends else None
        return Snapshot(kept, poses, self.options, self._scratch, extended)

    def finish(self, progress: Progress = no_progress) -> BuiltResult:
        """The result of `stillmap.build` on all scans: poses, labels and map refined.

        Raises:
            InputError: no scan was pushed.
        """
        self._require_scans()
        recording = self._history.recording()
        found = map_recording(recording, self.options, progress=progress, scratch=recording.scratch)
        return BuiltResult(**vars(found))

    def close(self) -> None:
        """Forget all scans, and end the process that closes loops, if there is one."""
        self._is_closed = True
        self._frame.stop()
        self._history.close()

    def __enter__(self) -> LiveMapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_next(self, beams: ScanBeams) -> None:
        """Check a scan against those before."""
        D = beams.dimension
        if self._is_closed:
            raise ValueError("mapper: expected one that is not closed")
        if self._place is not None and D == 3:
            raise ValueError("scan: expected a planar one: localization is planar")
        if self._last_ns is None:
            return
        if self._dimension != D:
            raise ValueError(f"scan: expected {self._dimension}D as before, got {D}D")
        if beams.stamp_ns < self._last_ns:
            late = 1e-9 * (self._last_ns - beams.stamp_ns)
            raise ValueError(f"stamp: expected none before the last scan, got {late:.6f} s earlier")

    def _start(self, dimension: int) -> None:
        """Begin mapping with the first scan, in its dimension, and start to close loops."""
        self._frame.stop()  # of a first scan that could not be mapped
        self._begin(dimension)
        closer: LoopClosing = NoLoops()
        if self._place is None and self._slam.loop_closure:
            threads = resolve_threads(self.options.threads)
            closer = start_closer(
                self._slam, dimension, self._in_background, self._scratch, threads
            )
        self._frame = MapFrame(dimension, closer, self._in_background)

    def _require_scans(self) -> None:
        if self._last_ns is None:
            raise InputError("no scan was pushed yet")

    def _weigh(self, hits: Any, prior: Any) -> Any:
        """The hits with weights P(static): the E-step at the predicted pose."""
        points, T_local_base = self._odometry.end_points(hits, prior)
        weights = self._labels.label_ends(points, self._frame.T_map_local @ T_local_base)
        return dataclasses.replace(hits, weights=weights)

    def _to_matrix(self, odometry: ArrayLike | None, dimension: int) -> Float | None:
        if odometry is None:
            return None
        given = np.asarray(odometry, np.float64)[None]
        out: Float = poses_to_matrices("odometry", given, 1, dimension)[0]
        return out

    def _increment(self, T_odom_base: Float | None) -> Float | None:
        if T_odom_base is None or self._T_odom_base is None:
            return None
        out: Float = se2.inverse(self._T_odom_base) @ T_odom_base
        return out

    def _to_map_odom(self, pose: Float) -> Float | None:
        """(D+1, D+1) T_map_odom at the pose of the last scan."""
        return None if self._T_odom_base is None else pose @ se2.inverse(self._T_odom_base)

    def _add_to_maps(
        self,
        beams: ScanBeams,
        labelled: LabelledScan,
        e: NDArray[np.float32],
        found: Registration,
    ) -> bool:
        """Add a scan to the local map and, if it is spaced, to the pose graph, and go on correcting
        the map; True if the scan is spaced."""
        self._frame.add_drift(found.drift)
        # without odometry nothing else says how the robot moves
        is_doubted = found.has_odometry and self._moving > _CROWDED
        recent = self._labels.doubt(e) if is_doubted else e
        added = self._odometry.add(beams, e, recent, self._label_again)
        if not self._finder.is_carried:
            if added is not None:
                self._frame.add(added, found)
            agrees = None if found.is_contradicted else labelled
            self._frame.correct(agrees, added, self._labels, self._odometry)
        return added is not None

    def _label_again(self, scan: MappedScan) -> NDArray[np.float32]:
        """(N,) P(static) of a scan of the local map by what is known now; 0: unusable."""
        T, hit = self._frame.T_map_local @ scan.T_map_base, scan.beams.hit
        e = np.nan_to_num(self._labels.label(scan.beams, T))
        if hit.any():
            self._moving += _MOVING_RATE * (float((e[hit] < 0.5).mean()) - self._moving)
        return e

    def _take_changes(self, stamp_ns: int) -> list[MapChange]:
        """The parts of the map that changed, once a second."""
        if stamp_ns < self._changes_due_ns:
            return []
        self._changes_due_ns = stamp_ns + _CHANGES_EVERY_NS
        return self._labels.take_changes()

    def _to_update(
        self, stamp_ns: int, found: Registration, p_static: NDArray[np.float32]
    ) -> Update:
        doubts = {
            "slip": found.is_slipping,
            "blind": found.is_blind,
            "carried": found.is_carried,
            "contradicted": found.is_contradicted,
            "lost": self._finder.is_lost,
            "ambiguous": self._finder.is_ambiguous,
        }
        pose = self._frame.T_map_local @ found.T
        return Update(
            pose,
            rotate_covariance(found.covariance, self._frame.T_map_local),
            p_static,
            self._to_map_odom(pose),
            tuple(name for name, is_so in doubts.items() if is_so),
            self._take_changes(stamp_ns),
            self._movers.movers(self._frame.T_map_local),
            [LaterLabels(n, self.label(one, n)) for n, one in self._hindsight.take(stamp_ns)],
        )
